"""Walking people, seated people and movable objects of a sequence."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from cohdc_train.synth import people as bodies
from cohdc_train.synth.mesh import Mesh, yaw_rotation
from cohdc_train.synth.textures import Texture
from cohdc_train.synth.walk_paths import Walk
from cohdc_train.types import Float32Array, FloatArray

_BLENDS = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [1 / 3] * 3]
)


class Actor(Protocol):
    """Interface of something that can move, as a function of the frame number."""

    @property
    def is_person(self) -> bool:
        """True for a person, who appears in masks/."""
        ...

    @property
    def textures(self) -> tuple[Texture, ...]:
        """Textures that its triangles' texture numbers refer to."""
        ...

    def mesh(self, frame: int) -> Mesh:
        """Return its triangles, world frame, m: the same ones in the same order in every frame."""
        ...

    def points(self, frame: int) -> FloatArray:
        """Return [n, 3] points of it, world frame, m; cheaper than `mesh`."""
        ...


def sample_points(mesh: Mesh) -> FloatArray:
    """Return [7 T, 3] points spread over the T triangles of a mesh, m."""
    points: FloatArray = np.einsum("bk,tki->tbi", _BLENDS, mesh.corners).reshape(-1, 3)
    return points


@dataclass(frozen=True)
class Walker:
    """A person on a walk. One who pushes a cart holds both hands before the chest."""

    person: bodies.Person
    walk: Walk
    pushes: bool = False
    is_person: bool = True

    @property
    def textures(self) -> tuple[Texture, ...]:
        """Textures of the person."""
        return self.person.textures

    @cached_property
    def _figure(self) -> FloatArray:
        return sample_points(bodies.person_mesh(self.person, bodies.walking(0.6), (0.0, 0.0), 0.0))

    def mesh(self, frame: int) -> Mesh:
        """Return the person in the walk cycle."""
        phase = 2 * np.pi * self.walk.distance_walked[frame] / bodies.stride(self.person)
        pose = bodies.walking(float(phase), float(self.walk.pace[frame]))
        if self.pushes:
            pose = replace(pose, shoulders=(0.8, 0.8), elbows=(0.55, 0.55))
        x, y = (float(v) for v in self.walk.position[frame])
        return bodies.person_mesh(self.person, pose, (x, y), float(self.walk.heading[frame]))

    def points(self, frame: int) -> FloatArray:
        """Return points of the person, always in the same pose."""
        return _place_points(self._figure, self.walk, frame)


@dataclass(frozen=True)
class SeatedPerson:
    """A person who sits.

    Attributes:
        person: the body.
        place: (x, y), m.
        heading: viewing direction, rad.
        fidget: [n] as `people.sitting` takes it.
        gesture: [n] likewise.
        is_person: True.
    """

    person: bodies.Person
    place: tuple[float, float]
    heading: float
    fidget: FloatArray
    gesture: FloatArray
    is_person: bool = True

    @property
    def textures(self) -> tuple[Texture, ...]:
        """Textures of the person."""
        return self.person.textures

    def mesh(self, frame: int) -> Mesh:
        """Return the seated person."""
        pose = bodies.sitting(float(self.fidget[frame]), float(self.gesture[frame]))
        return bodies.person_mesh(self.person, pose, self.place, self.heading)

    @cached_property
    def _figure(self) -> FloatArray:
        return sample_points(self.mesh(0))

    def points(self, frame: int) -> FloatArray:
        """Return points of the seated person, without small movements."""
        return self._figure


@dataclass(frozen=True)
class MovableObject:
    """A cart or a chair.

    Attributes:
        body: its triangles in its own frame.
        textures: textures of the triangles.
        walk: its path.
        is_person: False.
    """

    body: Mesh
    textures: tuple[Texture, ...]
    walk: Walk
    is_person: bool = False

    def mesh(self, frame: int) -> Mesh:
        """Return the object at its place."""
        place = (*self.walk.position[frame], 0.0)
        return self.body.transformed(yaw_rotation(float(self.walk.heading[frame])), place)

    def points(self, frame: int) -> FloatArray:
        """Return points of the object at its place."""
        return sample_points(self.mesh(frame))


def _place_points(points: FloatArray, walk: Walk, frame: int) -> FloatArray:
    """Return the points of a body at the place that a walk has reached."""
    carried: FloatArray = points @ yaw_rotation(walk.heading[frame]).T + np.array(
        [*walk.position[frame], 0.0]
    )
    return carried


def max_speed(actor: Actor, frame: int, frames: int, rate: float) -> float:
    """Return the speed of the fastest corner of an actor's triangles, m/s.

    It is measured between this frame and the next; at the end between the last two.
    """
    first = min(frame, frames - 2)
    step: Float32Array = actor.mesh(first + 1).corners - actor.mesh(first).corners
    return float(np.sqrt(np.square(step).sum(axis=2).max())) * rate
