"""Images of the worst frames: which are kept, and what is drawn."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from plane_world import CAMERA

from cohdc_train.slam.frame import FrameResult, FrameTiming, RGBDFrame
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.visualization.worst_frames import WorstFrames

MASK = np.zeros((48, 64), np.bool_)
MASK[:24] = True


def watch(inliers: list[int | None], rate: float = 10.0) -> WorstFrames:
    """Show frames to an observer. inliers: None = lost; rate: frames/s."""
    worst = WorstFrames()
    for k, number in enumerate(inliers):
        t = k / rate
        image = np.full((48, 64, 3), 100, np.uint8)
        depth = np.ones((48, 64), np.float32)
        frame = RGBDFrame(t, image, depth, timestamp_text=f"{t:.1f}")
        result = FrameResult(
            timestamp=t,
            T_wc=None if number is None else np.eye(4),
            status="lost" if number is None else "tracking",
            source="map",
            is_keyframe=False,
            num_matches=number or 0,
            num_inliers=number or 0,
            features=None,
            dynamic_mask=MASK,
            given_mask=MASK,
            timing=FrameTiming(5.0, 0.0),
        )
        worst(frame, result, Map(CAMERA))
    return worst


def stamps(worst: WorstFrames, folder: Path) -> list[str]:
    """Write the images and return their stamps, in order."""
    folder.mkdir()
    worst.write(folder)
    return sorted(file.name.removesuffix("_worst.jpg") for file in folder.iterdir())


def test_frames_with_the_fewest_inliers_are_kept_a_second_apart(tmp_path: Path) -> None:
    inliers: list[int | None] = [200] * 60
    inliers[20], inliers[23], inliers[50] = 40, 30, 50
    kept = stamps(watch(inliers), tmp_path / "out")
    assert {"2.3", "5.0"} <= set(kept)
    assert "2.0" not in kept
    assert np.diff([float(stamp) for stamp in kept]).min() >= 1 - 1e-9


def test_lost_frame_is_worse_than_any_other(tmp_path: Path) -> None:
    inliers: list[int | None] = [100 + k for k in range(200)]
    inliers[150] = None
    kept = stamps(watch(inliers), tmp_path / "out")
    assert len(kept) == 6
    assert "15.0" in kept


@pytest.mark.parametrize("seconds", [0.2, 3.0])
def test_short_run_keeps_what_there_is(tmp_path: Path, seconds: float) -> None:
    kept = stamps(watch([100] * round(10 * seconds)), tmp_path / "out")
    assert 1 <= len(kept) <= seconds + 1


def test_mask_is_tinted_red(tmp_path: Path) -> None:
    assert stamps(watch([100]), tmp_path / "out") == ["0.0"]
    image = cv2.imread(str(tmp_path / "out" / "0.0_worst.jpg"))
    blue, _, red = image[:20].reshape(-1, 3).mean(axis=0)
    assert red > blue + 40
    assert np.abs(image[30:].mean() - 100) < 3
