"""The option `--settings OPTION=VALUE ...` of tools that compare options of the SLAM system."""

import argparse
from collections.abc import Sequence
from typing import Any

import yaml

from cohdc_train.errors import DataError
from cohdc_train.slam.config import SlamConfig


def add_settings_option(parser: argparse.ArgumentParser) -> None:
    """Add `settings` to the arguments: a dict of dotted names, checked by SlamConfig."""
    words = "as --settings.OPTION VALUE of cohdc slam, such as loops.enabled=false"
    parser.add_argument(
        "--settings", nargs="+", action=_Settings, default={}, metavar="OPTION=VALUE", help=words
    )


def parse_settings(words: Sequence[str]) -> dict[str, Any]:
    """Return the options of `OPTION=VALUE` words. Raises DataError for one that does not exist."""
    options = {}
    for word in words:
        name, _, text = word.partition("=")
        options[name] = yaml.safe_load(text)
    SlamConfig().override(options)
    return options


class _Settings(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: Any,
        values: Any,
        option: str | None = None,
    ) -> None:
        try:
            namespace.settings = parse_settings(values)
        except DataError as error:
            parser.error(str(error))
