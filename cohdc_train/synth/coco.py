"""Render people in rooms with exact masks as a COCO-format folder: `cohdc synth coco`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cohdc_train.drawing import write_jpeg
from cohdc_train.errors import DataError
from cohdc_train.files import new_folder
from cohdc_train.synth import people as bodies
from cohdc_train.synth.coco_annotation import annotate
from cohdc_train.synth.mesh import join_meshes
from cohdc_train.synth.option_checks import check_size_and_seed
from cohdc_train.synth.random_streams import stream
from cohdc_train.synth.renderer import Atlas, RenderCamera, render
from cohdc_train.synth.room import Lighting, Room
from cohdc_train.synth.room_layouts import furnished_room, texture_detail
from cohdc_train.synth.sensor import add_sensor_noise, blur_motion, exposure_gain
from cohdc_train.types import Float32Array, FloatArray, Image, Int32Array, Mask

IMAGES_PER_ROOM = 5
PEOPLE_PER_ROOM = 3
# Share of the image's pixels; a smaller visible part of a person is annotated as a crowd.
SMALLEST_SHARE = 1 / 200
SUPERSAMPLING = 1.5
# m: nearer, the camera would stand in a person; farther, people would stand outside the room.
NEAREST, FARTHEST = 0.35, 6.0
DISTANCE = (0.7, 3.7)  # m, of people from the camera
_JPEG_QUALITY = 92
_COUNT_CHANCE = (0.08, 0.42, 0.34, 0.16)  # of 0, 1, .. 3 people


@dataclass(frozen=True)
class LabeledImage:
    """Rendered image with its masks.

    Attributes:
        image: [H, W, 3] uint8 RGB.
        masks: [n, H, W] bool, the visible part of every person who has one.
    """

    image: Image
    masks: Mask


@dataclass(frozen=True)
class PopulatedRoom:
    """A room with the people who may appear in it."""

    room: Room
    people: tuple[bodies.Person, ...]
    atlas: Atlas


def draw_populated_room(rng: np.random.Generator, detail: int) -> PopulatedRoom:
    """Draw a room and three people. detail: side of the largest texture, px."""
    size = (
        float(rng.uniform(4.5, 7.5)),
        float(rng.uniform(4.5, 7.0)),
        float(rng.uniform(2.4, 3.0)),
    )
    room = furnished_room(rng, size, float(rng.uniform(1.8, size[1] - 1.3)), detail)
    people = tuple(bodies.draw_person(rng) for _ in range(PEOPLE_PER_ROOM))
    atlas = Atlas([*room.textures, *(look for person in people for look in person.textures)])
    return PopulatedRoom(room, people, atlas)


def render_image(
    room_with_people: PopulatedRoom,
    rng: np.random.Generator,
    size: tuple[int, int],
    distance: tuple[float, float] = DISTANCE,
) -> LabeledImage:
    """Render one image of a hand-held camera somewhere in the room.

    Args:
        room_with_people: the room.
        rng: random numbers.
        size: (height, width), px.
        distance: nearest and farthest that people stand from the camera, m.
    """
    camera = RenderCamera.freiburg3(size).resized(SUPERSAMPLING)
    T_wc = _camera_pose(room_with_people.room, rng)
    room = room_with_people.room
    meshes = [room.mesh]
    for k, place in enumerate(_draw_positions(room, rng, T_wc, distance)):
        person = room_with_people.people[k]
        body = bodies.person_mesh(
            person, bodies.draw_pose(rng), place, float(rng.uniform(0, 2 * np.pi))
        )
        meshes.append(body.as_instance(k + 1, len(room.textures) + 6 * k))
    view = render(
        join_meshes(meshes),
        room_with_people.atlas,
        _vary_lighting(room.lighting, rng),
        camera,
        T_wc,
    )
    return LabeledImage(_expose(view.rgb, rng, size), _visible_masks(view.instance, size))


def _camera_pose(room: Room, rng: np.random.Generator) -> FloatArray:
    """Draw T_wc of a camera 0.8-1.8 m high at a free place, looking mostly into the room."""
    from scipy.spatial.transform import Rotation

    width, length, _ = room.size
    for _ in range(50):
        x, y = rng.uniform(-width / 2 + 0.3, width / 2 - 0.3), rng.uniform(0.3, length - 0.5)
        if room.is_free(x, y, 0.3):
            break
    yaw = np.arctan2(0.0 - x, length * 0.55 - y) + rng.normal(0, 0.5)  # from +y toward +x
    angles = (yaw, rng.normal(-0.08, 0.12), rng.normal(0, 0.06))
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose = np.eye(4)
    pose[:3, :3] = level @ Rotation.from_euler("YXZ", angles).as_matrix()
    pose[:3, 3] = (x, y, rng.uniform(0.8, 1.8))
    return pose


def _draw_positions(
    room: Room, rng: np.random.Generator, T_wc: FloatArray, distances: tuple[float, float]
) -> list[tuple[float, float]]:
    """Draw free places before the camera for 0-3 people; the image's border may cut them."""
    wanted = int(rng.choice(len(_COUNT_CHANCE), p=_COUNT_CHANCE))
    forward = np.arctan2(T_wc[1, 2], T_wc[0, 2])
    nearest, farthest = distances
    found: list[tuple[float, float]] = []
    for _ in range(40 * wanted):
        if len(found) == wanted:
            break
        distance, angle = (
            nearest + (farthest - nearest) * rng.beta(1.3, 1.6),
            forward + rng.uniform(-0.6, 0.6),
        )
        x, y = (
            float(T_wc[0, 3] + distance * np.cos(angle)),
            float(T_wc[1, 3] + distance * np.sin(angle)),
        )
        apart = all(np.hypot(x - a, y - b) > 0.5 for a, b in found)
        if apart and room.is_free(x, y, 0.25):
            found.append((x, y))
    return found


def _vary_lighting(lighting: Lighting, rng: np.random.Generator) -> Lighting:
    """Turn each lamp up or down relative to the ambient light, and all of it warmer or colder."""
    gain = np.exp(rng.normal(0, 0.3, (len(lighting.lamps), 1))).astype(np.float32)
    tint = (1 + rng.normal(0, 0.04, 3)).astype(np.float32)
    return Lighting(lighting.lamps, lighting.power * gain * tint, lighting.ambient * tint)


def _expose(rgb: Float32Array, rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return the supersampled rendering as a photograph of `size`.

    It is exposed, blurred by motion in a third of the cases, blurred by the optics, and noisy.
    """
    rgb = np.minimum(
        rgb * np.float32(exposure_gain(rgb, 0.4 * float(np.exp(rng.normal(0, 0.25))))), 1
    )
    scale = size[1] / 256
    if rng.random() < 0.33:
        rgb = blur_motion(
            rgb, SUPERSAMPLING * scale * float(rng.uniform(1.5, 6)), float(rng.uniform(0, np.pi))
        )
    small = cv2.resize(rgb, (size[1], size[0]), interpolation=cv2.INTER_AREA).astype(np.float32)
    return add_sensor_noise(small, rng, float(rng.uniform(0.5, 3.5)), float(rng.uniform(0, 0.5)))


def _visible_masks(instance: Int32Array, size: tuple[int, int]) -> Mask:
    """Return masks [n, H, W] of the instances that cover at least half of a pixel.

    No two masks overlap.
    """
    masks = []
    free = np.ones(size, dtype=np.bool_)
    for k in range(1, int(instance.max(initial=0)) + 1):
        cover = cv2.resize(
            (instance == k).astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_AREA
        )
        mask = (cover >= 0.5) & free
        free &= ~mask
        if mask.any():
            masks.append(mask)
    return np.stack(masks) if masks else np.zeros((0, *size), dtype=np.bool_)


def coco(
    out: Path,
    train: int = 500,
    val: int = 60,
    size: tuple[int, int] = (192, 256),
    seed: int = 0,
    distance: tuple[float, float] = DISTANCE,
) -> None:
    """Render a COCO-format folder of people in rooms.

    Writes images/, instances_train.json and instances_val.json. No room, garment or body of one
    split occurs in the other or in a sequence.

    Args:
        out: new or empty folder.
        train: number of training images.
        val: number of validation images.
        size: height and width of the images, px; at least 48 each.
        seed: same seed, same bytes.
        distance: nearest and farthest that people stand from the camera, m; below 0.6 one may fill
            the image.
    """
    _check(train, val, size, seed, distance)
    with new_folder(out) as draft:
        (draft / "images").mkdir()
        counts = {}
        for split, number in (("train", train), ("val", val)):
            document = _render_split(draft, split, number, size, seed, distance)
            (draft / f"instances_{split}.json").write_text(json.dumps(document))
            counts[split] = len(document["annotations"])
    print(f"{out}: {train} + {val} images with {counts['train']} + {counts['val']} people")


def _check(
    train: int, val: int, size: tuple[int, int], seed: int, distance: tuple[float, float]
) -> None:
    for name, number in (("train", train), ("val", val)):
        if number < 1:
            raise DataError(f"{name}: {number} images; a split has at least 1")
    check_size_and_seed(size, seed)
    if not NEAREST <= distance[0] <= distance[1] <= FARTHEST:
        limits = f"needs {NEAREST} <= nearest <= farthest <= {FARTHEST}"
        raise DataError(f"distance: {distance[0]} to {distance[1]} m; {limits}")


def _render_split(
    folder: Path,
    split: str,
    number: int,
    size: tuple[int, int],
    seed: int,
    distance: tuple[float, float],
) -> dict[str, Any]:
    """Write the images of one split, and return its COCO document."""
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for first in range(0, number, IMAGES_PER_ROOM):
        rng = stream(seed, f"coco-{split}", first // IMAGES_PER_ROOM)
        room_with_people = draw_populated_room(rng, texture_detail(size))
        for image_id in range(first + 1, min(first + IMAGES_PER_ROOM, number) + 1):
            rendered = render_image(room_with_people, rng, size, distance)
            name = f"{split}_{image_id:06d}.jpg"
            write_jpeg(folder / "images" / name, rendered.image, _JPEG_QUALITY)
            images.append({"id": image_id, "file_name": name, "height": size[0], "width": size[1]})
            for mask in rendered.masks:
                is_small = bool(mask.mean() < SMALLEST_SHARE)
                annotations.append(annotate(mask, image_id, len(annotations) + 1, crowd=is_small))
    return {
        "info": {"description": f"synthetic people in rooms, {split}", "seed": seed},
        "images": images,
        "annotations": annotations,
        "categories": [{"id": 1, "name": "person", "supercategory": "person"}],
    }
