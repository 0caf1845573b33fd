"""What a user can do wrong. Everything else is a bug and keeps its traceback."""


class CohdcError(Exception):
    """A user's error, told in one line that names the file and the number; `cohdc` prints it and
    exits 1.
    """


class DataError(CohdcError):
    """An annotation file, an image, a sequence or a trajectory cannot be used as it is."""


class ContractError(CohdcError):
    """An ONNX file does not keep the contract of `cohdc_train.signature`."""


class ExportError(CohdcError):
    """An exported file did not equal the network it came from; nothing was left on disk."""


class MissingExtraError(CohdcError):
    """A verb needs packages of an extra that is not installed; the message holds the command that
    installs it.
    """
