"""The largest batch: worst images, extrapolation, and a real measurement of this process."""

import ctypes
from pathlib import Path

import coco_toys
import pytest
import torch

from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.models import NetworkConfig
from cohdc_train.train import batch_size
from cohdc_train.train.module import MaskRCNNModule

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return coco_toys.folder(tmp_path_factory.mktemp("toy"))


def module(canvas: tuple[int, int]) -> MaskRCNNModule:
    return MaskRCNNModule(
        ["person", "car"],
        NetworkConfig(depth=18, width=0.125, fpn_channels=8, fc=16, canvas=canvas),
    )


def test_worst_batch_has_the_most_objects_and_fills_the_canvas(toy: Path) -> None:
    batch = batch_size.worst_batch(CocoDataModule(toy, canvas=(96, 128), mini_mask=(28, 28)), 3)
    assert batch.images.shape == (3, 3, 96, 128)
    assert [t["masks"].shape for t in batch.targets] == [(2, 28, 28)] * 3
    boxes = batch.targets[0]["boxes"]
    torch.testing.assert_close(boxes[:, 2:] - boxes[:, :2], torch.tensor([[64.0, 48.0]] * 2))


@pytest.mark.parametrize(
    ("one", "two", "budget", "room"),
    [(10, 14, 30, 6), (10, 14, 10, 1), (10, 14, 9, 0), (10, 10, 12, 3), (10, 30, 29, 1)],
)
def test_batch_size_is_extrapolated_from_one_and_two_images(
    one: float, two: float, budget: float, room: int
) -> None:
    assert batch_size.max_batch_size(one, two, budget) == room


def give_back_memory() -> None:
    """Return what earlier tests have freed to the system: reused, it would not be measured."""
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:  # glibc has it
        trim(0)


@pytest.mark.skipif(not batch_size._RESET.exists(), reason="needs Linux to tell its memory")
def test_larger_canvas_fits_fewer_images(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_size, "_free", lambda device: 2**30)
    found = {}
    for side in (256, 1024):
        built = module((side, side))
        give_back_memory()
        before = {name: value.clone() for name, value in built.network.state_dict().items()}
        found[side] = batch_size.find_batch_size(
            built, CocoDataModule(toy, canvas=(side, side)), CPU
        )
        assert all(
            torch.equal(before[name], value) for name, value in built.network.state_dict().items()
        )
    assert 1 <= found[1024] <= 8
    assert found[1024] < found[256]


def test_too_little_memory_is_an_error(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_size, "_free", lambda device: 2**20)
    with pytest.raises(CohdcError, match="batch_size auto: one image takes"):
        batch_size.find_batch_size(module((256, 256)), CocoDataModule(toy, canvas=(256, 256)), CPU)
