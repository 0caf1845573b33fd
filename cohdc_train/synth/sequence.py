"""Render an RGB-D sequence of people in a room, in TUM's layout: `cohdc synth sequence`."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.files import new_folder
from cohdc_train.synth.actors import max_speed
from cohdc_train.synth.camera_motion import MOTIONS, CameraMotion
from cohdc_train.synth.option_checks import check_size_and_seed
from cohdc_train.synth.random_streams import stream
from cohdc_train.synth.renderer import RenderCamera
from cohdc_train.synth.scenario import POSES_PER_FRAME, RATE, RenderedScene, SceneConfig, draw_scene
from cohdc_train.synth.sensor import DEPTH_SCALE, add_sensor_noise, exposure_gain, measure_depth
from cohdc_train.types import FloatArray

FIRST_TIMESTAMP = 1305031102.175304  # s
MIN_MOVING_SPEED = 0.05  # m/s, of the fastest point of an actor that moves
MAX_PEOPLE = 12


def sequence(
    out: Path,
    frames: int = 240,
    size: tuple[int, int] = (480, 640),
    seed: int = 0,
    motion: CameraMotion = "xyz",
    people: int = 3,
    scene: SceneConfig = SceneConfig(),  # noqa: B008 - frozen; jsonargparse reads its defaults
) -> None:
    """Render an RGB-D sequence with people in TUM's layout.

    Writes rgb/, depth/, rgb.txt, depth.txt and groundtruth.txt, and further masks/ (255 = person),
    movers/ (255 = moves in this frame: not a person who stands or sits still, but a cart that
    rolls), camera.yaml and info.json (share of person pixels per frame).

    Args:
        out: new or empty folder.
        frames: number of frames, at 30 per second; at least 2.
        size: height and width of the images, px; at least 48 each.
        seed: same seed, same bytes.
        motion: camera motion as in TUM's walking sequences; loop: once round the room (give it 300
            frames and more).
        people: how many there are, 0 to 12; more than 6 are a crowd.
        scene: events in the room.
    """
    _check(frames, size, seed, motion, people)
    scene.check(motion, people)
    drawn = draw_scene(seed, frames, size, motion, people, scene)
    with new_folder(out) as draft:
        shares, moving = _write_frames(draft, drawn, seed)
        action = "walking" if scene.action == "walk" else scene.action
        title = f"synthetic_{action}_{motion}, seed {seed}"
        _write_lists(draft, frames, title)
        _write_groundtruth(draft / "groundtruth.txt", drawn.groundtruth, title)
        _write_camera(draft / "camera.yaml", drawn.camera)
        info: dict[str, object] = {
            "seed": seed,
            "motion": motion,
            "people": people,
            "frames": frames,
            "size": list(size),
            "scene": asdict(scene),
            "share": _statistics(shares),
            "share_per_frame": [round(float(s), 5) for s in shares],
            "movers": _statistics(moving),
        }
        (draft / "info.json").write_text(json.dumps(info, indent=1) + "\n")
    covered = f"people cover {shares.mean():.1%} ({shares.min():.1%}-{shares.max():.1%}) of each"
    print(f"{out}: {frames} frames; {covered}, {moving.mean():.1%} moves")


def _statistics(shares: FloatArray) -> dict[str, float]:
    return {"mean": float(shares.mean()), "min": float(shares.min()), "max": float(shares.max())}


def _check(frames: int, size: tuple[int, int], seed: int, motion: str, people: int) -> None:
    if frames < 2:
        raise DataError(f"frames: {frames} is too few; a sequence has at least 2")
    check_size_and_seed(size, seed)
    if motion not in MOTIONS:
        raise DataError(f"motion: {motion!r} is none of {', '.join(MOTIONS)}")
    if not 0 <= people <= MAX_PEOPLE:
        raise DataError(f"people: {people} is not in 0..{MAX_PEOPLE}")


def timestamps(frames: int) -> list[str]:
    """Return the timestamps of the frames as TUM writes them: seconds with six decimals."""
    return [f"{FIRST_TIMESTAMP + k / RATE:.6f}" for k in range(frames)]


def _write_frames(folder: Path, scene: RenderedScene, seed: int) -> tuple[FloatArray, FloatArray]:
    """Write rgb/, depth/, masks/ and movers/, and return the shares of person and moving pixels."""
    for name in ("rgb", "depth", "masks", "movers"):
        (folder / name).mkdir()
    rng = stream(seed, "sequence", 2)
    atlas, frames = scene.atlas(), len(scene.poses)
    gain = np.float32(
        np.mean([exposure_gain(scene.render_frame(k, atlas).rgb) for k in scene.metered])
    )
    shares = []
    for k, timestamp in enumerate(timestamps(frames)):
        view = scene.render_frame(k, atlas)
        rgb = add_sensor_noise(view.rgb * gain, rng, blur=0.6 * scene.camera.width / 640)
        person = np.array([False, *(actor.is_person for actor in scene.actors)])[view.instance]
        moves = np.array(
            [
                False,
                *(max_speed(actor, k, frames, RATE) > MIN_MOVING_SPEED for actor in scene.actors),
            ]
        )[view.instance]
        _write_png(folder / "rgb" / f"{timestamp}.png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        _write_png(folder / "depth" / f"{timestamp}.png", measure_depth(view, rng))
        _write_png(folder / "masks" / f"{timestamp}.png", person.astype(np.uint8) * 255)
        _write_png(folder / "movers" / f"{timestamp}.png", moves.astype(np.uint8) * 255)
        shares.append((person.mean(), moves.mean()))
    people, moving = np.array(shares, dtype=np.float64).T
    return people, moving


def _write_png(path: Path, image: NDArray[Any]) -> None:
    if not cv2.imwrite(
        str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, 2]
    ):
        raise DataError(f"{path}: cannot be written")


def _write_lists(folder: Path, frames: int, title: str) -> None:
    for kind, content in (("rgb", "color images"), ("depth", "depth maps")):
        lines = [f"# {content}", f"# file: '{title}'", "# timestamp filename"]
        lines += [f"{timestamp} {kind}/{timestamp}.png" for timestamp in timestamps(frames)]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")


def _write_groundtruth(path: Path, truth: FloatArray, title: str) -> None:
    """Write T_wc as `timestamp tx ty tz qx qy qz qw`, m, at 90 Hz."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(truth[:, :3, :3]).as_quat()
    lines = ["# ground truth trajectory", f"# file: '{title}'", "# timestamp tx ty tz qx qy qz qw"]
    for k, (position, quaternion) in enumerate(zip(truth[:, :3, 3], quaternions, strict=True)):
        numbers = " ".join(f"{v:.7f}" for v in (*position, *quaternion))
        lines.append(f"{FIRST_TIMESTAMP + k / (RATE * POSES_PER_FRAME):.6f} {numbers}")
    path.write_text("\n".join(lines) + "\n")


def _write_camera(path: Path, camera: RenderCamera) -> None:
    values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    lines = [f"{name}: {value:.6f}" for name, value in values.items()]
    lines += [
        f"width: {camera.width}",
        f"height: {camera.height}",
        f"depth_scale: {DEPTH_SCALE:.1f}",
    ]
    path.write_text("\n".join(lines) + "\n")
