"""`KEY=VALUE` switches of the SLAM method, for tools that compare methods."""

from dataclasses import fields

import yaml

from cohdc_train.slam.method import Method


def chosen_method(switches: list[str]) -> Method:
    """The method with `KEY=VALUE` switches. Raises ValueError for one it does not have or of another type."""
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
