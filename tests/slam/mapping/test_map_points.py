"""Merging, culling, and removal of map points."""

import numpy as np
from plane_world import CAMERA, features_at

from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import cull_map_points, remove_points

ONCE, TWICE, RARELY_FOUND, YOUNG = range(4)  # points, named by what happens to them


def keyframe(index: int, point_ids: list[int]) -> Keyframe:
    """Return a keyframe in front of a wall at 2 m, with a keypoint for each of four points.

    point_ids: -1 = not observed.
    """
    pixels = np.array([[100.0, 80.0], [200.0, 80.0], [100.0, 160.0], [200.0, 160.0]])
    features = features_at(pixels, np.full(4, 2.0))
    image = np.zeros((2, 2), dtype=np.float32)
    return Keyframe(index, index / 3, np.eye(4), features, np.array(point_ids), image, image)


def test_merged_points_resolve_to_their_successor() -> None:
    """Point 2 is merged into 1, and 1 into 0; later a new point reuses row 0."""
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


def test_point_stays_if_two_keyframes_observe_it_and_frames_match_it() -> None:
    world = Map(CAMERA)
    first, second = keyframe(0, [-1, -1, -1, -1]), keyframe(1, [-1, TWICE, RARELY_FOUND, -1])
    world.add_keyframe(first)
    world.add_points(first, np.array([ONCE, TWICE, RARELY_FOUND]))
    world.add_keyframe(second)
    world.add_points(second, np.array([YOUNG]))
    world.visible[[TWICE, RARELY_FOUND]], world.found[[TWICE, RARELY_FOUND]] = 20, (5, 4)
    cull_map_points(world, newest=2)
    assert world.num_observations[: world.size].tolist() == [1, 2, 0, 1], (
        "its probation has not ended"
    )
    cull_map_points(world, newest=3)
    assert world.num_observations[: world.size].tolist() == [0, 2, 0, 1]
    assert first.point_ids.tolist() == [-1, TWICE, -1, -1]


def test_removed_point_is_forgotten_by_all_keyframes() -> None:
    """A point stores eight observers; removal reaches the other four as well."""
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


def test_new_rows_of_grown_map_have_no_merged_points() -> None:
    world = Map(CAMERA)
    world._reserve(3000)
    np.testing.assert_array_equal(world.merged_into, -1)
