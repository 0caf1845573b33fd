"""`cohdc synth sequence`: an RGB-D sequence of people walking through a room, in TUM's layout, with its truth."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.files import new_folder
from cohdc_train.synth import people as bodies
from cohdc_train.synth.mesh import Mesh, join, yaw_rotation
from cohdc_train.synth.motion import MOTIONS, CameraMotion, Doubles, Walk, camera_path, crowd
from cohdc_train.synth.renderer import Atlas, Camera, View, render
from cohdc_train.synth.scene import Room, furnished_room, texture_detail
from cohdc_train.synth.sensor import DEPTH_SCALE, exposure, measure_depth, photograph
from cohdc_train.synth.streams import stream

RATE = 30.0  # frames per second
FIRST_STAMP = 1305031102.175304  # s
TRUTH_PER_FRAME = 3  # poses written per frame: 90 Hz, every third at a frame's own stamp
SHARE = (0.26, 0.38)  # mean share of person pixels a scene is drawn for
PEAK = 0.62  # share of person pixels no frame should exceed
_COARSE_BIAS = 0.87  # exact over coarse share: pixels touched by a point count as whole ones
EMPTY = 0.2  # share of the frames that may show next to nobody
_DRAWS = 24  # how often the ways are drawn anew to get there
_REACH = {"xyz": 0.75, "halfsphere": 1.2, "static": 0.6, "rpy": 1.2}  # m beyond the view's border where people turn
_EYE_Y = 0.9  # m from the wall behind the camera


@dataclass(frozen=True)
class Scene:
    """Everything a sequence shows, as functions of the frame number.

    truth: [3 (n - 1) + 1, 4, 4] T_wc, m, at 90 Hz: every third pose is a frame's own.
    """

    room: Room
    people: tuple[bodies.Person, ...]
    walks: tuple[Walk, ...]
    camera: Camera
    truth: Doubles

    @property
    def poses(self) -> Doubles:
        """[n, 4, 4] T_wc of the frames, m."""
        return self.truth[::TRUTH_PER_FRAME]

    def crowd(self, frame: int) -> list[Mesh]:
        """The people's triangles at `frame`, as instances 1.., their textures after the room's."""
        first = len(self.room.textures)
        meshes = []
        for k, (person, way) in enumerate(zip(self.people, self.walks, strict=True)):
            phase = 2 * np.pi * way.travelled[frame] / bodies.stride(person)
            pose = bodies.walking(float(phase), float(way.pace[frame]))
            place = (float(way.position[frame, 0]), float(way.position[frame, 1]) + _EYE_Y)
            mesh = bodies.person_mesh(person, pose, place, float(way.heading[frame]))
            meshes.append(mesh.named(k + 1, first + k * len(person.textures)))
        return meshes

    def atlas(self) -> Atlas:
        """The textures of room and people."""
        return Atlas([*self.room.textures, *(look for person in self.people for look in person.textures)])

    def view(self, frame: int, atlas: Atlas) -> View:
        """The frame as a perfect camera sees it."""
        mesh = join([self.room.mesh, *self.crowd(frame)])
        return render(mesh, atlas, self.room.lighting, self.camera, self.poses[frame])


def draw_scene(seed: int, frames: int, size: tuple[int, int], motion: CameraMotion, people: int) -> Scene:
    """Draw the room, the camera's path and the people's ways, so that people cover 20-40 % of the pixels on average.

    size: (height, width) px. Ways are drawn again, nearer or farther, until a coarse rendering of them fits SHARE,
    PEAK and EMPTY; the best is taken.
    """
    rng = stream(seed, "sequence", 1)  # apart from the room's, whose draws depend on the size of its textures
    room_size = (7.5, float(rng.uniform(4.9, 5.5)), float(rng.uniform(2.5, 2.8)))
    room = furnished_room(stream(seed, "sequence"), room_size, 3.4, texture_detail(size))
    fine = np.arange(TRUTH_PER_FRAME * (frames - 1) + 1) / (RATE * TRUTH_PER_FRAME)
    eye = np.array([0.0, _EYE_Y, rng.uniform(1.25, 1.5)])
    truth = camera_path(rng, fine, motion, eye)
    cast = tuple(bodies.draw_person(rng, patterned=1.0) for _ in range(people))
    figures = [bodies.person_mesh(person, bodies.walking(0.6), (0.0, 0.0), 0.0) for person in cast]
    nearest = 1.3
    best: tuple[float, Scene] | None = None
    for _ in range(_DRAWS if people else 1):
        distances = nearest + 0.35 * np.arange(people, dtype=np.float64)
        walks = crowd(rng, fine[::TRUTH_PER_FRAME], distances, _REACH[motion]) if people else ()
        scene = Scene(room, cast, walks, Camera.freiburg3(size), truth)
        shares = _coarse_shares(scene, figures)
        mean, peak, empty = float(shares.mean()), float(shares.max()), float(np.mean(shares < 0.05))
        cost = max(SHARE[0] - mean, mean - SHARE[1], 0.0) + 0.5 * max(peak - PEAK, 0.0) + 0.5 * max(empty - EMPTY, 0.0)
        if best is None or cost < best[0]:
            best = (cost, scene)
        if cost == 0:
            break
        nearer = np.sqrt(max(mean, 0.02) / np.mean(SHARE)) if peak <= PEAK else 1.05
        nearest = float(np.clip(nearest * nearer, 0.8 + 0.1 * people, 1.6))
    assert best is not None
    return best[1]


def _coarse_shares(scene: Scene, figures: list[Mesh]) -> Doubles:
    """About the share of person pixels in every sixth frame: the points of `figures`, people in one pose, on 64 px."""
    camera = scene.camera.resized(64 / scene.camera.width)
    blends = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [1 / 3] * 3])
    points = [np.einsum("bk,tki->tbi", blends, figure.corners).reshape(-1, 3) for figure in figures]
    shares = []
    for k in range(0, len(scene.poses), 6):
        pose = scene.poses[k]
        seen = np.zeros((camera.height, camera.width), dtype=np.uint8)
        for body, way in zip(points, scene.walks, strict=True):
            place = np.array([way.position[k, 0], way.position[k, 1] + _EYE_Y, 0.0])
            ray = (body @ yaw_rotation(way.heading[k]).T + place - pose[:3, 3]) @ pose[:3, :3]
            ray = ray[ray[:, 2] > 0.1]
            u = np.rint(ray[:, 0] / ray[:, 2] * camera.fx + camera.cx).astype(int)
            v = np.rint(ray[:, 1] / ray[:, 2] * camera.fy + camera.cy).astype(int)
            inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
            seen[v[inside], u[inside]] = 1
        shares.append(cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)).mean())
    return _COARSE_BIAS * np.array(shares)


def sequence(
    out: Path,
    frames: int = 240,
    size: tuple[int, int] = (480, 640),
    seed: int = 0,
    motion: CameraMotion = "xyz",
    people: int = 3,
) -> None:
    """Render an RGB-D sequence with walking people in TUM's layout (rgb/, depth/, rgb.txt, depth.txt, groundtruth.txt).

    Beside TUM's files: masks/ (255 = person), camera.yaml, info.json (share of person pixels per frame).

    Args:
        out: new or empty folder.
        frames: number of frames, at 30 per second; at least 2.
        size: height and width of the images, px; at least 48 each.
        seed: same seed, same bytes.
        motion: camera motion as in TUM's walking sequences.
        people: how many walk about, 0 to 6.
    """
    _check(frames, size, seed, motion, people)
    scene = draw_scene(seed, frames, size, motion, people)
    with new_folder(out) as draft:
        shares = _write_frames(draft, scene, seed)
        title = f"synthetic_walking_{motion}, seed {seed}"
        _write_lists(draft, frames, title)
        _write_truth(draft / "groundtruth.txt", scene.truth, title)
        _write_camera(draft / "camera.yaml", scene.camera)
        info: dict[str, object] = {
            "seed": seed,
            "motion": motion,
            "people": people,
            "frames": frames,
            "size": list(size),
        }
        share = {"mean": float(shares.mean()), "min": float(shares.min()), "max": float(shares.max())}
        info |= {"share": share, "share_per_frame": [round(float(s), 5) for s in shares]}
        (draft / "info.json").write_text(json.dumps(info, indent=1) + "\n")
    print(f"{out}: {frames} frames; people cover {shares.mean():.1%} ({shares.min():.1%}-{shares.max():.1%}) of each")


def _check(frames: int, size: tuple[int, int], seed: int, motion: str, people: int) -> None:
    if frames < 2:
        raise DataError(f"frames: {frames} is too few; a sequence has at least 2")
    if min(size) < 48:
        raise DataError(f"size: {size[0]} x {size[1]} px is too small; height and width are at least 48")
    if seed < 0:
        raise DataError(f"seed: {seed} is negative")
    if motion not in MOTIONS:
        raise DataError(f"motion: {motion!r} is none of {', '.join(MOTIONS)}")
    if not 0 <= people <= 6:
        raise DataError(f"people: {people} is not in 0..6")


def stamps(frames: int) -> list[str]:
    """The frames' time stamps as TUM writes them: seconds with six decimals."""
    return [f"{FIRST_STAMP + k / RATE:.6f}" for k in range(frames)]


def _write_frames(folder: Path, scene: Scene, seed: int) -> Doubles:
    """Write rgb/, depth/ and masks/; returns the share of person pixels per frame."""
    for name in ("rgb", "depth", "masks"):
        (folder / name).mkdir()
    rng = stream(seed, "sequence", 2)
    atlas = scene.atlas()
    gain = np.float32(exposure(scene.view(0, atlas).rgb))
    shares = []
    for k, stamp in enumerate(stamps(len(scene.poses))):
        view = scene.view(k, atlas)
        rgb = photograph(view.rgb * gain, rng, blur=0.6 * scene.camera.width / 640)
        person = view.instance > 0
        _write_png(folder / "rgb" / f"{stamp}.png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        _write_png(folder / "depth" / f"{stamp}.png", measure_depth(view, rng))
        _write_png(folder / "masks" / f"{stamp}.png", person.astype(np.uint8) * 255)
        shares.append(float(person.mean()))
    return np.array(shares)


def _write_png(path: Path, image: NDArray[Any]) -> None:
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, 2]):
        raise DataError(f"{path}: cannot be written")


def _write_lists(folder: Path, frames: int, title: str) -> None:
    for kind, content in (("rgb", "color images"), ("depth", "depth maps")):
        lines = [f"# {content}", f"# file: '{title}'", "# timestamp filename"]
        lines += [f"{stamp} {kind}/{stamp}.png" for stamp in stamps(frames)]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")


def _write_truth(path: Path, truth: Doubles, title: str) -> None:
    """T_wc as `stamp tx ty tz qx qy qz qw`, m, at 90 Hz."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(truth[:, :3, :3]).as_quat()
    lines = ["# ground truth trajectory", f"# file: '{title}'", "# timestamp tx ty tz qx qy qz qw"]
    for k, (position, quaternion) in enumerate(zip(truth[:, :3, 3], quaternions, strict=True)):
        numbers = " ".join(f"{v:.7f}" for v in (*position, *quaternion))
        lines.append(f"{FIRST_STAMP + k / (RATE * TRUTH_PER_FRAME):.6f} {numbers}")
    path.write_text("\n".join(lines) + "\n")


def _write_camera(path: Path, camera: Camera) -> None:
    values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    lines = [f"{name}: {value:.6f}" for name, value in values.items()]
    lines += [f"width: {camera.width}", f"height: {camera.height}", f"depth_scale: {DEPTH_SCALE:.1f}"]
    path.write_text("\n".join(lines) + "\n")
