"""Simulate an RGB-D camera of Kinect's kind: noise, blur, quantized depth with holes."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.synth.renderer import RenderedView
from cohdc_train.types import Float32Array, Image, Mask

DEPTH_SCALE = 5000.0  # TUM: units per meter of the 16 bit files
NEAR, FAR = 0.4, 5.0  # m, the sensor's range
RGB_SIGMA = 2.5  # gray levels
EDGE_DROPOUT = 0.6


def exposure_gain(rgb: Float32Array, brightness: float = 0.37) -> float:
    """Return the factor that brings an image to the mean `brightness` (1 = white)."""
    return brightness / max(float(np.minimum(rgb, 1.5 * rgb.mean()).mean()), 1e-3)


def add_sensor_noise(
    rgb: Float32Array, rng: np.random.Generator, sigma: float = RGB_SIGMA, blur: float = 0.6
) -> Image:
    """Return [H, W, 3] uint8 of an exposed float image (1 = white), blurred and noisy.

    Args:
        rgb: [H, W, 3] float32.
        rng: random numbers.
        sigma: of the noise, gray levels.
        blur: sigma of the optics' blur, px.
    """
    bounded = np.minimum(rgb, 1)
    soft = cv2.GaussianBlur(bounded, (0, 0), blur) if blur > 0.2 else bounded
    noisy = soft * 255 + rng.standard_normal(rgb.shape, dtype=np.float32) * np.float32(sigma)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def blur_motion(rgb: Float32Array, length: float, angle: float) -> Float32Array:
    """Return an image blurred by motion: the mean along a line of `length` px at `angle` rad."""
    size = int(np.ceil(length)) | 1
    if size < 3:
        return rgb
    kernel = np.zeros((size, size), dtype=np.float32)
    half = (size - 1) / 2
    dx, dy = half * np.cos(angle), half * np.sin(angle)
    ends = ((round(half - dx), round(half - dy)), (round(half + dx), round(half + dy)))
    cv2.line(kernel, ends[0], ends[1], (1.0,), 1, cv2.LINE_8)
    return cv2.filter2D(rgb, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE).astype(
        np.float32
    )


def depth_edges(depth: Float32Array) -> Mask:
    """Return [H, W] pixels on both sides of every depth edge.

    Their 3 x 3 neighborhood spans more than 4 % of its depth.
    """
    kernel = np.ones((3, 3), dtype=np.uint8)
    span = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel)
    edges: Mask = span > 0.04 * depth
    return edges


def measure_depth(view: RenderedView, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return the [H, W] uint16 depth image, 5000 per meter, 0 = no reading.

    Sigma .0012 + .0019 (z - .4)^2 m. 60 % of the readings on depth edges are lost, those of dark
    and of grazing surfaces in part, some in blobs, and all outside .4-5 m.
    """
    z = view.depth
    sigma = 0.0012 + 0.0019 * np.square(z - 0.4)
    noisy = z + sigma * rng.standard_normal(z.shape, dtype=np.float32)
    chance = np.where(depth_edges(z), np.float32(EDGE_DROPOUT), np.float32(0.002))
    dark = view.rgb.max(axis=2) < 0.12 * view.rgb.mean()
    chance = np.maximum(chance, 0.5 * dark)
    chance = np.maximum(chance, np.clip((0.28 - view.facing) * 5, 0, 0.95))
    lost = rng.random(z.shape, dtype=np.float32) < chance
    coarse = rng.standard_normal((z.shape[0] // 12 + 2, z.shape[1] // 12 + 2), dtype=np.float32)
    blobs = cv2.resize(coarse, (z.shape[1], z.shape[0]), interpolation=cv2.INTER_CUBIC) > 2.6
    lost |= blobs | (noisy < NEAR) | (noisy > FAR)
    units: NDArray[np.uint16] = np.where(lost, 0, np.rint(noisy * DEPTH_SCALE)).astype(np.uint16)
    return units
