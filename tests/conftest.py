"""Fixtures that tests of several rooms share.

What needs torch is imported by the fixtures: tests of the robot's rooms start without it.
"""

import os

# Before numpy, OpenCV and torch are loaded: the processes share the cores, one thread each.
os.environ["OMP_NUM_THREADS"] = os.environ["OPENCV_FOR_THREADS_NUM"] = "1"

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

settings.register_profile("patient", deadline=None)  # a busy machine is no failure
settings.load_profile("patient")

Once = Callable[[str, Callable[[Path], None]], Path]
# Files of few tests that take long: they start first, so that no process waits at the end.
LONGEST = ("test_demo.py", "test_end_to_end.py", "test_export.py", "test_fit.py", "test_docs.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first."""
    place = {name: index for index, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


@pytest.fixture(scope="session", autouse=True)
def one_thread_of_onnxruntime() -> Iterator[None]:
    """Let a `Segmenter` that is asked for no number of threads use one."""
    from cohdc_train.segmenter import Segmenter

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Segmenter.__init__, "__defaults__", (1,))
        yield


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
    """Return a function that fills a folder once for all processes of a test run."""
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
