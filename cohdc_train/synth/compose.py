"""`cohdc synth compose`: photographed people in a recorded, static TUM sequence."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.files import new_folder, write_text
from cohdc_train.synth.cut_outs import (
    UP,
    CutOut,
    WalkPath,
    compose_frame,
    fill_depth,
    pixel_rays,
    render,
)
from cohdc_train.types import Float32Array, FloatArray, Image, Mask

if TYPE_CHECKING:  # loaded when the command runs, so that help stays cheap
    from cohdc_train.slam.geometry.camera import Camera
    from cohdc_train.slam.io.tum import TimestampedImage

MIN_SIDE_PX = 120  # shorter side of a cut-out's box
_MAX_TRIES = 200  # draws of walking paths
_RAY_STEP_PX = 8  # grid on which the covered share is estimated


def compose(
    sequence: Path,
    people: Path,
    *,
    out: Path,
    camera: Path | None = None,
    count: int = 2,
    frames: int | None = None,
    share: tuple[float, float] = (0.2, 0.5),
    seed: int = 0,
) -> None:
    """Put photographed people into a recorded, static TUM sequence.

    Each person is a cut-out on an upright plane with the relief of a rounded body, which walks back
    and forth in the world and faces the middle of the camera's path. Lens distortion is accounted
    for, and what the sensor measured nearer than a person hides it. Depth gets the sensor's noise
    and holes at outlines. Writes a TUM folder with rgb/, depth/, groundtruth.txt (the sequence's
    own), camera.yaml, and masks/, above 0 where a person is seen.

    Args:
        sequence: TUM-format sequence with groundtruth.txt.
        people: COCO-format folder with a class person; objects of its training split are cut out.
        out: new folder for the sequence.
        camera: camera yaml; else camera.yaml of the sequence, else a guess from the folder's name.
        count: number of people.
        frames: number of frames to take from the start; all when not given.
        share: smallest and largest mean share of the pixels that people cover; walks are drawn
            until they fit.
        seed: seed of all random draws.

    Raises:
        DataError: a folder or an option cannot be used, or no walks fit the share.
    """
    _check_options(count, frames, share, seed)
    rng = np.random.default_rng(seed)
    recording = read_recording(sequence, camera, frames)
    cut_outs = cut_out_people(people, count, rng)
    paths = draw_paths(cut_outs, recording, share, rng)

    shares = []
    rays = pixel_rays(recording.camera, 1)
    with new_folder(out) as draft:
        for name in ("rgb", "depth", "masks"):
            (draft / name).mkdir()
        for pair, pose, time in recording.frames():
            layers = [
                render(cut_out, path, time, pose, rays)
                for cut_out, path in zip(cut_outs, paths, strict=True)
            ]
            rgb, depth, mask = compose_frame(pair, recording.camera, layers, rng)
            _write_frame(draft, pair, rgb, depth, mask)
            shares.append(float(mask.mean()))
        _write_lists(draft, recording.pairs)
        shutil.copy(sequence / "groundtruth.txt", draft / "groundtruth.txt")
        write_text(draft / "camera.yaml", yaml.safe_dump(asdict(recording.camera)))
    print(
        f"{out}: {len(shares)} frames, people on {100 * np.mean(shares):.0f} % of the pixels "
        f"({100 * min(shares):.0f}-{100 * max(shares):.0f} %)"
    )


def _check_options(count: int, frames: int | None, share: tuple[float, float], seed: int) -> None:
    if count < 1:
        raise DataError(f"count is {count}; at least 1 person is needed")
    if frames is not None and frames < 1:
        raise DataError(f"frames is {frames}; at least 1 is needed")
    if not 0 <= share[0] <= share[1] <= 1:
        raise DataError(f"share is {share[0]:g} to {share[1]:g}; both lie in 0..1, in this order")
    if seed < 0:
        raise DataError(f"seed is {seed}; it cannot be below 0")


@dataclass(frozen=True)
class Recording:
    """Frames of a sequence with known poses.

    Attributes:
        camera: the sequence's camera.
        pairs: color and depth image of each frame.
        times: [n], s since the first frame.
        poses: [n, 4, 4] T_wc, m.
    """

    camera: "Camera"
    pairs: "list[tuple[TimestampedImage, TimestampedImage]]"
    times: FloatArray
    poses: FloatArray

    def frames(
        self, step: int = 1
    ) -> "Iterator[tuple[tuple[TimestampedImage, TimestampedImage], FloatArray, float]]":
        """Iterate over (images, T_wc, time) of every step-th frame."""
        for i in range(0, len(self.pairs), step):
            yield self.pairs[i], self.poses[i], float(self.times[i])


def read_recording(sequence: Path, camera_file: Path | None, num_frames: int | None) -> Recording:
    """Read the first frames of a sequence, and keep those with a pose in groundtruth.txt.

    Raises:
        DataError: a file cannot be used, or no frame has a pose.
    """
    from cohdc_train.slam.geometry.calibration import choose_camera
    from cohdc_train.slam.io.tum import read_pairs
    from cohdc_train.trajectory.association import associate
    from cohdc_train.trajectory.trajectory import Trajectory

    camera, _ = choose_camera(sequence, camera_file)
    pairs = read_pairs(sequence / "rgb.txt", sequence / "depth.txt", 0.02)[0][:num_frames]
    truth = Trajectory.load_tum(sequence / "groundtruth.txt")
    matches = associate(np.array([color.timestamp for color, _ in pairs]), truth.timestamps)
    if not len(matches):
        raise DataError(f"{sequence}: no frame within 0.02 s of a pose of groundtruth.txt")
    pairs = [pairs[i] for i in matches[:, 0]]
    times = np.array([color.timestamp for color, _ in pairs]) - pairs[0][0].timestamp
    return Recording(camera, pairs, times, truth.poses[matches[:, 1]])


def cut_out_people(folder: Path, count: int, rng: np.random.Generator) -> list[CutOut]:
    """Cut random large, whole objects of the class person out of a folder's training split.

    Raises:
        DataError: the folder has fewer of them.
    """
    from cohdc_train.data.annotations import read_image
    from cohdc_train.data.coco import read_split
    from cohdc_train.data.layout import find_split

    images = read_split("train", find_split(folder, "train"), ["person"]).images
    objects = [
        (image, one)
        for image in images
        for one in image.objects
        if not one.crowd and min(one.box[2:]) >= MIN_SIDE_PX
    ]
    if len(objects) < count:
        wanted = f"{MIN_SIDE_PX} px or more, {count} wanted"
        raise DataError(f"{folder}: {len(objects)} people of {wanted}")
    cut_outs = []
    for index in rng.permutation(len(objects))[:count]:
        image, one = objects[index]
        mask = one.mask(image.height, image.width).astype(bool)
        cut_outs.append(CutOut.from_photo(read_image(image), mask))
    return cut_outs


def draw_paths(
    people: Sequence[CutOut],
    recording: Recording,
    share: tuple[float, float],
    rng: np.random.Generator,
) -> list[WalkPath]:
    """Draw walks until people cover the wanted mean share of the pixels.

    Args:
        people: one walk is drawn for each.
        recording: frames that see them.
        share: smallest and largest share.
        rng: random generator.

    Raises:
        DataError: no draw fits.
    """
    from cohdc_train.slam.io.tum import read_depth

    views = []
    for (_, depth), pose, time in recording.frames(max(1, len(recording.pairs) // 40)):
        background = fill_depth(read_depth(depth.path, recording.camera))
        views.append((time, pose, background[::_RAY_STEP_PX, ::_RAY_STEP_PX]))
    rays = pixel_rays(recording.camera, _RAY_STEP_PX)
    for _ in range(_MAX_TRIES):
        paths = [_draw_path(rng, recording.poses) for _ in people]
        covered = covered_share(people, paths, views, rays)
        if share[0] <= covered <= share[1]:
            return paths
    wanted = f"{share[0]:g} to {share[1]:g} of the pixels"
    raise DataError(f"no walks found on which people cover {wanted}; give another --share")


def _draw_path(rng: np.random.Generator, poses: FloatArray) -> WalkPath:
    """Draw a walk across the middle of the camera's view, 0.6 to 1.4 m in front of it."""
    eye = poses[:, :3, 3].mean(0)
    forward = poses[:, :3, 2].mean(0)
    forward = forward - UP * (forward @ UP)
    forward /= np.linalg.norm(forward)
    along = np.cross(forward, UP)
    middle = eye + forward * rng.uniform(0.6, 1.4) + along * rng.uniform(-0.3, 0.3)
    middle[2] = 0.0
    amplitude, period = rng.uniform(0.3, 0.8), rng.uniform(4, 8)
    return WalkPath(middle, along, -forward, amplitude, period, rng.uniform(0, 2 * np.pi))


def covered_share(
    people: Sequence[CutOut],
    paths: Sequence[WalkPath],
    views: Sequence[tuple[float, FloatArray, Float32Array]],
    rays: FloatArray,
) -> float:
    """Return the mean share of the pixels that people cover.

    Args:
        people: the cut-outs.
        paths: where each of them walks.
        views: (time s, T_wc, background depth [H, W] m) of some frames.
        rays: [H, W, 3] of `pixel_rays`.
    """
    covered = []
    for time, pose, background in views:
        hits = [
            render(person, path, time, pose, rays)[1] < background
            for person, path in zip(people, paths, strict=True)
        ]
        covered.append(np.any(hits, axis=0).mean())
    return float(np.mean(covered))


def _write_frame(
    folder: Path,
    pair: "tuple[TimestampedImage, TimestampedImage]",
    rgb: Image,
    depth: NDArray[np.uint16],
    mask: Mask,
) -> None:
    color, depth_image = pair
    images: dict[str, NDArray[Any]] = {
        f"rgb/{color.timestamp_text}.png": rgb[..., ::-1],
        f"depth/{depth_image.timestamp_text}.png": depth,
        f"masks/{color.timestamp_text}.png": mask.astype(np.uint8) * 255,
    }
    for name, image in images.items():
        if not cv2.imwrite(str(folder / name), image):
            raise DataError(f"{folder / name}: cannot be written")


def _write_lists(
    folder: Path, pairs: "Sequence[tuple[TimestampedImage, TimestampedImage]]"
) -> None:
    for kind, index in (("rgb", 0), ("depth", 1)):
        stamps = [pair[index].timestamp_text for pair in pairs]
        lines = [f"{stamp} {kind}/{stamp}.png\n" for stamp in stamps]
        write_text(folder / f"{kind}.txt", "".join(lines))
