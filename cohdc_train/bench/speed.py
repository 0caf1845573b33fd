"""How fast networks are from image to masks, in turn on the same pictures, and how much memory they
take.
"""

import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from cohdc_train.errors import CohdcError
from cohdc_train.exporter.interleaved_timing import K, seconds_in_turn
from cohdc_train.models import detect
from cohdc_train.segmenter import Detections, Segmenter
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.types import Image

Runner = Callable[[Image], Detections]

LIKELY = 0.5  # score from which a detection's mask is pasted
_PEAK = """
import resource, sys
from pathlib import Path
import numpy as np
from cohdc_train.segmenter import Segmenter
from cohdc_train.types import Image
run = Segmenter(Path(sys.argv[1]), int(sys.argv[2]))
image = np.load(sys.argv[3])
for _ in range(3):
    run(image).masks()
status = Path("/proc/self/status")
if status.is_file():  # Linux counts a parent's memory in a child's ru_maxrss
    print(1024 * next(int(line.split()[1]) for line in status.open() if line.startswith("VmHWM")))
else:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


class Rate(NamedTuple):
    """Pictures per second: the median over the pictures, and the quartiles."""

    median: float
    low: float
    high: float


def torch_runner(checkpoint: Path) -> Runner:
    """A checkpoint's network in torch, float32, in evaluation mode, read as the ONNX file is."""
    module = MaskRCNNModule.load(checkpoint)
    names = tuple(module.class_names)

    def run(rgb: Image) -> Detections:
        with torch.inference_mode():
            found = detect(module.network, [torch.from_numpy(rgb).permute(2, 0, 1)])[0]
        boxes, labels, scores, quality, masks = (
            found[name].numpy() for name in ("boxes", "labels", "scores", "quality", "masks")
        )
        height, width = rgb.shape[:2]
        return Detections(boxes, labels, scores, quality, masks, (height, width), names)

    return run


def frame_rates(runners: Mapping[K, Runner], pictures: Sequence[Image]) -> dict[K, Rate]:
    """Frames per second of each runner, in turn, from uint8 [H, W, 3] to the masks of its likely
    detections.
    """
    whole = {name: _to_masks(run) for name, run in runners.items()}
    return {name: _rate(taken) for name, taken in seconds_in_turn(whole, pictures).items()}


def _to_masks(run: Runner) -> Callable[[Image], None]:
    def whole(rgb: Image) -> None:
        found = run(rgb)
        found.select(found.scores >= LIKELY).masks()

    return whole


def _rate(seconds: Sequence[float]) -> Rate:
    low, median, high = np.percentile(seconds, [75, 50, 25])
    return Rate(1 / float(median), 1 / float(low), 1 / float(high))


def peak_memory(file: Path, picture: Path, threads: int) -> float:
    """MiB that a process of its own takes at most, onnxruntime and numpy included, when it runs a
    file on a picture.

    picture: a .npy file of uint8 [H, W, 3]. Raises CohdcError when the process fails.
    """
    command = [sys.executable, "-c", _PEAK, str(file), str(threads), str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise CohdcError(f"{file}: does not run by itself: {done.stderr.strip().splitlines()[-1]}")
    return int(done.stdout) / 2**20


def spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Median, smallest and largest."""
    return statistics.median(values), min(values), max(values)


def runners_of(
    checkpoint: Path | None, files: Mapping[str, Path], threads: int
) -> dict[str, Runner]:
    """`fps_torch` of a checkpoint and one runner of each file, by the names of table4.json's
    columns.
    """
    torch.set_num_threads(threads)
    found: dict[str, Runner] = {} if checkpoint is None else {"fps_torch": torch_runner(checkpoint)}
    return found | {name: Segmenter(path, threads) for name, path in files.items()}
