"""Articulated people: a body drawn once, a pose per frame, and the triangles of the two together.

A person's own frame: x forward, y to the left, z up, the origin on the floor below the hips; m and
rad.
"""

from dataclasses import dataclass

import numpy as np

from cohdc_train.synth import clothes
from cohdc_train.synth import mesh as solids
from cohdc_train.synth.mesh import Mesh
from cohdc_train.synth.textures import Texture
from cohdc_train.types import Float32Array

SHIRT, TROUSERS, SKIN, FACE, HAIR, SHOES = range(6)  # order of a person's textures
LEFT = (0.0, 1.0, 0.0)
_THIGH, _SHANK, _UPPER_ARM, _FOREARM = 0.245, 0.245, 0.17, 0.15  # as parts of the height


@dataclass(frozen=True)
class Person:
    """A body and its clothes.

    Attributes:
        height: m.
        girth: 1 = slim adult.
        bare_arms: the shirt has short sleeves.
        legwear: `trousers`, `shorts` or `skirt`.
        hairstyle: `short`, `long` or `none`.
        coat: length the shirt hangs below the waist, as part of the height.
        textures: six, in the order SHIRT TROUSERS SKIN FACE HAIR SHOES.
    """

    height: float
    girth: float
    bare_arms: bool
    legwear: str
    hairstyle: str
    coat: float
    textures: tuple[Texture, ...]


@dataclass(frozen=True)
class BodyPose:
    """Joint angles, rad; pairs are (left, right). Forward swings are positive; bends are >= 0."""

    hips: tuple[float, float]
    knees: tuple[float, float]
    shoulders: tuple[float, float]
    elbows: tuple[float, float]
    spread: tuple[float, float]
    lean: float
    nod: float


def draw_person(rng: np.random.Generator, patterned: float = 0.6) -> Person:
    """Draw an adult or teenager with clothes.

    patterned: probability of a shirt with a pattern.
    """
    tone, hair = clothes.skin_tone(rng), clothes.hair_color(rng)
    looks = (
        clothes.cloth(rng, patterned),
        clothes.cloth(rng, patterned / 2),
        clothes.skin(rng, tone),
        clothes.face(rng, tone, hair),
        clothes.hair(rng, hair),
        clothes.cloth(rng, 0.1),
    )
    return Person(
        height=float(np.clip(rng.normal(1.72, 0.1), 1.45, 1.98)),
        girth=float(rng.uniform(0.9, 1.3)),
        bare_arms=bool(rng.random() < 0.45),
        legwear=str(rng.choice(["trousers", "shorts", "skirt"], p=[0.7, 0.17, 0.13])),
        hairstyle=str(rng.choice(["short", "long", "none"], p=[0.6, 0.3, 0.1])),
        coat=float(rng.choice([0.0, 0.03, 0.12], p=[0.3, 0.5, 0.2])),
        textures=looks,
    )


def stride(person: Person) -> float:
    """Return the meters walked in one cycle of two steps."""
    return 0.8 * person.height


def walking(phase: float, vigor: float = 1.0) -> BodyPose:
    """Return the pose at `phase` rad of the walk cycle, of which 2 pi are two steps.

    vigor: 0 stands, 1 walks.
    """
    s, c = np.sin(phase), np.cos(phase)
    swing = 0.46 * vigor
    lift = 0.85 * vigor
    return BodyPose(
        hips=(swing * s + 0.04 * vigor, -swing * s + 0.04 * vigor),
        knees=(0.06 + lift * max(c, 0.0) ** 1.5, 0.06 + lift * max(-c, 0.0) ** 1.5),
        shoulders=(-0.5 * vigor * s, 0.5 * vigor * s),
        elbows=(0.18 + 0.25 * vigor * (1 - s), 0.18 + 0.25 * vigor * (1 + s)),
        spread=(0.12, 0.12),
        lean=0.05 * vigor + 0.01,
        nod=0.0,
    )


def sitting(fidget: float, gesture: float) -> BodyPose:
    """Return a seated pose with a hand on each thigh.

    Args:
        fidget: -1..1, sways trunk and head a little.
        gesture: 0..1, lifts the right hand.
    """
    return BodyPose(
        hips=(1.45, 1.5),
        knees=(1.5, 1.45),
        shoulders=(0.42, 0.42 + 0.5 * gesture),
        elbows=(0.75, 0.75 + 0.6 * gesture),
        spread=(0.1, 0.1),
        lean=0.06 + 0.012 * fidget,
        nod=0.03 * fidget,
    )


def seat_height(person: Person, pose: BodyPose) -> float:
    """Return the height above the floor at which a seated person's thighs rest, m."""
    soles = [
        _leg(person, side, hip, knee)[1]
        for side, hip, knee in zip((1, -1), pose.hips, pose.knees, strict=True)
    ]
    return -min(soles) - 0.05 * person.height * person.girth


def draw_pose(rng: np.random.Generator) -> BodyPose:
    """Draw a pose: half of them walk, the others stand, gesture or reach."""
    kind = rng.random()
    pose = walking(
        float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0.5, 1.2)) if kind < 0.55 else 0.1
    )
    if kind < 0.4:
        return pose
    left, right = (float(v) for v in rng.uniform(-0.3, 1.9, 2))
    bends = (float(rng.uniform(0, 2.2)), float(rng.uniform(0, 2.2)))
    if rng.random() < 0.4:
        left, bends = pose.shoulders[0], (pose.elbows[0], bends[1])
    spread = (float(rng.uniform(0.05, 0.9)), float(rng.uniform(0.05, 0.9)))
    return BodyPose(
        pose.hips,
        pose.knees,
        (left, right),
        bends,
        spread,
        float(rng.uniform(-0.05, 0.35)),
        float(rng.normal(0, 0.2)),
    )


def _direction(swing: float, spread: float) -> Float32Array:
    """Return the direction of a limb, [3].

    Args:
        swing: forward of straight down, rad.
        spread: toward y, rad, signed.
    """
    return np.array(
        [np.sin(swing) * np.cos(spread), np.sin(spread), -np.cos(swing) * np.cos(spread)],
        dtype=np.float32,
    )


def person_mesh(
    person: Person, pose: BodyPose, position: tuple[float, float], heading: float
) -> Mesh:
    """Return the person standing on the floor, as instance 0.

    Texture numbers are 0..5 in the order of `Person.textures`.

    Args:
        person: the body.
        pose: joint angles.
        position: (x, y), m.
        heading: viewing direction, rad.
    """
    parts: list[Mesh] = []
    lowest = 0.0
    for side, hip, knee in ((1, pose.hips[0], pose.knees[0]), (-1, pose.hips[1], pose.knees[1])):
        leg, sole = _leg(person, side, hip, knee)
        parts += leg
        lowest = min(lowest, sole)
    spine = np.array([np.sin(pose.lean), 0, np.cos(pose.lean)], dtype=np.float32)
    parts += _trunk(person, pose, spine) + _head(person, pose, spine)
    for side, swing, bend, spread in zip(
        (1, -1), pose.shoulders, pose.elbows, pose.spread, strict=True
    ):
        parts += _arm(person, spine, side, (swing, bend, spread))
    body = solids.join_meshes(parts)
    return body.transformed(solids.yaw_rotation(heading), (position[0], position[1], -lowest))


def _leg(person: Person, side: int, hip: float, knee: float) -> tuple[list[Mesh], float]:
    """Return thigh, shank and foot below hips at z = 0, and the z of the sole."""
    h, g = person.height, person.height * person.girth
    top = np.array([0, side * 0.052 * g, 0], dtype=np.float32)
    middle = top + _THIGH * h * _direction(hip, side * 0.03)
    ankle = middle + _SHANK * h * _direction(hip - knee, side * 0.01)
    covered = person.legwear == "trousers"
    loose = 1.18 if covered else 1.0
    upper = TROUSERS if person.legwear != "skirt" else SKIN
    tilt = 0.35 * min(hip - knee, 0.0)
    forward = np.array([np.cos(tilt), 0, np.sin(tilt)], dtype=np.float32)
    heel = ankle - 0.022 * h * forward - np.array([0, 0, 0.018 * h], dtype=np.float32)
    toe = heel + 0.105 * h * forward
    parts = [
        solids.capsule(top, middle, (0.052 * g, 0.034 * g * loose), LEFT, upper),
        solids.capsule(
            middle,
            ankle,
            (0.033 * g * loose, 0.021 * g * loose**2),
            LEFT,
            TROUSERS if covered else SKIN,
        ),
        solids.capsule(heel, toe, (0.024 * h, 0.02 * h), LEFT, SHOES),
    ]
    return parts, float(min(heel[2], toe[2]) - 0.024 * h)


def _trunk(person: Person, pose: BodyPose, spine: Float32Array) -> list[Mesh]:
    """Return the pelvis (or skirt), and the chest up to the neck."""
    h, g = person.height, person.height * person.girth
    up = np.array([0, 0, 1], dtype=np.float32)
    belly = 1 + 1.2 * (person.girth - 1)
    level = np.array([-person.coat, 0.02, 0.08, 0.15, 0.22, 0.27, 0.295, 0.315], dtype=np.float32)
    wide = np.array([0.108, 0.104, 0.094, 0.1, 0.11, 0.108, 0.075, 0.03], dtype=np.float32)
    deep = np.array(
        [0.082, 0.076, 0.066 * belly, 0.068, 0.07, 0.062, 0.048, 0.03], dtype=np.float32
    )
    chest = (np.where(level[:, None] > 0, level[:, None] * spine, level[:, None] * up) * h).astype(
        np.float32
    )
    parts = [
        solids.tube(
            chest, (np.stack([wide, deep], 1) * g).astype(np.float32), LEFT, SHIRT, segments=16
        )
    ]
    fall, width = np.array([0.04, 0.0, -0.06, -0.1]), np.array([0.09, 0.104, 0.1, 0.05])
    if person.legwear == "skirt":
        reach = max(abs(np.sin(a)) for a in pose.hips) * 0.2
        fall, width = (
            np.array([0.04, -0.02, -0.12, -0.22]),
            np.array([0.09, 0.108, 0.12 + reach / 2, 0.13 + reach]),
        )
    centers = (fall[:, None] * up * h).astype(np.float32)
    parts.append(
        solids.tube(
            centers, np.stack([width, width * 0.78], 1).astype(np.float32) * g, LEFT, TROUSERS, 16
        )
    )
    return parts


def _head(person: Person, pose: BodyPose, spine: Float32Array) -> list[Mesh]:
    """Return the neck, the head with its face forward, and the hair."""
    h = person.height
    neck = 0.305 * h * spine
    tilt = np.array(
        [np.sin(pose.lean * 0.3 + pose.nod), 0, np.cos(pose.lean * 0.3 + pose.nod)],
        dtype=np.float32,
    )
    center = neck + 0.105 * h * tilt
    parts = [
        solids.capsule(neck - 0.02 * h * spine, center, (0.032 * h, 0.03 * h), LEFT, SKIN),
        solids.ellipsoid(center, (0.056 * h, 0.045 * h, 0.068 * h), FACE),
    ]
    if person.hairstyle != "none":
        back = np.array([-0.017 * h, 0, 0.017 * h], dtype=np.float32)
        parts.append(solids.ellipsoid(center + back, (0.055 * h, 0.05 * h, 0.066 * h), HAIR))
    if person.hairstyle == "long":
        hanging = np.array([-0.036 * h, 0, -0.045 * h], dtype=np.float32)
        parts.append(solids.ellipsoid(center + hanging, (0.035 * h, 0.052 * h, 0.085 * h), HAIR))
    return parts


def _arm(
    person: Person, spine: Float32Array, side: int, angles: tuple[float, float, float]
) -> list[Mesh]:
    """Return upper arm, forearm and hand. angles: (swing, bend, spread), rad."""
    h, g = person.height, person.height * person.girth
    swing, bend, spread = angles
    shoulder = 0.272 * h * spine + np.array([0, side * 0.108 * g, 0], dtype=np.float32)
    elbow = shoulder + _UPPER_ARM * h * _direction(swing, side * spread)
    wrist = elbow + _FOREARM * h * _direction(swing + bend, side * spread * 0.5)
    tip = wrist + 0.055 * h * _direction(swing + bend, 0.0)
    sleeve = SKIN if person.bare_arms else SHIRT
    loose = 1.0 if person.bare_arms else 1.2
    return [
        solids.capsule(shoulder, elbow, (0.033 * g, 0.024 * g * loose), LEFT, SHIRT),
        solids.capsule(elbow, wrist, (0.022 * g * loose, 0.016 * g * loose), LEFT, sleeve),
        solids.capsule(wrist, tip, (0.018 * h, 0.014 * h), LEFT, SKIN),
    ]
