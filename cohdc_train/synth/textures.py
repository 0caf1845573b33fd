"""Draw procedural textures: surfaces of rooms with enough keypoints for ORB."""

import cv2
import numpy as np

from cohdc_train.types import Float32Array, Image

Texture = Image  # [h, w, 3] RGB, h and w powers of two
SATURATION = 0.35  # rooms are painted in calmer colors than people are dressed in


def noise(rng: np.random.Generator, height: int, width: int, coarsest: int = 4) -> Float32Array:
    """Draw smooth noise of several octaves, [height, width], of mean 0 and deviation 1."""
    total = np.zeros((height, width), dtype=np.float32)
    cells = coarsest
    weight = 1.0
    while cells <= min(height, width):
        rough = rng.normal(size=(cells, cells)).astype(np.float32)
        total += weight * cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, weight = cells * 2, weight * 0.72
    return total / max(float(total.std()), 1e-6)


def random_color(rng: np.random.Generator, low: float = 40, high: float = 225) -> Float32Array:
    """Draw an RGB color [3] with components in low..high, from gray to strongly tinted."""
    base = rng.uniform(low, high)
    mixed = base + rng.normal(0, 1, 3) * rng.uniform(4, 60)
    return np.clip(mixed, low, high).astype(np.float32)


def to_ink(rgb: Float32Array) -> tuple[float, ...]:
    """Return a color as OpenCV takes it."""
    return tuple(float(value) for value in rgb)


def random_ink(rng: np.random.Generator, low: float, high: float) -> tuple[float, ...]:
    """Draw a color as `random_color` does, and return it as OpenCV takes it."""
    return to_ink(random_color(rng, low, high))


def add_dirt(
    image: Float32Array, rng: np.random.Generator, grain: float = 6.0, stains: float = 9.0
) -> Texture:
    """Return a surface in muted colors with dirt and grain: float [h, w, 3] in 0..255 -> uint8."""
    height, width = image.shape[:2]
    gray = image.mean(axis=2, keepdims=True)
    image = gray + np.float32(SATURATION) * (image - gray)
    stain = cv2.resize(noise(rng, height // 2, width // 2), (width, height))
    dirt = stain * np.float32(stains)
    dirt += rng.standard_normal((height, width), dtype=np.float32) * np.float32(grain)
    dirty = image + dirt[..., None]
    return np.clip(dirty, 0, 255).astype(np.uint8)


def solid(height: int, width: int, rgb: Float32Array) -> Float32Array:
    """Return [height, width, 3] float32 of one color."""
    return np.tile(rgb.astype(np.float32), (height, width, 1))


def _draw(rng: np.random.Generator, low: int, high: int) -> int:
    """Draw a whole number in low..high - 1."""
    return int(rng.integers(low, high))


def _random_point(rng: np.random.Generator, width: int, height: int) -> tuple[int, int]:
    """Draw a pixel (x, y) of an image."""
    x = int(rng.integers(width))
    y = int(rng.integers(height))
    return x, y


def plaster(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw a painted wall with marks: short scratches, filled holes, stains."""
    image = solid(height, width, random_color(rng, 110, 225))
    for _ in range(_draw(rng, 60, 130)):
        x, y = _random_point(rng, width, height)
        shade = to_ink(np.clip(image[y, x] + rng.normal(0, 55), 0, 255))
        if rng.random() < 0.5:
            end = (x + int(rng.normal(0, width / 30)), y + int(rng.normal(0, height / 30)))
            cv2.line(image, (x, y), end, shade, _draw(rng, 1, 3), cv2.LINE_AA)
        else:
            radius = _draw(rng, 1, max(width // 90, 3))
            cv2.circle(image, (x, y), radius, shade, -1, cv2.LINE_AA)
    return add_dirt(image, rng, 7, 12)


def paint(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw a freshly painted wall: one color, nearly no grain."""
    return add_dirt(solid(height, width, random_color(rng, 150, 225)), rng, 0.8, 0.0)


def brick(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw bricks in mortar, each with a shade of its own."""
    rows = _draw(rng, 14, 24)
    columns = _draw(rng, 9, 16)
    image = solid(height, width, random_color(rng, 120, 210))
    base = random_color(rng, 60, 190)
    gap = max(width // 250, 1)
    for r in range(rows):
        top = r * height // rows + gap
        bottom = (r + 1) * height // rows - gap
        offset = 0.5 * (r % 2)
        for c in range(-1, columns):
            left = int((c + offset) * width / columns) + gap
            right = int((c + 1 + offset) * width / columns) - gap
            shade = np.clip(base + rng.normal(0, 16) + rng.normal(0, 6, 3), 0, 255)
            image[max(top, 0) : bottom, max(left, 0) : max(right, 0)] = shade
    return add_dirt(image, rng, 10, 10)


def tiles(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw a checker of two colors whose tiles differ slightly, with joints."""
    count = _draw(rng, 5, 13)
    pair = np.stack([random_color(rng, 40, 225), random_color(rng, 40, 225)])
    row = np.arange(height) * count // height
    column = np.arange(width) * count // width
    shade = rng.normal(0, 12, (count, count)).astype(np.float32)
    parity = (row[:, None] + column[None]) % 2
    image = pair[parity] + shade[row[:, None], column[None]][..., None]
    row_begins = np.diff(row, prepend=-1) > 0
    column_begins = np.diff(column, prepend=-1) > 0
    image[row_begins[:, None] | column_begins[None]] = random_color(rng, 30, 120)
    return add_dirt(image.astype(np.float32), rng, 7, 12)


def wood_texture(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw planks with grain along u, board ends and knots."""
    boards = _draw(rng, 3, 9)
    red, green, blue = rng.uniform(90, 190), rng.uniform(60, 140), rng.uniform(30, 95)
    base = np.array([red, green, blue], dtype=np.float32)
    image = np.zeros((height, width, 3), dtype=np.float32)
    for b in range(boards):
        top = b * height // boards
        bottom = (b + 1) * height // boards
        board = (width, bottom - top)
        grain = cv2.resize(noise(rng, 64, 16, 8), board, interpolation=cv2.INTER_CUBIC)
        image[top:bottom] = base + rng.normal(0, 14) + grain[..., None] * 12
        image[top : top + max(height // 200, 1)] *= 0.45
        end = int(rng.integers(width))
        image[top:bottom, end : end + max(width // 200, 1)] *= 0.45
        for _ in range(_draw(rng, 1, 5)):
            knot = (int(rng.integers(width)), _draw(rng, top, bottom))
            half_width = _draw(rng, 2, max(width // 40, 3))
            half_height = _draw(rng, 2, max(height // 80, 3))
            axes = (half_width, half_height)
            cv2.ellipse(image, knot, axes, 0, 0, 360, to_ink(base * 0.5), -1, cv2.LINE_AA)
    return add_dirt(image, rng, 6, 6)


def wallpaper(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw stripes with a motif that changes its color and size from place to place."""
    ground = random_color(rng, 90, 225)
    stripe = random_color(rng, 60, 225)
    period = _draw(rng, width // 14, width // 6)
    is_ground = (np.arange(width) // max(period // 2, 1)) % 2 == 0
    row = np.where(is_ground[None, :, None], ground, stripe)
    stripes = np.broadcast_to(row, (height, width, 3))
    image = np.ascontiguousarray(stripes).astype(np.float32)
    step = max(int(period * rng.uniform(0.6, 1.2)), 6)
    for y in range(step // 2, height, step):
        for x in range(step // 2, width, step):
            ink = random_ink(rng, 20, 235)
            radius = _draw(rng, max(step // 8, 2), max(step // 3, 4))
            sides = _draw(rng, 3, 8)
            angle = np.linspace(0, 2 * np.pi, sides, endpoint=False) + rng.uniform(0, 6)
            outline = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], 1)
            cv2.fillPoly(image, [outline.astype(np.int32)], ink, cv2.LINE_AA)
    return add_dirt(image, rng, 5, 8)


def carpet(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw a speckled carpet with a woven pattern of rectangles."""
    image = solid(height, width, random_color(rng, 50, 170))
    for _ in range(_draw(rng, 25, 60)):
        x, y = _random_point(rng, width, height)
        w = _draw(rng, 4, max(width // 8, 6))
        h = _draw(rng, 4, max(height // 8, 6))
        ink = random_ink(rng, 40, 190)
        thickness = int(rng.choice([-1, 2, 3]))
        cv2.rectangle(image, (x, y), (x + w, y + h), ink, thickness)
    return add_dirt(image, rng, 18, 10)


def poster_texture(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw random shapes and lines of letters in a frame."""
    image = solid(height, width, random_color(rng, 30, 235))
    for _ in range(_draw(rng, 8, 22)):
        ink = random_ink(rng, 10, 245)
        count = _draw(rng, 3, 6)
        shape = rng.uniform(0, 1, (count, 2)) * rng.uniform(0.2, 0.7)
        corners = shape + rng.uniform(-0.1, 0.8, 2)
        cv2.fillPoly(image, [(corners * [width, height]).astype(np.int32)], ink, cv2.LINE_AA)
        center = _random_point(rng, width, height)
        radius = _draw(rng, 2, max(width // 7, 4))
        thickness = int(rng.choice([-1, 2]))
        cv2.circle(image, center, radius, ink[::-1], thickness, cv2.LINE_AA)
    write_letters(image, rng, _draw(rng, 1, 6))
    edge = max(width // 32, 2)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), random_ink(rng, 10, 120), 2 * edge)
    return add_dirt(image, rng, 5, 4)


def books(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw shelves filled with book spines of many heights and colors."""
    shelves = _draw(rng, 3, 6)
    image = solid(height, width, random_color(rng, 30, 90))
    for s in range(shelves):
        board = max(height // 60, 2)
        top = s * height // shelves
        bottom = (s + 1) * height // shelves - board
        x = 0
        while x < width:
            thick = _draw(rng, max(width // 50, 3), max(width // 16, 6))
            tall = int((bottom - top) * rng.uniform(0.55, 0.95))
            image[bottom - tall : bottom, x : x + thick] = random_color(rng, 20, 235)
            band = bottom - int(tall * rng.uniform(0.3, 0.9))
            band_end = band + max(tall // 9, 1)
            image[band:band_end, x + 1 : x + thick - 1] = random_color(rng, 20, 245)
            x += thick + _draw(rng, 0, 3)
        image[bottom : bottom + board] = random_color(rng, 80, 160)
    return add_dirt(image, rng, 5, 4)


def screen(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw a monitor: bezel, windows and text."""
    image = solid(height, width, random_color(rng, 20, 160))
    for _ in range(_draw(rng, 2, 5)):
        x = _draw(rng, 0, width * 2 // 3)
        y = _draw(rng, 0, height * 2 // 3)
        ink = random_ink(rng, 150, 250)
        cv2.rectangle(image, (x, y), (x + width // 3, y + height // 3), ink, -1)
    write_letters(image, rng, 9)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (25.0, 25.0, 28.0), max(width // 14, 3))
    return add_dirt(image, rng, 2, 1)


def carton_texture(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw a painted or cardboard face with tape, labels and print."""
    image = solid(height, width, random_color(rng, 60, 215))
    image[:, width // 2 - width // 20 : width // 2 + width // 20] *= 0.8
    for _ in range(_draw(rng, 2, 6)):
        x = _draw(rng, 0, width * 3 // 4)
        y = _draw(rng, 0, height * 3 // 4)
        label_width = _draw(rng, width // 10, width // 3)
        label_height = _draw(rng, height // 10, height // 3)
        end = (x + label_width, y + label_height)
        cv2.rectangle(image, (x, y), end, random_ink(rng, 20, 245), -1)
    write_letters(image, rng, 4)
    return add_dirt(image, rng, 7, 9)


def write_letters(image: Float32Array, rng: np.random.Generator, lines: int) -> None:
    """Write lines of random letters over a float [h, w, 3] image, in place."""
    height, width = image.shape[:2]
    alphabet = list("ABCDEFGHKLMNPRSTUVXYZ0123456789abdefghknprt#%&")
    for _ in range(lines):
        text = "".join(rng.choice(alphabet, _draw(rng, 4, 14)))
        place = (_draw(rng, 0, width * 2 // 3), _draw(rng, height // 8, height))
        scale = float(rng.uniform(0.25, 1.1) * width / 256)
        write(image, text, place, scale, random_color(rng, 5, 250))


def write(
    image: Float32Array, text: str, place: tuple[int, int], scale: float, ink: Float32Array
) -> None:
    """Write one line of text over a float [h, w, 3] image, in place.

    OpenCV writes on uint8 only.
    """
    top = max(place[1] - int(40 * scale) - 2, 0)
    bottom = place[1] + int(16 * scale) + 2
    rows = image[top:bottom]
    stencil = np.zeros(rows.shape[:2], dtype=np.uint8)
    place, thick = (place[0], place[1] - top), max(int(2.2 * scale), 1)
    cv2.putText(stencil, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (255,), thick, cv2.LINE_AA)
    cover = stencil[..., None].astype(np.float32) / 255
    rows[:] = rows * (1 - cover) + ink * cover


WALLS = (plaster, brick, tiles, wallpaper, wood_texture)
FLOORS = (wood_texture, tiles, carpet)
FACES = (wood_texture, carton_texture, plaster, carton_texture)
