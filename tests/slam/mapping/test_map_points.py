"""Which young points stay in the map."""

import numpy as np
from plane_world import CAMERA, features_at

from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import cull_map_points, remove_points

ONCE, TWICE, RARELY_FOUND, YOUNG = range(4)  # points, by what becomes of them


def keyframe(index: int, point_ids: list[int]) -> Keyframe:
    """One that looks at a wall 2 m away, a corner for each of four points; -1 where it does not see
    one.
    """
    pixels = np.array([[100.0, 80.0], [200.0, 80.0], [100.0, 160.0], [200.0, 160.0]])
    features = features_at(pixels, np.full(4, 2.0))
    picture = np.zeros((2, 2), dtype=np.float32)
    return Keyframe(index, index / 3, np.eye(4), features, np.array(point_ids), picture, picture)


def test_what_a_point_has_become() -> None:
    """The last of three is taken over by the second, and that by the first; later a new point has
    the first's row.
    """
    world = Map(CAMERA)
    frames = [keyframe(index, [-1, -1, -1, -1]) for index in range(4)]
    for index in range(3):
        world.add_keyframe(frames[index])
        world.add_points(frames[index], np.array([0]))
    everything, ids = np.arange(3), [np.array([index]) for index in range(3)]
    np.testing.assert_array_equal(world.resolve_merged(everything), everything)
    world.replace(ids[2], ids[1], frames)
    world.replace(ids[1], ids[0], frames)
    np.testing.assert_array_equal(world.resolve_merged(everything), [0, 0, 0])
    for frame in frames[:3]:
        world.forget(frame, np.flatnonzero(frame.point_ids == 0))
    world.add_keyframe(frames[3])
    world.add_points(frames[3], np.array([1]))
    assert frames[3].point_ids[1] == 0
    np.testing.assert_array_equal(world.resolve_merged(everything), [0, 1, 1])


def test_a_point_stays_when_two_keyframes_see_it_and_frames_find_it() -> None:
    world = Map(CAMERA)
    first, second = keyframe(0, [-1, -1, -1, -1]), keyframe(1, [-1, TWICE, RARELY_FOUND, -1])
    world.add_keyframe(first)
    world.add_points(first, np.array([ONCE, TWICE, RARELY_FOUND]))
    world.add_keyframe(second)
    world.add_points(second, np.array([YOUNG]))
    world.visible[[TWICE, RARELY_FOUND]], world.found[[TWICE, RARELY_FOUND]] = 20, (5, 4)
    cull_map_points(world, newest=2)
    assert world.num_observations[: world.size].tolist() == [1, 2, 0, 1], "its time is not up"
    cull_map_points(world, newest=3)
    assert world.num_observations[: world.size].tolist() == [0, 2, 0, 1]
    assert first.point_ids.tolist() == [-1, TWICE, -1, -1]


def test_dropped_point_leaves_every_keyframe_however_many_saw_it() -> None:
    """A point remembers eight observers; the drop reaches the other four too."""
    world = Map(CAMERA)
    keyframes = [
        keyframe(0, [-1, -1, -1, -1]),
        *(keyframe(index, [0, -1, -1, -1]) for index in range(1, 12)),
    ]
    world.add_keyframe(keyframes[0])
    world.add_points(keyframes[0], np.array([0]))
    for other in keyframes[1:]:
        world.add_keyframe(other)
    assert world.num_observations[0] == 12
    remove_points(world, np.array([0]))
    assert world.num_observations[0] == 0
    assert all(other.point_ids[0] == -1 for other in keyframes)


def test_grown_map_has_no_merged_points_in_its_new_rows() -> None:
    world = Map(CAMERA)
    world._reserve(3000)
    np.testing.assert_array_equal(world.merged_into, -1)
