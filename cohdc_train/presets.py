"""Where the shipped YAML files lie: `configs/` of a checkout, its copy inside an installed wheel."""

from pathlib import Path

from cohdc_train.errors import CohdcError

_PACKAGE = Path(__file__).resolve().parent


def config_path(name: str | Path) -> Path:
    """The YAML file a user means by `name`: a path that exists, else a shipped one such as `table3/test10.yaml`.

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
