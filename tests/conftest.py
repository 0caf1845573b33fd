"""Fixtures that tests of several rooms share.

What needs torch is imported by the fixtures: tests of the robot's rooms start without it.
"""

import os

# Before numpy and torch are loaded: the processes of pytest share the cores, one thread each.
os.environ["OMP_NUM_THREADS"] = "1"

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

settings.register_profile("patient", deadline=None)  # a busy machine is no failure
settings.load_profile("patient")

Once = Callable[[str, Callable[[Path], None]], Path]


@pytest.fixture(scope="session")
def opinionated():
    """Make a network with random weights, scaled until its outputs vary and do not saturate."""
    from toy_networks import opinionated_network

    return opinionated_network()


@pytest.fixture
def small_config():
    """Return the configuration of the small network."""
    from toy_networks import SMALL

    return SMALL


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Fill a folder once for all processes of a test run: once(name, fill) returns it."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # each process has a folder of its own in that of the test run

    def folder_of(name: str, fill: Callable[[Path], None]) -> Path:
        folder, done = root / name, root / f"{name}.done"
        with FileLock(root / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                done.touch()
        return folder

    return folder_of


@pytest.fixture(scope="session")
def fine_tuned(once: Once) -> Path:
    """Return a folder with training/best.ckpt of a small network, and its model.onnx."""
    from toy_networks import MOBILENET, fine_tune

    return once("fine_tuned", lambda folder: fine_tune(folder, MOBILENET))
