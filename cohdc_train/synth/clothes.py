"""Textures of people: cloth with patterns, skin, hair, a face."""

import cv2
import numpy as np

from cohdc_train.synth.textures import (
    Texture,
    noise,
    random_color,
    random_ink,
    solid,
    to_ink,
    write,
)
from cohdc_train.types import Float32Array

SIDE = 128  # px of a garment's texture


def _folds(image: Float32Array, rng: np.random.Generator, depth: float) -> Texture:
    """Return an image with wrinkles as soft light and dark streaks, and with a little weave."""
    streaks = cv2.resize(noise(rng, 32, 32, 4), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    weave = rng.normal(0, 3, (SIDE, SIDE, 1))
    folded = image * (1 + depth * streaks[..., None]) + weave
    return np.clip(folded, 0, 255).astype(np.uint8)


def cloth(rng: np.random.Generator, patterned: float) -> Texture:
    """Draw a garment, [128, 128, 3].

    patterned: probability of stripes, checks, dots or a print instead of one color.
    """
    image = solid(SIDE, SIDE, random_color(rng, 15, 235))
    if rng.random() < patterned:
        pattern = (_stripes, _checks, _dots, _print)[int(rng.integers(4))]
        pattern(image, rng)
    return _folds(image, rng, 0.09)


def _stripes(image: Float32Array, rng: np.random.Generator) -> None:
    period = int(rng.integers(8, 32))
    inside = np.arange(SIDE) % period < period * rng.uniform(0.2, 0.6)
    if rng.random() < 0.6:
        image[inside] = random_color(rng, 15, 240)
    else:
        image[:, inside] = random_color(rng, 15, 240)


def _checks(image: Float32Array, rng: np.random.Generator) -> None:
    period = int(rng.integers(8, 28))
    ink = random_color(rng, 15, 240)
    line = np.arange(SIDE) % period < period * rng.uniform(0.25, 0.5)
    image[line] = 0.5 * image[line] + 0.5 * ink
    image[:, line] = 0.5 * image[:, line] + 0.5 * ink


def _dots(image: Float32Array, rng: np.random.Generator) -> None:
    ink = random_ink(rng, 15, 240)
    for x, y in rng.integers(0, SIDE, (int(rng.integers(30, 90)), 2)):
        cv2.circle(image, (int(x), int(y)), int(rng.integers(1, 5)), ink, -1, cv2.LINE_AA)


def _print(image: Float32Array, rng: np.random.Generator) -> None:
    """Draw a motif on the chest (u = 0.5) and on the back (u = 0)."""
    for x in (SIDE // 2, 6):
        for _ in range(5):
            ink = random_ink(rng, 10, 245)
            corners = rng.normal((x, SIDE * 0.45), 9, (4, 2))
            cv2.fillPoly(image, [corners.astype(np.int32)], ink, cv2.LINE_AA)
        text = "".join(rng.choice(list("ABCEHKMRSTX012589"), 4))
        write(image, text, (x - 20, SIDE // 2 + 14), 0.55, random_color(rng, 150, 250))


def skin_tone(rng: np.random.Generator) -> Float32Array:
    """Draw a color between dark and light skin, [3] RGB."""
    light = np.array([236, 196, 170], dtype=np.float32)
    dark = np.array([84, 54, 38], dtype=np.float32)
    mixed = dark + (light - dark) * rng.beta(1.6, 1.0)
    varied = mixed + rng.normal(0, 5, 3)
    return np.clip(varied, 0, 255).astype(np.float32)


def skin(rng: np.random.Generator, tone: Float32Array) -> Texture:
    """Draw bare skin, [128, 128, 3]."""
    return _folds(solid(SIDE, SIDE, tone), rng, 0.03)


def face(rng: np.random.Generator, tone: Float32Array, hair: Float32Array) -> Texture:
    """Draw the texture of a head, [128, 128, 3].

    The face looks out at u = 0.5. Its eyes lie at v = 0.46, its mouth at v = 0.66.
    """
    image = solid(SIDE, SIDE, tone)
    center = SIDE // 2
    brow = to_ink(hair * 0.7)
    lips = to_ink(np.clip(tone * np.array([0.9, 0.6, 0.6]), 0, 255))
    for side in (-1, 1):
        x = center + side * 9
        cv2.ellipse(image, (x, 59), (5, 3), 0, 0, 360, (240.0, 240.0, 235.0), -1, cv2.LINE_AA)
        cv2.circle(image, (x, 59), 2, (40.0, 30.0, 25.0), -1, cv2.LINE_AA)
        cv2.line(image, (x - 6, 53), (x + 6, 52), brow, 2, cv2.LINE_AA)
    shade = to_ink(tone * 0.8)
    cv2.line(image, (center, 61), (center + 2, 73), shade, 2, cv2.LINE_AA)
    cv2.line(image, (center - 3, 74), (center + 4, 74), shade, 2, cv2.LINE_AA)
    cv2.ellipse(image, (center, 84), (8, 2), 0, 0, 360, lips, -1, cv2.LINE_AA)
    if rng.random() < 0.25:  # a beard
        image[88:] = 0.4 * image[88:] + 0.6 * hair
    return _folds(image, rng, 0.03)


def hair(rng: np.random.Generator, rgb: Float32Array) -> Texture:
    """Draw strands of hair that run down, [128, 128, 3]."""
    coarse = rng.normal(0, 16, (4, SIDE)).astype(np.float32)
    strands = cv2.resize(coarse, (SIDE, SIDE))
    striped = solid(SIDE, SIDE, rgb) + strands[..., None]
    image: Texture = np.clip(striped, 0, 255).astype(np.uint8)
    return image


def hair_color(rng: np.random.Generator) -> Float32Array:
    """Draw a color of hair, [3] RGB: black, brown, blond, red or gray."""
    known = np.array(
        [[22, 18, 16], [58, 38, 26], [96, 64, 40], [178, 142, 88], [120, 58, 30], [150, 148, 145]]
    )
    chosen = known[int(rng.integers(len(known)))]
    rgb: Float32Array = np.clip(chosen + rng.normal(0, 8, 3), 5, 230).astype(np.float32)
    return rgb
