"""Speed of networks from image to masks, taking turns on the same images, and their memory."""

import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from cohdc_train.errors import CohdcError
from cohdc_train.exporter.interleaved_timing import K, time_interleaved
from cohdc_train.models import detect
from cohdc_train.segmenter import Detections, Segmenter
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.types import Image

Runner = Callable[[Image], Detections]

MIN_SCORE = 0.5  # detections below are not pasted into full-size masks
_PEAK_MEMORY_PROGRAM = """
import resource, sys
from pathlib import Path
import numpy as np
from cohdc_train.segmenter import Segmenter
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
    """Images per second: the median over the images, and the quartiles."""

    median: float
    low: float
    high: float


def torch_runner(checkpoint: Path) -> Runner:
    """Load a checkpoint's network in torch, float32, to be called like a `Segmenter`."""
    module = MaskRCNNModule.load(checkpoint)
    class_names = tuple(module.class_names)

    def run(rgb: Image) -> Detections:
        with torch.inference_mode():
            found = detect(module.network, [torch.from_numpy(rgb).permute(2, 0, 1)])[0]
        names = ("boxes", "labels", "scores", "quality", "masks")
        boxes, labels, scores, quality, masks = (found[name].numpy() for name in names)
        height, width = rgb.shape[:2]
        return Detections(boxes, labels, scores, quality, masks, (height, width), class_names)

    return run


def frame_rates(runners: Mapping[K, Runner], images: Sequence[Image]) -> dict[K, Rate]:
    """Measure images per second from uint8 [H, W, 3] to full-size masks of likely detections.

    The runners take turns on each image.
    """
    to_masks = {name: _with_masks(run) for name, run in runners.items()}
    seconds = time_interleaved(to_masks, images)
    return {name: _rate(times) for name, times in seconds.items()}


def _with_masks(run: Runner) -> Callable[[Image], None]:
    def run_to_masks(rgb: Image) -> None:
        detections = run(rgb)
        detections.select(detections.scores >= MIN_SCORE).masks()

    return run_to_masks


def _rate(seconds: Sequence[float]) -> Rate:
    low, median, high = np.percentile(seconds, [75, 50, 25])
    return Rate(1 / float(median), 1 / float(low), 1 / float(high))


def peak_memory(model: Path, image: Image, threads: int) -> float:
    """Measure the peak memory of a process that runs an ONNX file on an image.

    Args:
        model: the ONNX file.
        image: uint8 [H, W, 3].
        threads: number of threads of onnxruntime.

    Returns:
        MiB, onnxruntime and numpy included.

    Raises:
        CohdcError: the process fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        image_file = Path(folder) / "image.npy"
        np.save(image_file, image)
        arguments = [str(model), str(threads), str(image_file)]
        command = [sys.executable, "-c", _PEAK_MEMORY_PROGRAM, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise CohdcError(f"{model}: does not run by itself: {reason}")
    return int(done.stdout) / 2**20


def median_and_range(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the median, the smallest and the largest value."""
    return statistics.median(values), min(values), max(values)


def make_runners(
    checkpoint: Path | None, files: Mapping[str, Path], threads: int
) -> dict[str, Runner]:
    """Make `fps_torch` of a checkpoint and one runner of each file, named as table4.json's columns.

    Args:
        checkpoint: None for a row without one.
        files: column of table4.json -> ONNX file.
        threads: number of threads of torch and onnxruntime.
    """
    torch.set_num_threads(threads)
    runners: dict[str, Runner] = {}
    if checkpoint is not None:
        runners["fps_torch"] = torch_runner(checkpoint)
    return runners | {name: Segmenter(path, threads) for name, path in files.items()}
