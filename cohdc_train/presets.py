"""Where the shipped files lie: YAML in `configs/` of a checkout or its copy inside a wheel,
networks in `shipped/`.
"""

from pathlib import Path

from cohdc_train.errors import CohdcError

_PACKAGE = Path(__file__).resolve().parent


def config_path(name: str | Path) -> Path:
    """The YAML file a user means by `name`: a path that exists, else a shipped one such as
    `table3/test10.yaml`.

    A leading `configs/` is optional. Raises CohdcError naming the file when there is neither.
    """
    given = Path(name)
    if given.is_file():
        return given
    relative = Path(*given.parts[1:]) if given.parts[:1] == ("configs",) else given
    for root in (_PACKAGE / "_configs", _PACKAGE.parent / "configs"):
        if (root / relative).is_file():
            return root / relative
    raise CohdcError(f"{name}: no such file, and no shipped config of that name")


def model_path(name: str | Path) -> Path:
    """The network a user means by `name`: a file that exists, else a shipped one such as `person`.

    A name that is neither comes back as it is, for its reader to complain of.
    """
    given = Path(name)
    shipped = _PACKAGE / "shipped" / f"{given}.onnx"
    return (
        shipped if not given.is_file() and given.name == str(given) and shipped.is_file() else given
    )


def shipped_models() -> list[str]:
    """Names of the networks that come with the package."""
    return sorted(file.stem for file in (_PACKAGE / "shipped").glob("*.onnx"))
