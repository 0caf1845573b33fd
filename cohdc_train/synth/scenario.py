"""Draw a scene from a seed: room, camera path, and the actions of all actors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from cohdc_train.errors import DataError
from cohdc_train.synth import people as bodies
from cohdc_train.synth.actor_factory import EYE_Y, ActorFactory
from cohdc_train.synth.actors import Actor
from cohdc_train.synth.camera_motion import (
    CameraMotion,
    camera_path,
)
from cohdc_train.synth.mesh import join_meshes
from cohdc_train.synth.random_streams import stream
from cohdc_train.synth.renderer import Atlas, RenderCamera, RenderedView, render
from cohdc_train.synth.room import Room
from cohdc_train.synth.room_layouts import furnished_room, loop_room, plain_room, texture_detail
from cohdc_train.types import FloatArray

Action = Literal["walk", "stop_and_go", "fill_view", "sit"]
RATE = 30.0  # frames per second
POSES_PER_FRAME = 3  # poses written per frame: 90 Hz, every third at a frame's own timestamp
SHARE = (0.26, 0.38)  # mean share of the pixels on people and cart that a scene is drawn for
CROWD, CROWD_SHARE = 6, (0.36, 0.52)  # more people are a crowd, which covers more
PEAK = 0.62  # share that no frame should exceed
EMPTY = 0.2  # share of the frames that may show nearly no actor
_COARSE_BIAS = 0.87  # exact share over coarse share, where each point fills a whole pixel
_MAX_DRAWS = 24  # of the paths, to reach these shares


@dataclass(frozen=True)
class SceneConfig:
    """Events in the room.

    Args:
        action: of the people. walk: they cross the view again and again; stop_and_go: they stand
            still for seconds, then walk on; fill_view: one comes up to the camera and fills its
            view for a while, the others walk; sit: they sit and move a little.
        cart: a loaded cart that moves back and forth across the view, alone or pushed by the first
            of the people.
        walls: textured and hung with posters, or plain.
    """

    action: Action = "walk"
    cart: Literal["none", "alone", "pushed"] = "none"
    walls: Literal["textured", "plain"] = "textured"

    def check(self, motion: str, people: int) -> None:
        """Raise DataError for values that are unknown or do not go together."""
        known = {name: get_args(kind.type) for name, kind in self.__dataclass_fields__.items()}
        for name, values in known.items():
            if getattr(self, name) not in values:
                raise DataError(
                    f"scene.{name}: {getattr(self, name)!r} is none of {', '.join(values)}"
                )
        if self.cart == "pushed" and people < 1:
            raise DataError("scene.cart: pushed, but there are 0 people to push it")
        if motion == "loop" and self != SceneConfig():
            raise DataError(
                "motion: a loop goes with people who walk in a textured room, without a cart"
            )


@dataclass(frozen=True)
class RenderedScene:
    """Everything that a sequence shows, as functions of the frame number.

    Attributes:
        room: walls and furniture.
        actors: people and movable objects.
        camera: intrinsics.
        groundtruth: [3 (n - 1) + 1, 4, 4] T_wc, m, at 90 Hz: every third pose is a frame's own.
        metered: frames whose brightness sets the exposure of all.
    """

    room: Room
    actors: tuple[Actor, ...]
    camera: RenderCamera
    groundtruth: FloatArray
    metered: tuple[int, ...] = (0,)

    @property
    def poses(self) -> FloatArray:
        """Camera poses of the frames, [n, 4, 4] T_wc, m."""
        return self.groundtruth[::POSES_PER_FRAME]

    def atlas(self) -> Atlas:
        """Return the textures of room and actors."""
        return Atlas(
            [*self.room.textures, *(look for actor in self.actors for look in actor.textures)]
        )

    def render_frame(self, frame: int, atlas: Atlas) -> RenderedView:
        """Render a frame as a perfect camera sees it; actors are instances 1.. in their order."""
        meshes, first = [self.room.mesh], len(self.room.textures)
        for k, actor in enumerate(self.actors):
            meshes.append(actor.mesh(frame).as_instance(k + 1, first))
            first += len(actor.textures)
        return render(
            join_meshes(meshes), atlas, self.room.lighting, self.camera, self.poses[frame]
        )


def draw_scene(
    seed: int,
    frames: int,
    size: tuple[int, int],
    motion: CameraMotion,
    people: int,
    setting: SceneConfig | None = None,
) -> RenderedScene:
    """Draw the room, the camera path and the actors, who cover 20-40 % of the pixels on average.

    Paths are drawn again, nearer or farther, until a coarse rendering of them fits SHARE (a crowd:
    CROWD_SHARE), PEAK and EMPTY; the best is taken. A person who fills the view does not count
    there.

    Args:
        seed: of all random numbers.
        frames: number of frames.
        size: (height, width), px.
        motion: of the camera.
        people: number of people.
        setting: events in the room.
    """
    setting = setting or SceneConfig()
    # apart from the room's stream, whose draws depend on the size of its textures
    rng = stream(seed, "sequence", 1)
    length, height = float(rng.uniform(4.9, 5.5)), float(rng.uniform(2.5, 2.8))
    room = _room(
        seed,
        (7.5, length + 2.0 * (motion == "loop"), height),
        texture_detail(size),
        motion,
        setting,
    )
    fine = np.arange(POSES_PER_FRAME * (frames - 1) + 1) / (RATE * POSES_PER_FRAME)
    middle = room.size[1] / 2 if motion == "loop" else EYE_Y
    truth = camera_path(rng, fine, motion, np.array([0.0, middle, rng.uniform(1.25, 1.5)]))
    cast = [bodies.draw_person(rng, patterned=1.0) for _ in range(people)]
    factory = ActorFactory(rng, fine[::POSES_PER_FRAME], truth[::POSES_PER_FRAME], motion)
    is_empty = people == 0 and setting.cart == "none"
    metered = tuple(k * frames // 5 for k in range(5)) if motion == "loop" else (0,)
    is_fitted = not is_empty and setting.action != "fill_view"

    def draw(nearest: float) -> RenderedScene:
        return RenderedScene(
            room,
            _actors(factory, setting, cast, nearest),
            RenderCamera.freiburg3(size),
            truth,
            metered,
        )

    return _best_scene(draw, people) if is_fitted else draw(1.3)


def _room(
    seed: int,
    size: tuple[float, float, float],
    detail: int,
    motion: CameraMotion,
    setting: SceneConfig,
) -> Room:
    rng = stream(seed, "sequence")
    if motion == "loop":
        return loop_room(rng, size, detail)
    return (
        plain_room(rng, size, detail)
        if setting.walls == "plain"
        else furnished_room(rng, size, 3.4, detail)
    )


def _actors(
    factory: ActorFactory, setting: SceneConfig, cast: list[bodies.Person], nearest: float
) -> tuple[Actor, ...]:
    """Return all actors, the nearest `nearest` m from the eye: people first, objects last."""
    pushers = 1 if setting.cart == "pushed" else 0
    others = cast[pushers:]
    distances = nearest + min(0.35, 2.0 / max(len(others) - 1, 1)) * np.arange(
        len(others), dtype=np.float64
    )
    distances += 0.0 if setting.cart == "none" else 0.9
    act = {
        "walk": factory.crowd,
        "stop_and_go": factory.stopping,
        "fill_view": factory.filling,
        "sit": factory.seated,
    }
    actors = act[setting.action](others, distances)
    if setting.cart != "none":
        actors += factory.rolling(cast[:pushers], nearest)
    return tuple(sorted(actors, key=lambda actor: not actor.is_person))


def _best_scene(draw: Callable[[float], RenderedScene], people: int) -> RenderedScene:
    """Return the best of some draws at distances that approach the wanted share."""
    wanted, peak_wanted = (CROWD_SHARE, 0.8) if people > CROWD else (SHARE, PEAK)
    nearest = 1.3
    candidates: list[tuple[float, RenderedScene]] = []
    for _ in range(_MAX_DRAWS):
        scene = draw(nearest)
        shares = _coarse_coverage(scene)
        mean, peak = float(shares.mean()), float(shares.max())
        empty = float(np.mean(shares < 0.05))
        off = max(wanted[0] - mean, mean - wanted[1], 0.0)
        cost = off + 0.5 * max(peak - peak_wanted, 0.0) + 0.5 * max(empty - EMPTY, 0.0)
        candidates.append((cost, scene))
        if cost == 0:
            break
        nearer = np.sqrt(max(mean, 0.02) / np.mean(wanted)) if peak <= peak_wanted else 1.05
        nearest = float(np.clip(nearest * nearer, 0.8 + 0.1 * min(people, CROWD), 1.6))
    _, best = min(candidates, key=lambda candidate: candidate[0])
    return best


def _coarse_coverage(scene: RenderedScene) -> FloatArray:
    """Return the approximate share of pixels on actors in every sixth frame, at 64 px."""
    camera = scene.camera.resized(64 / scene.camera.width)
    shares = []
    for k in range(0, len(scene.poses), 6):
        pose = scene.poses[k]
        seen = np.zeros((camera.height, camera.width), dtype=np.uint8)
        for actor in scene.actors:
            ray = (actor.points(k) - pose[:3, 3]) @ pose[:3, :3]
            ray = ray[ray[:, 2] > 0.1]
            u = np.rint(ray[:, 0] / ray[:, 2] * camera.fx + camera.cx).astype(int)
            v = np.rint(ray[:, 1] / ray[:, 2] * camera.fy + camera.cy).astype(int)
            inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
            seen[v[inside], u[inside]] = 1
        shares.append(cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)).mean())
    return _COARSE_BIAS * np.array(shares)
