"""Inverse compositional alignment of a local image with a map image (paper eqs. 10 to 12).

The implementation departs from section 2.3 of the paper in three points:

- The paper's warp is a Euclidean motion (x, y, theta) of whole map images. Images of a room have
  parallax, so that such a motion has no metric meaning. Here the warp W(x; p) transforms a pixel x
  of the map image, with its measured depth, by a rigid motion p of six parameters into the local
  image.
- Equation 11 squares the residual and lacks the transpose, both misprints, since a squared residual
  has no sign. The Gauss-Newton step is H^-1 times the sum of steepest-descent^T times the residual.
- Equation 12 adds the step to p. Rigid motions do not add, so that W is composed with the inverse
  of the step.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import LoopVerificationConfig
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.depth_image import DepthImage
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, to_local
from cohdc_train.slam.optimization.reprojection import MIN_DEPTH_M


@dataclass(frozen=True)
class Alignment:
    """Result of aligning two images.

    T: [4, 4] camera of the map image to camera of the local image, m; before, after: mean clipped
    photometric error, in standard deviations of the map image; correlation: -1..1, of the two
    images where both show the same surface; overlap: share of the map image's pixels that the local
    image shows at the expected depth; agreement: the same as a share of the pixels with a depth
    reading.
    """

    T: Array
    before: float
    after: float
    correlation: float
    overlap: float
    agreement: float


def align(
    map_image: DepthImage, local: DepthImage, T: Array, config: LoopVerificationConfig
) -> Alignment | None:
    """Refine the relative pose of two images by photometric alignment, coarse to fine.

    Args:
        map_image: image of the map's keyframe.
        local: image of the current keyframe.
        T: [4, 4] initial transform, camera of the map image to camera of the local image, m.
        config: levels, iterations, and limits.

    Returns:
        The alignment; None where the images share too few pixels.
    """
    pairs = [(map_image, local)]
    for _ in range(config.levels - 1):
        pairs.append((pairs[-1][0].half(), pairs[-1][1].half()))
    levels = [(_Template(image, config), other) for image, other in pairs]
    start = _compare(*levels[0], T, config)
    refined = T
    for template, other in reversed(levels):
        found = _align_level(template, other, refined, config)
        if found is None:
            return None
        refined = found
    end = _compare(*levels[0], refined, config)
    if start is None or end is None:
        return None
    correlation = float(np.corrcoef(end.template, end.sampled)[0, 1])
    return Alignment(refined, start.error, end.error, correlation, end.overlap, end.agreement)


class _Template:
    """Map image with the steepest-descent images of its usable pixels."""

    def __init__(self, image: DepthImage, config: LoopVerificationConfig) -> None:
        """Select pixels away from depth edges, and compute their points and steepest descent."""
        camera, depth = image.camera, image.depth
        near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
        max_step = config.max_depth_step_ratio * depth
        usable: NDArray[np.bool_] = np.asarray((near > 0) & (far - near < max_step))
        usable[:, [0, -1]] = usable[[0, -1], :] = False
        rows, columns = np.nonzero(usable)
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        self.points = camera.backproject(pixels, depth[rows, columns].astype(np.float64))
        self.values = image.gray[rows, columns].astype(np.float64)
        vertical, horizontal = (
            np.gradient(image.gray.astype(np.float64), axis=axis) for axis in (0, 1)
        )
        gradient = np.stack([horizontal, vertical], axis=-1)[rows, columns]
        self.descent = np.einsum("xi,xij->xj", gradient, warp_jacobian(self.points, camera))


def warp_jacobian(points: Array, camera: Camera) -> Array:
    """Compute the derivative of the projection by the camera's motion, at zero (paper eq. 10).

    u = fx x / z + cx, v = fy y / z + cy.

    Args:
        points: [n, 3] in the camera frame, m.
        camera: pinhole camera.

    Returns:
        [n, 2, 6] px per (translation m, rotation rad).
    """
    x, y, z = points.T
    fx, fy = camera.fx, camera.fy
    zero = np.zeros_like(z)
    du_dt = np.stack([fx / z, zero, -fx * x / z**2], axis=1)
    dv_dt = np.stack([zero, fy / z, -fy * y / z**2], axis=1)
    du_dr = np.stack([-fx * x * y / z**2, fx * (1 + (x / z) ** 2), -fx * y / z], axis=1)
    dv_dr = np.stack([-fy * (1 + (y / z) ** 2), fy * x * y / z**2, fy * x / z], axis=1)
    du = np.concatenate([du_dt, du_dr], axis=1)
    dv = np.concatenate([dv_dt, dv_dr], axis=1)
    return np.stack([du, dv], axis=1)


@dataclass(frozen=True)
class _Comparison:
    """Comparison of a template with a local image.

    is_visible: [x] bool, pixels that both images show; template, sampled: [s] their gray values,
    the latter with gain and offset of the former; residual: [s] clipped; error, overlap, agreement:
    as in Alignment.
    """

    is_visible: NDArray[np.bool_]
    template: Array
    sampled: Array
    residual: Array
    error: float
    overlap: float
    agreement: float


def _compare(
    template: _Template, local: DepthImage, T: Array, config: LoopVerificationConfig
) -> _Comparison | None:
    """Warp a template into the local image; None where too few pixels are visible in both."""
    points = to_local(T, template.points)
    z = np.maximum(points[:, 2], MIN_DEPTH_M)
    pixels = local.camera.project(np.column_stack([points[:, :2], z]))
    measured_depth = _sample(local.depth, pixels, cv2.INTER_NEAREST)
    with_reading = measured_depth > 0
    is_visible = np.asarray(
        with_reading & (np.abs(measured_depth - z) < config.same_depth_ratio * z)
    )
    if is_visible.sum() < config.min_pixels:
        return None
    sampled, values = (
        _sample(local.gray, pixels[is_visible], cv2.INTER_LINEAR),
        template.values[is_visible],
    )
    spread = float(values.std()) + 1e-6
    sampled = (sampled - sampled.mean()) * (spread / (sampled.std() + 1e-6)) + values.mean()
    residual = sampled - values
    limit = config.clip_sigma * 1.4826 * float(np.median(np.abs(residual))) + 1e-6
    error = float(np.minimum(np.abs(residual), spread).mean()) / spread
    num_visible = float(is_visible.sum())
    residual = np.clip(residual, -limit, limit)
    return _Comparison(
        is_visible,
        values,
        sampled,
        residual,
        error,
        num_visible / len(is_visible),
        num_visible / float(with_reading.sum()),
    )


def _sample(image: NDArray[np.float32], pixels: Array, interpolation: int) -> Array:
    """Sample an image at pixels [x, 2]; returns [x], 0 outside the image."""
    x, y = (np.ascontiguousarray(pixels[None, :, axis], dtype=np.float32) for axis in (0, 1))
    found = cv2.remap(image, x, y, interpolation, borderValue=0)
    return np.asarray(found[0], dtype=np.float64)


def _align_level(
    template: _Template, local: DepthImage, T: Array, config: LoopVerificationConfig
) -> Array | None:
    """Run Gauss-Newton on one level; returns T, or None where too few pixels are visible."""
    for _ in range(config.iterations):
        comparison = _compare(template, local, T, config)
        if comparison is None:
            return None
        descent = template.descent[comparison.is_visible]
        H = descent.T @ descent + 1e-9 * np.eye(6)  # equation 10
        # Equation 11 as in the module's docstring; the residual is I_LM(W) - I_PM.
        step = np.linalg.solve(H, descent.T @ comparison.residual)
        T = T @ inverse(exp_se3(step))  # equation 12, composed
        if np.abs(step).max() < 2e-5:  # 20 micrometers or microradians
            break
    return T
