"""Files that come with the package: configurations and networks."""

from pathlib import Path

from cohdc_train.errors import CohdcError

_PACKAGE = Path(__file__).resolve().parent
# Configurations lie in the wheel, or in the checkout.
_CONFIG_FOLDERS = (_PACKAGE / "_configs", _PACKAGE.parent / "configs")


def config_path(name: str | Path) -> Path:
    """Return the YAML file of a name: a path that exists, else a shipped configuration.

    Args:
        name: such as `table3/test10.yaml`; a leading `configs/` is optional.

    Raises:
        CohdcError: there is neither.
    """
    given = Path(name)
    if given.is_file():
        return given
    relative = Path(*given.parts[1:]) if given.parts[:1] == ("configs",) else given
    for folder in _CONFIG_FOLDERS:
        if (folder / relative).is_file():
            return folder / relative
    raise CohdcError(f"{name}: no such file, and no shipped config of that name")


def model_path(name: str | Path) -> Path:
    """Return the network of a name: a file that exists, else a shipped one such as `person`.

    A name that is neither is returned as it is, for its reader to report.
    """
    given = Path(name)
    shipped = _PACKAGE / "shipped" / f"{given}.onnx"
    is_plain_name = given.name == str(given)
    if not given.is_file() and is_plain_name and shipped.is_file():
        return shipped
    return given


def shipped_models() -> list[str]:
    """List the names of the shipped networks."""
    return sorted(file.stem for file in (_PACKAGE / "shipped").glob("*.onnx"))
