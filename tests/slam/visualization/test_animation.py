"""Animated image of a run."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plane_world import write_sequence

from cohdc_train.errors import DataError
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.run import RunOptions, run_slam
from cohdc_train.slam.visualization.animation import RunAnimation

FRAMES = 8


@pytest.fixture(scope="module")
def animated(tmp_path_factory: pytest.TempPathFactory) -> Image.Image:
    """Run SLAM with an animation; return the image."""
    folder = tmp_path_factory.mktemp("animation")
    sequence = write_sequence(folder / "walk", FRAMES)
    masks = sequence / "masks"
    run_slam(sequence, folder / "run", masks=masks, options=RunOptions(animation=True))
    return Image.open(folder / "run" / "animation.webp")


def test_every_third_frame_is_shown(animated: Image.Image) -> None:
    assert animated.n_frames == len(range(0, FRAMES, 3))
    assert animated.size == (3 * 320, 240)


def test_path_grows_from_frame_to_frame(animated: Image.Image) -> None:
    def blue_pixels(index: int) -> int:
        animated.seek(index)
        panel = np.asarray(animated.convert("RGB"), np.int16)[:, 640:]
        return int(np.count_nonzero(panel[..., 2] > panel[..., 0] + 80))

    assert 0 < blue_pixels(0) < blue_pixels(2)


def test_other_suffix_is_refused() -> None:
    extract = OrbExtractor.__new__(OrbExtractor)
    with pytest.raises(DataError, match=r"run\.mp4: an animation is a file \.webp or \.gif"):
        RunAnimation(Path("run.mp4"), extract)
