"""Place recognition among the views of a hall."""

import numpy as np
from loop_world import poor_view, way_round
from numpy.typing import NDArray
from plane_world import CAMERA

from cohdc_train.slam.config import FeatureConfig, LoopConfig
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.geometry.se3 import exp_se3
from cohdc_train.slam.loop_closing.place_recognition import PlaceRecognizer

NUDGE = exp_se3(np.array([0.05, 0.02, -0.05, 0.01, 0.03, 0.02]))


def test_similarity_is_highest_for_the_same_place() -> None:
    rng, extract = np.random.default_rng(0), OrbExtractor(CAMERA, FeatureConfig(max_keypoints=300))
    poses = way_round(24, turns=0.95)
    recognizer = PlaceRecognizer()
    for index, pose in enumerate(poses):
        recognizer.add(index, extract(*poor_view(pose, rng)).descriptors)

    def similarity_at(index: int) -> NDArray[np.float64]:
        """Compare a view from near a keyframe with all keyframes."""
        return recognizer.similarity(extract(*poor_view(poses[index] @ NUDGE, rng)).descriptors)

    for index in (3, 20):
        similarity = similarity_at(index)
        assert similarity.shape == (24,)
        assert np.argmax(similarity) == index
        others = np.delete(similarity, range(max(index - 3, 0), index + 4))
        assert similarity[index] > 3 * others.max()
    for index in range(3):
        recognizer.remove(index)
    assert np.argmax(similarity_at(20)) == 17, "removed keyframes have no entry"


def test_number_of_tables_and_bits_is_that_of_the_config() -> None:
    descriptors = np.random.default_rng(0).integers(0, 2**63, (1, 4)).astype(np.uint64)
    recognizer = PlaceRecognizer(LoopConfig(hash_tables=3, hash_bits=1))
    recognizer.add(0, descriptors)
    recognizer.add(1, ~descriptors)
    assert recognizer.similarity(descriptors).tolist() == [1.0, 0.0], "one bit tells them apart"
