"""Eq. 1 and coverage: known answers, and an impulse through real convolutions."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.models.hdc import cycle_rates, holes, max_distance, receptive_field


@pytest.mark.parametrize(
    ("rates", "distance", "missing"),
    [
        ((1, 2, 3), 2, []),  # the paper's example
        ((1, 2, 5), 2, []),
        ((2, 2, 2), 2, [-5, -3, -1, 1, 3, 5]),  # passes eq. 1, leaves holes
        ((1, 2, 9), 5, [-5, -4, 4, 5]),
        ((4,), 4, [-3, -2, -1, 1, 2, 3]),
    ],
)
def test_known_patterns(rates, distance, missing):
    assert max_distance(rates) == distance
    assert holes(rates) == missing


def test_receptive_field_of_the_papers_rates():
    assert receptive_field((1, 2, 3)) == 13


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=4))
def test_holes_match_impulse_through_convolutions(rates):
    half = sum(rates)
    x = torch.zeros(1, 1, 4 * half + 1)
    x[..., 2 * half] = 1.0
    for rate in rates:
        x = torch.nn.functional.conv1d(x, torch.ones(1, 1, 3), dilation=rate, padding=rate)
    unseen = (x[0, 0, half : 3 * half + 1] == 0).nonzero()[:, 0] - half
    assert holes(rates) == unseen.tolist()


def test_bad_pattern_is_refused_with_its_holes():
    with pytest.raises(
        ValueError, match=r"\(2, 2, 2, 2\) leave holes: offsets \+-\(1, 3, 5, 7\) px"
    ):
        cycle_rates((2,), 4)


@pytest.mark.parametrize("pattern", [(), (0, 1), (1, -2)])
def test_rates_below_one_are_refused(pattern):
    with pytest.raises(ValueError, match="at least 1"):
        cycle_rates(pattern, 3)
