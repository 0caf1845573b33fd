"""Scenes: visible share of actors, moving and static ones, and repeatability for a seed."""

import hashlib
import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from cohdc_train.cli import main
from cohdc_train.errors import DataError
from cohdc_train.synth import sequence
from cohdc_train.synth.actors import Walker, max_speed
from cohdc_train.synth.camera_motion import CameraMotion
from cohdc_train.synth.renderer import RenderCamera, RenderedView, render
from cohdc_train.synth.scenario import RenderedScene, SceneConfig, draw_scene

pytest.importorskip("embreex")

SIZE = (48, 64)
FRAMES = 150


def scene_of(
    motion: CameraMotion, people: int, frames: int = FRAMES, **setting: str
) -> RenderedScene:
    return draw_scene(8, frames, SIZE, motion, people, SceneConfig(**setting))  # type: ignore[arg-type]


def views(scene: RenderedScene, step: int) -> list[RenderedView]:
    atlas = scene.atlas()
    return [scene.render_frame(k, atlas) for k in range(0, len(scene.poses), step)]


def people_in(scene: RenderedScene, view: RenderedView) -> float:
    """Return the share of the pixels on people."""
    return float(
        np.array([False, *(actor.is_person for actor in scene.actors)])[view.instance].mean()
    )


@pytest.mark.parametrize(
    ("motion", "people", "setting"),
    [
        ("xyz", 9, {}),
        ("xyz", 2, {"walls": "plain"}),
        ("xyz", 3, {"action": "stop_and_go"}),
        ("halfsphere", 3, {"action": "sit"}),
    ],
)
def test_people_cover_a_fifth_to_three_fifths_where_there_are_any(
    motion: CameraMotion, people: int, setting: dict[str, str]
) -> None:
    scene = scene_of(motion, people, **setting)
    assert sum(actor.is_person for actor in scene.actors) == people
    check_shares(scene)


def check_shares(scene: RenderedScene) -> None:
    shares = np.array([people_in(scene, view) for view in views(scene, len(scene.poses) // 15)])
    seen = shares > 0.03
    assert seen.mean() > 0.5
    assert 0.2 < shares[seen].mean() < 0.6
    assert shares.max() < 0.8


def test_one_person_fills_the_view_for_some_time() -> None:
    scene = scene_of("xyz", 2, action="fill_view")
    shares = np.array([people_in(scene, view) for view in views(scene, 5)])
    assert np.all(shares[14:18] > 0.7), "a second and more"
    assert shares[0] < 0.5
    assert shares[-1] < 0.5


def test_cart_alone_moves_but_is_no_person(tmp_path: Path) -> None:
    sequence(
        tmp_path / "s", frames=90, size=SIZE, seed=7, people=0, scene=SceneConfig(cart="alone")
    )

    def shares(folder: str) -> np.ndarray:
        return np.array(
            [
                (cv2.imread(str(p), 0) == 255).mean()
                for p in sorted((tmp_path / "s" / folder).iterdir())
            ]
        )

    moving = shares("movers")
    assert np.all(shares("masks") == 0)
    assert moving[0] == 0, "it stands in the beginning"
    assert moving[moving > 0].mean() > 0.15
    assert moving.max() < 0.7
    info = json.loads((tmp_path / "s" / "info.json").read_text())
    assert info["movers"]["mean"] == pytest.approx(moving.mean())
    assert info["share"]["max"] == 0
    assert info["scene"] == {"action": "walk", "cart": "alone", "walls": "textured"}


def test_cart_is_pushed_across_the_view_and_changes_the_depth_there() -> None:
    scene = scene_of("static", 1, cart="pushed")
    pusher, cart = scene.actors
    assert (pusher.is_person, cart.is_person) == (True, False)
    places = np.array([cart.mesh(k).corners.mean(axis=(0, 1)) for k in range(0, FRAMES, 10)])
    assert np.ptp(places[:, 0]) > 1.2
    moving = [max_speed(cart, k, FRAMES, 30) for k in range(0, FRAMES, 10)]
    assert min(moving) == 0
    assert 0.5 < max(moving) < 1
    seen = views(scene, 30)
    changed = np.mean([np.abs(a.depth - b.depth) > 0.2 for a, b in itertools.pairwise(seen)])
    assert changed > 0.2, "a camera that hardly moves sees other depths"
    hands = pusher.mesh(60).corners.reshape(-1, 3)
    assert np.linalg.norm(hands - places[6], axis=1).min() < 0.9, (
        "the pusher's hands reach the cart"
    )


def test_stopped_person_does_not_move_and_then_walks() -> None:
    scene = scene_of("xyz", 2, action="stop_and_go")
    for actor in scene.actors:
        speed = np.array([max_speed(actor, k, FRAMES, 30) for k in range(0, FRAMES, 6)])
        assert np.all(speed[:3] == 0)
        assert speed.max() > 0.5


def test_seated_people_hardly_move_and_chairs_stay() -> None:
    scene = scene_of("static", 3, action="sit")
    people, chairs = scene.actors[:3], scene.actors[3:]
    assert len(chairs) == 3
    frames = range(0, FRAMES, 9)
    speeds = np.array([[max_speed(actor, k, FRAMES, 30) for k in frames] for actor in people])
    assert speeds.min(axis=1).min() > 0, "nobody is a statue"
    assert np.mean(speeds > 0.05) < 0.4, "but most of the time they are still"
    assert all(max_speed(chair, k, FRAMES, 30) == 0 for chair in chairs for k in frames)
    for person in people:
        corners = np.stack([person.mesh(k).corners for k in frames])
        assert np.ptp(corners.mean(axis=(1, 2)), axis=0).max() < 0.06
        assert corners[..., 2].max() < 1.6, "seated"


def test_plain_walls_give_few_corners() -> None:
    def corners(walls: str) -> int:
        scene = draw_scene(7, 2, (240, 320), "static", 0, SceneConfig(walls=walls))  # type: ignore[arg-type]
        view = scene.render_frame(0, scene.atlas())
        upper = np.clip(view.rgb[:120] / view.rgb.mean() * 90, 0, 255).astype(np.uint8)
        return len(cv2.FastFeatureDetector_create(12).detect(upper))

    assert corners("plain") < 0.2 * corners("textured")


@pytest.fixture(scope="module")
def loop() -> RenderedScene:
    return scene_of("loop", 2, 300)


def test_loop_sees_furniture_in_every_direction_and_its_first_view_again(
    loop: RenderedScene,
) -> None:
    atlas, camera = loop.atlas(), RenderCamera.freiburg3((96, 128))

    def render_frame(k: int) -> RenderedView:
        return render(loop.room.mesh, atlas, loop.room.lighting, camera, loop.poses[k])

    first, half, last = (render_frame(k) for k in (0, 140, 299))
    other_way, again = (
        float(np.median(np.abs(first.depth - later.depth))) for later in (half, last)
    )
    assert again < 0.1
    assert other_way > 0.25
    for view in map(render_frame, range(0, 300, 40)):
        assert view.depth.max() < 6, "within the sensor's reach, or nearly"
        assert view.rgb.std() > 0.1 * view.rgb.mean()


def test_people_of_a_loop_cross_its_view_and_keep_off_the_walls(loop: RenderedScene) -> None:
    check_shares(loop)
    width, length, _ = loop.room.size
    for actor in loop.actors:
        assert isinstance(actor, Walker)
        place = actor.walk.position
        assert np.abs(place[:, 0]).max() < width / 2 - 0.5
        assert np.abs(place[:, 1] - length / 2).max() < length / 2 - 0.5


@pytest.mark.parametrize(
    "options",
    [
        {"motion": "loop", "people": 1},
        {"people": 2, "scene": SceneConfig(cart="pushed", action="stop_and_go", walls="plain")},
        {"people": 2, "scene": SceneConfig(action="sit")},
        {"people": 2, "scene": SceneConfig(action="fill_view")},
    ],
)
def test_same_seed_same_bytes(tmp_path: Path, options: dict[str, object]) -> None:
    def digests(name: str, seed: int) -> dict[str, str]:
        sequence(tmp_path / name, frames=2, size=SIZE, seed=seed, **options)  # type: ignore[arg-type]
        files = sorted(p for p in (tmp_path / name).rglob("*") if p.is_file())
        return {
            str(p.relative_to(tmp_path / name)): hashlib.sha256(p.read_bytes()).hexdigest()
            for p in files
        }

    first, again, other = digests("a", 7), digests("b", 7), digests("c", 11)
    assert first == again
    assert all(first[name] != other[name] for name in first if name.startswith(("rgb/", "depth/")))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"scene": SceneConfig(action="dance")},
            "scene.action: 'dance' is none of walk, stop_and_go, fill_view, sit",
        ),  # type: ignore[arg-type]
        (
            {"scene": SceneConfig(cart="pushed"), "people": 0},
            "scene.cart: pushed, but there are 0 people",
        ),
        ({"scene": SceneConfig(walls="plain"), "motion": "loop"}, "motion: a loop goes with"),
        ({"people": 13}, "people: 13 is not in 0..12"),
    ],
)
def test_invalid_scene_is_refused_in_one_line(
    tmp_path: Path, options: dict[str, object], message: str
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        sequence(tmp_path / "s", **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_command_takes_the_scene(tmp_path: Path) -> None:
    options = ["--frames", "2", "--size", "[48, 64]", "--people", "1", "--motion", "static"]
    assert main(["synth", "sequence", str(tmp_path / "s"), *options, "--scene.action", "sit"]) == 0
    assert json.loads((tmp_path / "s" / "info.json").read_text())["scene"]["action"] == "sit"
    with pytest.raises(SystemExit):
        main(["synth", "sequence", str(tmp_path / "t"), *options, "--scene.action", "fly"])
