"""Batch size of `--data.batch_size auto`: the largest whose worst case fits into memory."""

import copy
import gc
import math
from pathlib import Path

import torch

from cohdc_train.data.datamodule import CocoDataModule, TrainBatch
from cohdc_train.errors import CohdcError
from cohdc_train.models import MaskRCNN
from cohdc_train.train.module import MaskRCNNModule

MAX_BATCH_SIZE = 32  # images; larger batches make no step faster
_SHARE = {"cuda": 0.85, "cpu": 0.5}  # of the memory that is free before the first step
_STATUS, _MEMORY, _RESET = (
    Path("/proc") / p for p in ("self/status", "meminfo", "self/clear_refs")
)


def find_batch_size(module: MaskRCNNModule, data: CocoDataModule, device: torch.device) -> int:
    """Return a power of two, at most MAX_BATCH_SIZE, whose worst batch fits into memory.

    A copy of the network makes passes over one and two worst images. A worst image fills the canvas
    and has as many objects as the fullest training image. The memory of larger batches is
    extrapolated; activations grow in proportion.

    Raises:
        CohdcError: not even one image fits, or the machine does not tell its memory.
    """
    free = _free(device)
    with torch.random.fork_rng():
        network = copy.deepcopy(module.network).to(device).train()
        # The larger first: what the allocator keeps of it makes the difference larger, not smaller.
        two, one = (_peak(network, worst_batch(data, size), device) for size in (2, 1))
    room = max_batch_size(one, two, free * _SHARE[device.type])
    if room < 1:
        needed, there = one / 2**30, free / 2**30
        raise CohdcError(
            f"batch_size auto: one image takes {needed:.1f} of {there:.1f} free GiB; "
            "lower the canvas"
        )
    return min(MAX_BATCH_SIZE, 1 << (room.bit_length() - 1))


def max_batch_size(one: float, two: float, budget: float) -> int:
    """Return how many images fit into `budget` when one and two take so much; 0 when none does."""
    return max(0, 1 + math.floor((budget - one) / max(two - one, 1.0)))


def worst_batch(data: CocoDataModule, size: int) -> TrainBatch:
    """Return images of noise that fill the canvas, each with as many objects as the fullest one."""
    height, width = data.canvas
    images = [image for split in data.folder.train for image in split.images]
    count = max(sum(not o.crowd for o in image.objects) for image in images)
    corner = torch.rand(count, 2) * 0.5
    boxes = torch.cat([corner, corner + 0.5], dim=1) * torch.tensor([width, height, width, height])
    target = {
        "boxes": boxes,
        "labels": torch.ones(count, dtype=torch.int64),
        "masks": torch.ones((count, *(data.mini_mask or data.canvas)), dtype=torch.uint8),
        "ignore": torch.zeros(0, 4),
        "size": (height, width),
        **({"frames": boxes} if data.mini_mask else {}),
    }
    return TrainBatch(torch.rand(size, 3, height, width), [dict(target) for _ in range(size)])


def _peak(network: MaskRCNN, batch: TrainBatch, device: torch.device) -> int:
    """Return the peak bytes of a forward and a backward pass, with the optimizer's two moments."""
    images = batch.images.to(device)
    targets = [
        {k: v.to(device) if torch.is_tensor(v) else v for k, v in t.items()} for t in batch.targets
    ]
    gc.collect()
    before = _reset(device)
    total = torch.stack([loss.float() for loss in network.losses(images, targets).values()]).sum()
    torch.autograd.backward(total)
    used = _used_at_most(device) - before
    moments = sum(2 * p.numel() * p.element_size() for p in network.parameters() if p.requires_grad)
    network.zero_grad(set_to_none=True)
    return used + moments


def _reset(device: torch.device) -> int:
    """Forget the peak so far, and return the bytes in use."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return int(torch.cuda.memory_allocated(device))
    _RESET.write_text("5")  # Linux: the peak resident set becomes the present one
    return _kibibytes(_STATUS, "VmRSS")


def _used_at_most(device: torch.device) -> int:
    """Return the peak bytes since `_reset`."""
    return (
        int(torch.cuda.max_memory_allocated(device))
        if device.type == "cuda"
        else _kibibytes(_STATUS, "VmHWM")
    )


def _free(device: torch.device) -> int:
    """Return the free bytes of a device."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    if device.type != "cpu" or not _RESET.exists():
        raise CohdcError("batch_size auto: this machine does not tell its memory; give a number")
    return _kibibytes(_MEMORY, "MemAvailable")


def _kibibytes(file: Path, key: str) -> int:
    """Return the bytes of a line "key: N kB" of one of Linux' tables."""
    (line,) = (line for line in file.read_text().splitlines() if line.startswith(key + ":"))
    return int(line.split()[1]) * 1024
