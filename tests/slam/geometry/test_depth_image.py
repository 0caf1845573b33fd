"""Small gray images with depth, as keyframes keep them."""

from dataclasses import replace

import numpy as np
import pytest
from plane_world import CAMERA, camera_path, render, room

from cohdc_train.slam.geometry.depth_image import make_depth_image


def test_depth_under_the_mask_is_removed() -> None:
    rgb, depth, _ = render(room(), camera_path(20)[0])
    mask = np.zeros(depth.shape, dtype=np.bool_)
    mask[:, :160] = True
    small = make_depth_image(rgb, depth, mask, CAMERA)
    assert small.depth.shape == small.gray.shape == (120, 160)
    assert not small.depth[:, :80].any()
    assert (small.depth[:, 84:] > 0).mean() > 0.9


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (160, 120)])
def test_small_image_shows_the_image_border_at_its_own_border(size: tuple[int, int]) -> None:
    width, height = size
    camera = replace(
        CAMERA, fx=500.0, fy=510.0, cx=width / 2 + 7, cy=height / 2 - 3, width=width, height=height
    )
    rgb, depth = np.zeros((height, width, 3), np.uint8), np.ones((height, width), np.float32)
    small = make_depth_image(rgb, depth, None, camera)
    assert max(small.gray.shape) == 160
    ray = camera.backproject(np.array([[width - 0.5, height - 0.5]]), np.ones(1))
    border = [small.gray.shape[1] - 0.5, small.gray.shape[0] - 0.5]
    np.testing.assert_allclose(small.camera.project(ray)[0], border, atol=1e-9)


def test_longer_side_is_an_option() -> None:
    rgb, depth = np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32)
    assert make_depth_image(rgb, depth, None, CAMERA, side_px=80).gray.shape == (60, 80)
