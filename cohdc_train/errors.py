"""Errors of users. Every other exception is a bug and keeps its traceback."""


class CohdcError(Exception):
    """A user's error: one line that names file and number. `cohdc` prints it and exits with 1."""


class DataError(CohdcError):
    """An annotation file, an image, a sequence or a trajectory cannot be used."""


class ContractError(CohdcError):
    """An ONNX file does not keep the contract of `cohdc_train.signature`."""


class ExportError(CohdcError):
    """An exported file does not equal the network that it came from. Nothing was left on disk."""


class MissingExtraError(CohdcError):
    """A verb needs packages that are not installed; the message gives the install command."""
