"""Loader of files in tools/ as modules."""

import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import pytest

TOOLS = Path(__file__).parents[1] / "tools"


def load_tool(name: str) -> ModuleType:
    """Load a file in tools/ as a new module."""
    loader = SourceFileLoader(name, str(TOOLS / name))
    module = module_from_spec(spec_from_loader(name, loader) or pytest.fail(f"no tools/{name}"))
    sys.modules[name] = module  # dataclasses look their module up
    loader.exec_module(module)
    return module
