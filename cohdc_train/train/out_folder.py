"""The output folder of `cohdc fit`: files that no former training wrote are kept."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.utilities import rank_zero_only

from cohdc_train.files import check_folder, claim_folder
from cohdc_train.train.checkpoints import BEST, LAST

_VERB = "fit"


@rank_zero_only
def check_out(config: Mapping[str, Any]) -> None:
    """Raise DataError when a training would replace files that no former training wrote.

    Only the first process looks: the others start when it may have written already.

    config: resolved options of `cohdc fit`.
    """
    check_folder(Path(config["out"]), _VERB, _names(config))


@rank_zero_only
def claim_out(config: Mapping[str, Any]) -> None:
    """Make the folder and list in its manifest what the training will write, after `check_out`."""
    claim_folder(Path(config["out"]), _VERB, _names(config))


def _names(config: Mapping[str, Any]) -> list[str]:
    """Return the names that a training replaces; logs/ gets a new version_N each time."""
    names = ["config.yaml", BEST, LAST, "lr_find.png"]
    return [*names, "figures"] if config["figures"] else names
