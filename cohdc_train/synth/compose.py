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
from cohdc_train.synth.sensor import EDGE_DROPOUT, depth_edges
from cohdc_train.types import Float32Array, FloatArray, Image, Mask

if TYPE_CHECKING:  # loaded when the command runs, so that help stays cheap
    from cohdc_train.slam.geometry.camera import Camera
    from cohdc_train.slam.io.tum import Entry

BODY_WIDTH_M, MAX_HEIGHT_M = 0.6, 1.8  # shoulders with arms, and the tallest person
HEAD_HEIGHT_M = 1.75  # top of the head above the floor
RELIEF_M = 0.12  # bulge at the middle of a body
MIN_SIDE_PX = 120  # shorter side of a cut-out's box
UP = np.array([0.0, 0.0, 1.0])  # of TUM's motion capture
_MIN_DEPTH_M = 0.3
_MAX_TRIES = 200  # draws of walking paths
_RAY_STEP_PX = 8  # grid on which the covered share is estimated


@dataclass(frozen=True)
class CutOut:
    """A photographed person on an upright plane.

    Attributes:
        layers: float32 [h, w, 5]: red, green, blue 0..255, opacity 0..1, relief in m.
        width: m.
        height: m.
    """

    layers: Float32Array
    width: float
    height: float

    @classmethod
    def from_photo(cls, rgb: Image, mask: Mask) -> "CutOut":
        """Cut a person out of a photograph. rgb: [H, W, 3]; mask: [H, W]."""
        rows, columns = np.nonzero(mask)
        window = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        rgb = np.pad(rgb[window], ((1, 1), (1, 1), (0, 0)))
        mask = np.pad(mask[window], 1)
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        relief = RELIEF_M * np.sqrt(np.clip(inside / inside.max(), 0, 1))
        layers = np.dstack([rgb, mask, relief]).astype(np.float32)
        num_rows, num_columns = mask.shape
        height = min(MAX_HEIGHT_M, BODY_WIDTH_M * num_rows / num_columns)
        return cls(layers, height * num_columns / num_rows, height)


@dataclass(frozen=True)
class WalkPath:
    """A walk back and forth across the view, in the world frame.

    Attributes:
        middle: [3], m, on the floor.
        along: [3] unit vector of the walk.
        facing: [3] unit normal of the person's plane.
        amplitude: m.
        period: s.
        phase: rad.
    """

    middle: FloatArray
    along: FloatArray
    facing: FloatArray
    amplitude: float
    period: float
    phase: float

    def position(self, time: float) -> FloatArray:
        """Return the point on the floor at a time in s: [3], m."""
        angle = 2 * np.pi * time / self.period + self.phase
        return np.asarray(self.middle + self.along * self.amplitude * np.sin(angle))


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
    pairs: "list[tuple[Entry, Entry]]"
    times: FloatArray
    poses: FloatArray

    def frames(self, step: int = 1) -> "Iterator[tuple[tuple[Entry, Entry], FloatArray, float]]":
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
    matches = associate(np.array([color.t for color, _ in pairs]), truth.timestamps)
    if not len(matches):
        raise DataError(f"{sequence}: no frame within 0.02 s of a pose of groundtruth.txt")
    pairs = [pairs[i] for i in matches[:, 0]]
    times = np.array([color.t for color, _ in pairs]) - pairs[0][0].t
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


def pixel_rays(camera: "Camera", step: int) -> FloatArray:
    """Return the direction of every step-th pixel with z = 1, undistorted: [H/step, W/step, 3]."""
    x, y = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    pixels = camera.undistort(np.stack([x.ravel(), y.ravel()], 1).astype(float))
    directions = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays = np.concatenate([directions, np.ones((len(pixels), 1))], 1)
    return rays.reshape(*x.shape, 3)


def render(
    person: CutOut, path: WalkPath, time: float, T_wc: FloatArray, rays: FloatArray
) -> tuple[Float32Array, FloatArray]:
    """Render a person as a camera sees it.

    Args:
        person: the cut-out.
        path: where it walks.
        time: s.
        T_wc: [4, 4] camera to world, m.
        rays: [H, W, 3] of `pixel_rays`.

    Returns:
        Layers [H, W, 5], and depth [H, W] in m, infinite where nothing of the person is seen.
    """
    floor, eye = path.position(time), T_wc[:3, 3]
    world = rays @ T_wc[:3, :3].T
    approach = world @ path.facing
    approach = np.where(np.abs(approach) < 1e-6, 1e-6, approach)
    depth = ((floor - eye) @ path.facing) / approach
    hit = eye + depth[..., None] * world - floor

    num_rows, num_columns = person.layers.shape[:2]
    u = ((hit @ path.along) / person.width + 0.5) * num_columns - 0.5
    v = (HEAD_HEIGHT_M - hit @ UP) / person.height * num_rows - 0.5
    u, v = u.astype(np.float32), v.astype(np.float32)
    layers = np.asarray(cv2.remap(person.layers, u, v, cv2.INTER_LINEAR, borderValue=0), np.float32)
    is_seen = (layers[..., 3] > 0) & (depth > _MIN_DEPTH_M)
    return layers, np.where(is_seen, depth - layers[..., 4], np.inf)


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
        background = fill_depth(read_depth(depth.image, recording.camera))
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


def fill_depth(depth: Float32Array) -> Float32Array:
    """Fill holes with the farthest depth around them; infinite where there is none.

    depth: [H, W], m, 0 = no reading.
    """
    filled = np.where(depth > 0, depth, cv2.dilate(depth, np.ones((9, 9), np.uint8)))
    return np.where(filled > 0, filled, np.inf).astype(np.float32)


def compose_frame(
    pair: "tuple[Entry, Entry]",
    camera: "Camera",
    layers: Sequence[tuple[Float32Array, FloatArray]],
    rng: np.random.Generator,
) -> tuple[Image, NDArray[np.uint16], Mask]:
    """Draw people into a frame, the nearest over the others.

    Args:
        pair: the color and the depth image.
        camera: the sequence's camera.
        layers: of `render`, one per person.
        rng: random generator of the sensor's noise.

    Returns:
        rgb [H, W, 3], depth [H, W] in the camera's units, and the mask of the people [H, W].
    """
    from cohdc_train.slam.io.tum import read_depth, read_rgb

    color, depth_image = pair
    rgb = read_rgb(color.image, camera).astype(np.float32)
    depth = read_depth(depth_image.image, camera)
    nearest: NDArray[np.floating] = fill_depth(depth)
    mask = np.zeros(depth.shape, np.bool_)
    brightness = rgb.mean()
    for person, z in sorted(layers, key=lambda layer: -float(np.min(layer[1]))):
        inside = person[..., 3] > 0.5
        if not inside.any():
            continue
        opacity = np.where(z < nearest, person[..., 3], 0)[..., None]
        mean = max(float(person[inside][:, :3].mean()), 1.0)
        gain = np.clip(brightness / mean, 0.7, 1.4)
        rgb = (1 - opacity) * rgb + opacity * np.clip(person[..., :3] * gain, 0, 255)
        is_person = opacity[..., 0] > 0.5
        nearest, mask = np.where(is_person, z, nearest), mask | is_person
    depth = _measure_depth(depth, nearest, mask, rng)
    units = np.rint(depth * camera.depth_scale).astype(np.uint16)
    return np.rint(rgb).astype(np.uint8), units, mask


def _measure_depth(
    depth: Float32Array, nearest: NDArray[np.floating], mask: Mask, rng: np.random.Generator
) -> Float32Array:
    """Measure the people with the sensor's noise, and drop readings at their outlines."""
    z = np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)
    sigma = 0.0012 + 0.0019 * np.square(z - 0.4)
    noisy = z + sigma * rng.standard_normal(z.shape, dtype=np.float32)
    is_dropped = depth_edges(z) & (rng.random(z.shape) < EDGE_DROPOUT)
    around = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    measured = np.where(mask, noisy, depth)
    return np.where(around & is_dropped, np.float32(0), measured)


def _write_frame(
    folder: Path,
    pair: "tuple[Entry, Entry]",
    rgb: Image,
    depth: NDArray[np.uint16],
    mask: Mask,
) -> None:
    color, depth_image = pair
    images: dict[str, NDArray[Any]] = {
        f"rgb/{color.stamp}.png": rgb[..., ::-1],
        f"depth/{depth_image.stamp}.png": depth,
        f"masks/{color.stamp}.png": mask.astype(np.uint8) * 255,
    }
    for name, image in images.items():
        if not cv2.imwrite(str(folder / name), image):
            raise DataError(f"{folder / name}: cannot be written")


def _write_lists(folder: Path, pairs: "Sequence[tuple[Entry, Entry]]") -> None:
    for kind, index in (("rgb", 0), ("depth", 1)):
        stamps = [pair[index].stamp for pair in pairs]
        lines = [f"{stamp} {kind}/{stamp}.png\n" for stamp in stamps]
        write_text(folder / f"{kind}.txt", "".join(lines))
