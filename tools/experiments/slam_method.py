"""The option `--method KEY=VALUE ...` of tools that compare SLAM methods."""

import argparse
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import yaml

from cohdc_train.slam.config import Method


def add_method_option(parser: argparse.ArgumentParser) -> None:
    """Gives the arguments a `method`; a switch that there is not ends the tool with what is wrong."""
    words = "as --method.KEY of cohdc slam"
    parser.add_argument(
        "--method", nargs="+", action=_Switches, default=Method(), metavar="KEY=VALUE", help=words
    )


def chosen_method(switches: Sequence[str]) -> Method:
    """The method with `KEY=VALUE` switches. Raises ValueError for one it does not have or of
    another type.
    """
    types = {field.name: type(field.default) for field in fields(Method)}
    values = {}
    for switch in switches:
        key, _, text = switch.partition("=")
        if key not in types:
            raise ValueError(f"--method {switch}: {key!r} is none of {', '.join(types)}")
        values[key] = yaml.safe_load(text)
        if not isinstance(values[key], types[key]):
            raise ValueError(f"--method {switch}: {text!r} is no {types[key].__name__}")
    return Method(**values)


class _Switches(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: Any,
        values: Any,
        option: str | None = None,
    ) -> None:
        try:
            namespace.method = chosen_method(values)
        except ValueError as error:
            parser.error(str(error))
