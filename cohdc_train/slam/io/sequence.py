"""Opening of a folder as a source of frames."""

from pathlib import Path

from cohdc_train.errors import DataError
from cohdc_train.slam.config import StereoConfig
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.sources import (
    FrameSource,
    RecordedSequence,
    SequenceFormat,
    rgbd_format,
)
from cohdc_train.slam.io.stereo import stereo_format


def open_sequence(folder: Path | str, camera: Path | str | None = None) -> FrameSource:
    """Open a recorded sequence in the format of the TUM RGB-D benchmark, or of a stereo pair.

    Args:
        folder: with rgb.txt and depth.txt, or left.txt and right.txt of a rectified pair.
        camera: camera YAML; else camera.yaml of the folder, else a guess from the folder's name.

    Returns:
        Frames: iterate for RGBDFrame; `camera`, `groundtruth` (path or None), and `len()`.

    Raises:
        DataError: the folder, its lists, or the camera cannot be used.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    intrinsics, _ = choose_camera(folder, None if camera is None else Path(camera))
    return RecordedSequence(folder, intrinsics, choose_format(folder, intrinsics))


def choose_format(
    folder: Path, camera: Camera, config: StereoConfig = StereoConfig()
) -> SequenceFormat:
    """Choose the format of a folder: a stereo pair or color with depth.

    It is a stereo pair where there is left.txt, or no rgb.txt and the camera has a baseline.

    Args:
        folder: of the sequence.
        camera: of its frames.
        config: depth of a stereo pair.
    """
    has_color = (folder / "rgb.txt").is_file()
    has_left = (folder / "left.txt").is_file()
    if has_left or (camera.baseline > 0 and not has_color):
        return stereo_format(camera, config)
    return rgbd_format(camera)
