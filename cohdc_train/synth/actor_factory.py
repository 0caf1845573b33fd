"""Draw the actors of a sequence and their paths."""

from dataclasses import dataclass

import numpy as np

from cohdc_train.synth import furniture
from cohdc_train.synth import people as bodies
from cohdc_train.synth import walk_paths as walks
from cohdc_train.synth.actors import Actor, MovableObject, SeatedPerson, Walker
from cohdc_train.synth.camera_motion import CameraMotion, loop_heading, sway
from cohdc_train.synth.walk_paths import Walk
from cohdc_train.types import FloatArray

EYE_Y = 0.9  # m from the wall behind the camera
# m beyond the view's border where people turn
_TURN_MARGIN = {"xyz": 0.75, "halfsphere": 1.2, "static": 0.6, "rpy": 1.2, "loop": 0.75}


@dataclass(frozen=True)
class ActorFactory:
    """Draws actors and their paths.

    Attributes:
        rng: random numbers.
        times: [n] s, of the frames.
        poses: [n, 4, 4] T_wc of the frames, m.
        motion: of the camera.
    """

    rng: np.random.Generator
    times: FloatArray
    poses: FloatArray
    motion: CameraMotion

    def crowd(self, people: list[bodies.Person], distances: FloatArray) -> list[Actor]:
        """Return people who cross the view; in a loop they walk round with the camera."""
        if not people:
            return []
        ways = walks.crowd(self.rng, self.times, distances, _TURN_MARGIN[self.motion])
        if self.motion == "loop":
            ways = walks.follow_camera(
                ways, self.times, self.poses[:, :2, 3], loop_heading(self.times)
            )
        else:
            ways = tuple(way.shifted(0.0, EYE_Y) for way in ways)
        return [Walker(person, way) for person, way in zip(people, ways, strict=True)]

    def stopping(self, people: list[bodies.Person], distances: FloatArray) -> list[Actor]:
        """Return people who stop and go."""
        ways = walks.stop_and_go(self.rng, self.times, distances)
        return [
            Walker(person, way.shifted(0.0, EYE_Y))
            for person, way in zip(people, ways, strict=True)
        ]

    def filling(self, people: list[bodies.Person], distances: FloatArray) -> list[Actor]:
        """Return one person before the camera, and others who cross behind."""
        first = [
            Walker(person, walks.approach_camera(self.times, self.poses)) for person in people[:1]
        ]
        return [*first, *self.crowd(people[1:], distances[1:] + 0.6)]

    def seated(self, people: list[bodies.Person], distances: FloatArray) -> list[Actor]:
        """Return people on chairs side by side, more or less turned to the camera; then chairs."""
        sitters: list[Actor] = []
        chairs: list[Actor] = []
        still = np.zeros(len(self.times))
        sides = np.linspace(-0.38, 0.38, len(people)) if len(people) > 1 else np.zeros(1)
        for person, side, distance in zip(
            people, self.rng.permutation(sides), distances, strict=True
        ):
            place = (float(side * distance), float(distance + EYE_Y))
            heading = float(np.arctan2(-1.0, -side) + self.rng.uniform(-0.7, 0.7))
            fidget = sway(self.rng, self.times, 1.0, 3.0)
            gesture = np.clip(4 * sway(self.rng, self.times, 1.0, 6.0) - 3, 0, 1)
            sitters.append(SeatedPerson(person, place, heading, fidget, gesture))
            chair = furniture.chair(bodies.seat_height(person, bodies.sitting(0.0, 0.0)))
            rest = Walk(np.tile(place, (len(still), 1)), still + heading, still, still)
            chairs.append(MovableObject(chair, (furniture.chair_texture(self.rng),), rest))
        return [*sitters, *chairs]

    def rolling(self, pusher: list[bodies.Person], distance: float) -> list[Actor]:
        """Return a cart, and the person who pushes it."""
        body, looks = furniture.cart(self.rng)
        line = walks.back_and_forth(self.rng, self.times, 0.6 * distance + 0.35, (0.5, 1.0), 0.7)
        way, behind = walks.cart_path(self.rng, self.times, line, furniture.HANDLE - 0.5)
        ways = [walk.shifted(0.0, distance + EYE_Y) for walk in (way, behind)]
        return [
            *(Walker(person, ways[1], pushes=True) for person in pusher),
            MovableObject(body, looks, ways[0]),
        ]
