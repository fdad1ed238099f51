"""Sample images with a painted border, for tests of the round border."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from endoprior.footage.border import find_strips
from endoprior.footage.round_border import Circle, find_circle

WIDTH, HEIGHT, COUNT = 320, 240, 10


@dataclass
class Painted:
    """Images of one clip, and the truth."""

    images: list
    circles: list = field(default_factory=list)
    """The round border of each image; empty without one."""
    shows: np.ndarray | None = None
    """(H, W) True where an image shows tissue, as far as straight borders go."""


def tissue(rng, count=COUNT, speed=3.0, contrast=1.0):
    """Images of a reddish texture that slides, with bright and dark parts."""
    side = int(speed * count) + 8
    shape = HEIGHT + side, WIDTH + side
    level = np.ones(shape)
    for sigma, weight in ((4, 0.18), (14, 0.3), (45, 0.5)):
        noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma)
        level += contrast * weight * noise / noise.std() * 0.5
    level = np.clip(level, 0.2, 2)[..., None] * rng.uniform(60, 110) * [1.0, 0.6, 0.55]
    dx, dy = rng.uniform(-1, 1, 2) * speed
    start = [side - 4 if d < 0 else 4 for d in (dy, dx)]
    at = [(int(start[0] + dy * i), int(start[1] + dx * i)) for i in range(count)]
    return [np.clip(level[y : y + HEIGHT, x : x + WIDTH], 0, 255) for y, x in at]


def shadow(images, circle, rng, degrees):
    """Dark tissue with a soft outline touches the border along an arc, in the same place in all images."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    angle = rng.uniform(0, 360)
    at = np.degrees(np.arctan2(y - circle.center_y, x - circle.center_x))
    off = np.abs((at - angle + 180) % 360 - 180)
    depth = circle.radius - np.hypot(x - circle.center_x, y - circle.center_y)
    dark = 1 / (1 + np.exp((off - degrees / 2) / 3)) / (1 + np.exp((depth - 0.3 * circle.radius) / 4))
    return [image * (1 - 0.97 * dark[..., None]) for image in images]


def in_circle(images, circles, blur=0.0, ring=0.0, ring_px=2.0, haze=0.0):
    """Cut round images, with a blurred outline, a lit ring inside of it, and haze beyond it."""
    done = []
    for image, circle in zip(images, circles, strict=True):
        inside = circle.mask(WIDTH, HEIGHT).astype(float)
        if ring:
            image = np.where((circle.mask(WIDTH, HEIGHT, ring_px) | (inside == 0))[..., None], image, ring)
        if blur:
            inside = cv2.GaussianBlur(inside, (0, 0), blur)
        cut = image * inside[..., None]
        if haze:
            cut = cut + haze * cv2.GaussianBlur(cut, (0, 0), 8) * (1 - inside[..., None])
        done.append(cut)
    return done


def with_glare(images, circles, rng, spots=2, share=0.8, size=0.25):
    """Overexposed regions spill over the border in most images, with light around them."""
    where = rng.uniform(0, 2 * np.pi, spots)
    done = []
    for image, circle in zip(images, circles, strict=True):
        glare = np.zeros((HEIGHT, WIDTH), np.float32)
        for angle in where:
            if rng.random() < share:
                reach = circle.radius * rng.uniform(0.9, 1.02)
                x, y = circle.center_x + np.cos(angle) * reach, circle.center_y + np.sin(angle) * reach
                axes = (circle.radius * size * rng.uniform(0.5, 1, 2)).astype(int)
                cv2.ellipse(glare, (int(x), int(y)), tuple(map(int, axes)), rng.uniform(0, 180), 0, 360, 255, -1)
        light = cv2.GaussianBlur(glare, (0, 0), 2) + 0.15 * cv2.GaussianBlur(glare, (0, 0), 12)
        done.append(image + light[..., None])
    return done


def finish(images, rng, noise=2.0, quality=60):
    """8 bit with noise, compressed."""
    done = []
    for image in images:
        image = np.clip(image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8)
        code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        done.append(cv2.imdecode(code, cv2.IMREAD_COLOR))
    return done


FULL = ((155, 165), (115, 125), (100, 112))
SIDES = ((150, 170), (110, 130), (135, 150))
CORNERS = ((150, 170), (112, 128), (165, 180))
OFF_CENTER = ((110, 130), (90, 110), (110, 125))
ONE_CORNER_HIDDEN = ((120, 135), (95, 105), (150, 165))


def circle_of(rng, ranges):
    return Circle(*(float(rng.uniform(*r)) for r in ranges))


def round_image(rng, ranges, *, count=COUNT, drift=0.0, dark=0.0, glare=0, bars=0, text=False, speed=3.0, **rim):
    """A clip with a round border. bars: rows of black above and below that cut the circle."""
    circle = circle_of(rng, ranges)
    steps = np.cumsum(rng.normal(size=(count, 2)), 0)
    steps = drift * circle.radius * steps / np.abs(steps).max()
    circles = [Circle(circle.center_x + dx, circle.center_y + dy, circle.radius) for dx, dy in steps]
    images = tissue(rng, count, speed)
    if dark:
        images = shadow(images, circle, rng, dark)
    images = in_circle(images, circles, **rim)
    if glare:
        images = with_glare(images, circles, rng, spots=glare)
    shows = np.ones((HEIGHT, WIDTH), bool)
    if bars:
        shows[:bars] = shows[HEIGHT - bars :] = False
        images = [image * shows[..., None] for image in images]
    if text:
        panel = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for y in (20, 40, 200):
            cv2.putText(panel, "12:05 EXAM", (4, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (200, 200, 200), 1)
        images = [np.maximum(image, panel) for image in images]
    return Painted(finish(images, rng), circles, shows)


ROUND = {
    "whole": lambda rng: round_image(rng, FULL),
    "cut above and below": lambda rng: round_image(rng, SIDES),
    "four corners": lambda rng: round_image(rng, CORNERS),
    "off center": lambda rng: round_image(rng, OFF_CENTER),
    "off center, three corners": lambda rng: round_image(rng, ONE_CORNER_HIDDEN),
    "glare over it": lambda rng: round_image(rng, FULL, glare=2),
    "glare, cut": lambda rng: round_image(rng, SIDES, glare=3),
    "dark tissue at it": lambda rng: round_image(rng, FULL, dark=120),
    "dark tissue, cut": lambda rng: round_image(rng, SIDES, dark=70),
    "dark tissue and glare": lambda rng: round_image(rng, FULL, dark=90, glare=2),
    "lit rim": lambda rng: round_image(rng, SIDES, ring=230),
    "lit rim, wide": lambda rng: round_image(rng, FULL, ring=200, ring_px=5),
    "blurred": lambda rng: round_image(rng, SIDES, blur=2.0),
    "haze": lambda rng: round_image(rng, FULL, haze=0.4),
    "bars": lambda rng: round_image(rng, SIDES, bars=24),
    "bars, whole": lambda rng: round_image(rng, FULL, bars=16),
    "moving border": lambda rng: round_image(rng, SIDES, drift=0.015),
    "moving border, glare": lambda rng: round_image(rng, FULL, drift=0.01, glare=2),
    "text": lambda rng: round_image(rng, ((190, 200), (115, 125), (105, 112)), text=True),
    "still camera": lambda rng: round_image(rng, SIDES, speed=0.0, glare=1, dark=40),
    "one image": lambda rng: round_image(rng, SIDES, count=1),
    "three images, glare": lambda rng: round_image(rng, FULL, count=3, glare=2),
}


def masked(rng, mask, soft=0.0, count=COUNT, speed=3.0):
    mask = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), soft) if soft else mask.astype(np.float32)
    return Painted(finish([image * mask[..., None] for image in tissue(rng, count, speed)], rng))


def vignetting(rng):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    reach = np.hypot(x - rng.uniform(140, 180), y - rng.uniform(100, 140))
    fall = np.clip(1.2 - (reach / rng.uniform(150, 200)) ** rng.choice([2, 3, 4]), 0.0, 1)
    return masked(rng, fall)


def dark_corners(rng):
    """Dark tissue in the corners, with the soft outline of anatomy."""
    noise = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 25)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    reach = np.hypot((x - 160) / 160, (y - 120) / 120)
    return masked(rng, reach + 0.25 * noise / noise.std() < 1.05, soft=rng.uniform(1, 5), speed=rng.choice([0, 3]))


def polygon(rng, sides=8):
    """A regular polygon, or a rectangle with cut corners."""
    if rng.random() < 0.5:
        turn = rng.uniform(0, 1)
        corners = [
            (160 + 118 * np.cos(2 * np.pi * (i + turn) / sides), 120 + 118 * np.sin(2 * np.pi * (i + turn) / sides))
            for i in range(sides)
        ]
    else:
        cut = rng.uniform(20, 75)
        corners = [(cut, 0), (320 - cut, 0), (320, cut), (320, 240 - cut), (320 - cut, 240), (cut, 240), (0, 240 - cut)]
        corners += [(0, cut)]
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 1)
    return masked(rng, mask, soft=0.7)


def rounded(rng):
    """A rectangle with round corners between black bars."""
    mask, r = np.zeros((HEIGHT, WIDTH), np.uint8), int(rng.uniform(8, 40))
    x0, y0 = (int(rng.choice([0, 30])), int(rng.choice([0, 20])))
    mask[y0 + r : HEIGHT - y0 - r, x0 : WIDTH - x0] = mask[y0 : HEIGHT - y0, x0 + r : WIDTH - x0 - r] = 1
    for x in (x0 + r, WIDTH - 1 - x0 - r):
        for y in (y0 + r, HEIGHT - 1 - y0 - r):
            cv2.circle(mask, (x, y), r, 1, -1)
    return masked(rng, mask)


def barred(rng):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    top, left = rng.integers(0, 40, 2)
    mask[top : HEIGHT - rng.integers(0, 40), left : WIDTH - rng.integers(0, 60)] = True
    return masked(rng, mask)


def lumen(rng):
    """A round dark cavity in the middle: dark inside, lit outside."""
    mask = ~Circle(rng.uniform(130, 190), rng.uniform(100, 140), rng.uniform(40, 90)).mask(WIDTH, HEIGHT)
    return masked(rng, mask, soft=rng.uniform(0.5, 3))


def labelled(rng):
    painted = masked(rng, np.ones((HEIGHT, WIDTH), bool))
    for image in painted.images:
        for y in (2, 205):
            image[y : y + 30, 4:120] = 0
            cv2.putText(image, "SMITH 12:05", (8, y + 20), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (220, 220, 220), 1)
    return painted


NOT_ROUND = {
    "plain": lambda rng: masked(rng, np.ones((HEIGHT, WIDTH), bool)),
    "vignetting": vignetting,
    "dark corners": dark_corners,
    "polygon": polygon,
    "round corners": rounded,
    "bars": barred,
    "dark cavity": lumen,
    "labels": labelled,
}


def judge(painted: Painted) -> dict:
    """Errors of the found circle in radii, pixels kept beyond the border, share of it lost."""
    circle = find_circle(painted.images)
    if not painted.circles or circle is None:
        return {"found": circle is not None}
    true = painted.circles
    x, y = np.mean([[c.center_x, c.center_y] for c in true], 0)
    error = max(np.hypot(circle.center_x - x, circle.center_y - y), abs(circle.radius - true[0].radius))
    kept = circle.mask(WIDTH, HEIGHT, circle.margin_px)
    bars = find_strips(painted.images, circle)
    kept[: bars.top] = kept[HEIGHT - bars.bottom :] = False
    kept[:, : bars.left] = kept[:, WIDTH - bars.right :] = False
    shows = np.logical_and.reduce([c.mask(WIDTH, HEIGHT) for c in true]) & painted.shows
    return {
        "found": True,
        "error": error / true[0].radius,
        "beyond": int((kept & ~shows).sum()),
        "lost": 1 - (kept & shows).sum() / shows.sum(),
    }
