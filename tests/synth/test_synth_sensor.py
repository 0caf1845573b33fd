"""Sensor model: noise and holes."""

import numpy as np
import pytest

from cohdc_train.synth.renderer import RenderedView
from cohdc_train.synth.sensor import (
    DEPTH_SCALE,
    add_sensor_noise,
    blur_motion,
    depth_edges,
    exposure_gain,
    measure_depth,
)


def flat_view(depth: np.ndarray, facing: float = 1.0) -> RenderedView:
    shape = depth.shape
    gray = np.full((*shape, 3), 0.5, np.float32)
    return RenderedView(
        gray,
        depth.astype(np.float32),
        np.zeros(shape, np.int32),
        np.full(shape, facing, np.float32),
    )


@pytest.mark.parametrize("distance", [0.8, 2.0, 4.0])
def test_depth_noise_grows_as_measured(distance: float) -> None:
    units = measure_depth(flat_view(np.full((240, 320), distance)), np.random.default_rng(0))
    assert units.dtype == np.uint16
    seen = units[units > 0] / DEPTH_SCALE
    assert seen.size > 0.97 * units.size
    assert seen.mean() == pytest.approx(distance, abs=1e-3)
    assert seen.std() == pytest.approx(0.0012 + 0.0019 * (distance - 0.4) ** 2, rel=0.03)


@pytest.mark.parametrize("distance", [0.2, 5.4, 0.0])
def test_nothing_outside_the_range(distance: float) -> None:
    assert not measure_depth(flat_view(np.full((60, 80), distance)), np.random.default_rng(0)).any()


def test_edges_and_grazing_surfaces_lose_readings() -> None:
    depth = np.full((200, 200), 1.5)
    depth[:, 100:] = 3.0
    edges = depth_edges(depth.astype(np.float32))
    assert edges[:, 99:101].all()
    assert edges.sum() == 400
    units = measure_depth(flat_view(depth), np.random.default_rng(1))
    assert (units[edges] == 0).mean() == pytest.approx(0.6, abs=0.08)
    assert (units[~edges] == 0).mean() < 0.04
    grazing = measure_depth(
        flat_view(np.full((100, 100), 2.0), facing=0.12), np.random.default_rng(1)
    )
    assert (grazing == 0).mean() == pytest.approx(0.8, abs=0.05)


def test_sensor_noise_has_given_sigma() -> None:
    rgb = np.full((100, 120, 3), 0.5, np.float32)
    image = add_sensor_noise(rgb, np.random.default_rng(0), sigma=2.5)
    assert image.dtype == np.uint8
    assert image.mean() == pytest.approx(127.5, abs=0.1)
    assert image.std() == pytest.approx(2.5, rel=0.03)
    assert add_sensor_noise(rgb * 9, np.random.default_rng(0)).min() > 240


def test_motion_blur_follows_angle_and_keeps_brightness() -> None:
    image = np.zeros((21, 21, 3), np.float32)
    image[10, 10] = 1
    wide = blur_motion(image, 7, 0.0)
    assert wide[10, :, 0].sum() == pytest.approx(1, abs=1e-5)
    assert np.count_nonzero(wide[10, :, 0]) == 7
    tall = blur_motion(image, 7, np.pi / 2)
    np.testing.assert_allclose(tall[:, 10], wide[10], atol=1e-6)
    np.testing.assert_array_equal(blur_motion(image, 0.4, 0.0), image)


def test_exposure_gain_gives_one_brightness() -> None:
    rgb = np.random.default_rng(0).uniform(0.1, 0.3, (40, 50, 3)).astype(np.float32)
    for light in (0.2, 1.0, 7.0):
        assert (rgb * light * exposure_gain(rgb * light)).mean() == pytest.approx(0.37, rel=0.05)
