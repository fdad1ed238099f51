"""Families of instruments that real operating rooms have: each a pair that differs in shape, color and gloss.

The first of a pair pulls the tissue, the second moves above it. Lengths are mm; instruments are a little thicker than
their names say (5 mm: 6 mm), so that a pair covers about as much of the image as in published clips.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .graspers import JAW_MM
from .instrument_light import Material
from .instrument_shapes import JAWS, LOWER, SHAFT, UPPER, Part, bar, pin, rod, tube
from .instrument_tracing import Instrument

Color = tuple[float, float, float]
_FAR_MM = 400.0
"""Where shafts end, outside of every image."""
_BENT = (1.0, 0.89)
"""Bend of a wrist: as that of the graspers."""


def steel(color: Color = (0.72, 0.70, 0.67), rough: float = 0.22) -> Material:
    """Bright metal."""
    return Material(color, rough, diffuse=0.07, mirror=0.95, shine=0.085, metal=1.0, waves=0.7)


def plastic(color: Color, rough: float = 0.38, shine: float = 0.014) -> Material:
    """Smooth plastic, paint or insulation."""
    return Material(color, rough, diffuse=1.0, mirror=0.04, shine=shine, mottle=0.03)


GRAY_BLUE = Material((0.052, 0.062, 0.079), rough=0.55, mirror=0.02, shine=0.010, mottle=0.05)
BLACK = Material((0.012, 0.012, 0.013), rough=0.50, mirror=0.02, shine=0.008, weave=0.08)
DARK_STEEL = Material((0.11, 0.11, 0.12), rough=0.34, diffuse=0.30, mirror=0.70, shine=0.25, metal=1.0, waves=0.5)
POLISHED = replace(steel((0.80, 0.79, 0.77), 0.19), diffuse=0.03, shine=0.09, waves=0.25)
BRUSHED = replace(steel((0.66, 0.65, 0.63), 0.30), diffuse=0.14, weave=0.05, waves=0.3)
GOLD = replace(steel((0.83, 0.53, 0.14), 0.24), diffuse=0.16)
WHITE, IVORY, GRAY = plastic((0.36, 0.355, 0.34)), plastic((0.34, 0.285, 0.19)), plastic((0.16, 0.17, 0.18))
GREEN, BLUE = plastic((0.010, 0.095, 0.036)), plastic((0.014, 0.052, 0.21))


def _shaft(material: int, start: float, radius: float, rounding: float = 0.4) -> Part:
    return tube(SHAFT, material, (start, _FAR_MM), (radius, radius), rounding)


def _pair(
    material: int,
    span: tuple[float, float],
    half_widths: tuple[float, float],
    thickness: tuple[float, float],
    rounding: float = 0.5,
    lift: float = 0.0,
    bend: tuple[float, float] = (0, 0),
    window: tuple[float, float, float] = (0, 0, 0),
) -> tuple[Part, ...]:
    """Two equal jaws; see `bar`."""
    shape = span, half_widths, thickness, rounding, lift, bend, window
    return tuple(bar(axes, material, *shape) for axes in (UPPER, LOWER))


def _fork(material: int, radius: float, stop: float) -> tuple[Part, Part]:
    """The end of a straight instrument: two prongs that hold the jaws' pin."""
    prongs = tube(SHAFT, material, (-1.5, stop), (0.75 * radius, radius), 0.5, slot=0.34 * radius)
    return prongs, pin(JAWS, material, 0, 0.42 * radius, 0.8 * radius)


def _robotic(jaws: tuple[Part, ...], length: float, name: str, roll: float) -> Instrument:
    """A wristed instrument of 8 mm: matte shaft with a tapered end, two steel joints at right angles, jaws."""
    wrist = (
        tube(SHAFT, 0, (9.6, 13.2), (3.7, 4.1), 0.5),
        tube(SHAFT, 1, (3.4, 10.4), (2.9, 3.3), 0.5, grooves=(0.25, 3.4)),
        pin(SHAFT, 1, 4.6, 2.5, 3.2),
        tube(JAWS, 1, (-5.0, 1.6), (2.7, 2.0), 0.6, slot=0.9),
        pin(JAWS, 1, 0, 1.7, 2.7),
    )
    parts = (_shaft(0, 12.5, 4.1, 0.6), *wrist, *jaws)
    materials, ball = (GRAY_BLUE, steel()), length / 2 + 7  # the wrist is in the ball too
    return Instrument(name, parts, materials, length, 14.0, 4.4, wrist=_BENT, ball_mm=ball, roll=roll)


def _gray_blue() -> tuple[Instrument, Instrument]:
    fenestrated = _pair(1, (-0.8, 16), (2.4, 1.5), (1.7, 0.8), lift=0.06, window=(0.75, 5.2, 12.4))
    driver = _pair(1, (-0.8, 11), (2.1, 1.5), (2.1, 1.3), lift=0.05)
    forceps = _robotic(fenestrated, 16.0, "wristed fenestrated forceps", 0.7)
    return forceps, _robotic(driver, 11.0, "wristed needle driver", 0.0)


def _black() -> tuple[Instrument, Instrument]:
    jaws = _pair(1, (-0.8, 17), (2.0, 0.7), (1.9, 0.8), 0.9, 0.05, (0.0, 2.6))
    dissector = (_shaft(0, 6.0, 3.1), tube(SHAFT, 1, (4.0, 7.0), (2.5, 2.7)), *_fork(1, 2.5, 5.0), *jaws)
    blade = bar(JAWS, 1, (-2.0, 11.0), (1.6, 2.3), (1.5, 0.7), 0.7, -0.6)
    spatula = (_shaft(0, 2.0, 3.4, 1.4), tube(SHAFT, 0, (0.5, 3.0), (1.7, 2.6), 0.5), blade)
    return (
        Instrument("curved dissector", dissector, (BLACK, DARK_STEEL), 17.0, 7.5, 3.3),
        Instrument("spatula electrode", spatula, (BLACK, DARK_STEEL), 11.0, 3.5, 3.6, grip_mm=0.5),
    )


def _white_plastic() -> tuple[Instrument, Instrument]:
    anvil = bar(UPPER, 1, (-1.5, 31), (3.6, 2.9), (2.4, 1.6), 0.55, 0.5, window=(0.5, 4.0, 27.0))
    cartridge = bar(LOWER, 0, (-1.5, 33), (4.2, 3.8), (4.2, 3.4), 0.45, 0.5)
    channel = bar(LOWER, 1, (-1.5, 29), (4.5, 4.1), (2.6, 2.2), 0.45, 2.9)
    neck = tube(SHAFT, 1, (1.5, 8.0), (4.3, 4.8), 0.8), tube(SHAFT, 0, (7.0, 11.5), (5.3, 5.3), 0.5, grooves=(0.3, 2.2))
    body = replace(WHITE, rings=(17.0, 9.0, 0.7, 3), mark=(0.03, 0.09, 0.30))
    stapler = (_shaft(0, 10.5, 5.1, 0.8), *neck, anvil, cartridge, channel)
    long_jaws = {"grip_mm": 6.0, "ball_mm": 20.0, "opens": 0.55, "roll": 0.4}
    sealer_jaws = _pair(1, (-0.8, 15), (2.3, 1.6), (2.3, 1.5), 0.75, 0.04, (1.6, 0.0))
    sealer = (_shaft(0, 6.0, 3.1), *_fork(1, 2.6, 7.0), *sealer_jaws)
    return (
        replace(Instrument("linear stapler", stapler, (body, BRUSHED), 31.0, 12.0, 5.6), **long_jaws),
        Instrument("vessel sealer", sealer, (IVORY, GRAY), 15.0, 7.5, 3.3),
    )


def _steel() -> tuple[Instrument, Instrument]:
    jaws = _pair(0, (-0.8, 14), (2.2, 1.3), (2.2, 1.3), 0.6, 0.04)
    holder = (_shaft(0, 6.5, 3.1), tube(SHAFT, 1, (5.0, 9.0), (3.4, 3.4), 0.4, grooves=(0.2, 1.3)), *_fork(0, 2.7, 6.0))
    # The bore shows only at its open end; the side holes lead into it.
    suction = (tube(SHAFT, 0, (0.0, _FAR_MM), (3.0, 3.0), 0.7, 2.0, holes=(5, 0.85, 3.2, 3.6)),)
    return (
        Instrument("needle holder", (*holder, *jaws), (POLISHED, BRUSHED), 14.0, 9.5, 3.6),
        Instrument("suction tube", suction, (POLISHED,), 2.0, _FAR_MM, 3.2, grip_mm=2.0),
    )


def _gold() -> tuple[Instrument, Instrument]:
    claw = _pair(0, (-0.8, 18), (2.8, 2.4), (1.5, 0.9), 0.8, 0.1, window=(1.35, 4.5, 14.5))
    collar = tube(SHAFT, 0, (4.4, 8.4), (3.6, 3.6), 0.5, grooves=(0.3, 1.9))
    tines = _pair(0, (-6.0, 19), (1.1, 0.5), (1.2, 0.6), 0.9, 0.25, (0.0, 0.9))
    sleeve = tube(SHAFT, 1, (5.0, 16.0), (1.9, 2.4), 0.4)
    parts = _shaft(0, 6.0, 3.2), collar, *_fork(0, 2.6, 6.0), *claw
    bipolar = (_shaft(0, 14.0, 2.2), sleeve, *tines)
    return (
        Instrument("wide fenestrated grasper", parts, (GOLD,), 18.0, 9.0, 3.8, roll=0.8),
        Instrument("bipolar forceps of 3 mm", bipolar, (GOLD, BLACK), 19.0, 16.5, 2.6, ball_mm=15.0),
    )


def _green() -> tuple[Instrument, Instrument]:
    jaws = _pair(1, (-0.8, 15), (2.6, 2.1), (2.4, 1.7), 0.6, 0.3, (5.0, 0.0))
    applier = (_shaft(0, 7.5, 4.6, 0.7), tube(SHAFT, 0, (5.5, 8.5), (3.7, 4.4), 0.6), *_fork(1, 3.6, 7.0), *jaws)
    heel, tip = (9.0, 0.0, 0.0), (9.6, 5.6, 0.0)
    wire = rod(JAWS, 1, (-3.0, 0, 0), heel, (0.95, 0.95)), rod(JAWS, 1, heel, tip, (0.95, 0.6))
    hook = (_shaft(0, 2.0, 2.8, 1.0), tube(SHAFT, 2, (-0.5, 2.6), (1.5, 2.0), 0.4), *wire)
    return (
        Instrument("clip applier", applier, (GREEN, BRUSHED), 15.0, 9.0, 4.8, ball_mm=14.0),
        Instrument("hook electrode", hook, (GREEN, steel(), WHITE), 9.6, 3.0, 3.0, grip_mm=0.5),
    )


def _blue() -> tuple[Instrument, Instrument]:
    jaws = _pair(1, (-0.8, 20), (2.3, 1.6), (1.6, 1.0), 0.7, 0.05, window=(0.5, 6.0, 16.0))
    grasper = (_shaft(0, 6.5, 3.1), *_fork(1, 2.5, 7.4), *jaws)
    blades = _pair(1, (-0.8, 15), (1.9, 0.4), (1.0, 0.7), 0.6, -0.3, (3.2, 0.0))
    scissors = (_shaft(0, 8.0, 3.3), tube(SHAFT, 2, (5.5, 8.5), (2.6, 2.6), 0.4), *_fork(1, 2.3, 6.5), *blades)
    return (
        Instrument("long grasper", grasper, (BLUE, steel()), 20.0, 8.0, 3.3, roll=0.6),
        Instrument("curved scissors", scissors, (BLUE, steel(), BLACK), 15.0, 9.0, 3.3, ball_mm=13.0),
    )


def _graspers() -> tuple[Instrument, Instrument]:
    colors = ((0.72, 0.70, 0.67), (0.050, 0.053, 0.050)), ((0.80, 0.52, 0.14), (0.014, 0.014, 0.017))
    tools = [
        Instrument("grasper", (), (Material(c), Material(s)), JAW_MM, 0.0, 0.0, wrist=(0.62, 0.55)) for c, s in colors
    ]
    return tools[0], tools[1]


_PAIRS = {
    "gray_blue": _gray_blue,
    "black": _black,
    "white_plastic": _white_plastic,
    "steel": _steel,
    "gold": _gold,
    "green": _green,
    "blue": _blue,
}


def instruments_of(family: str, seed: int) -> tuple[Instrument, Instrument]:
    """The pair of one family of `PhantomConfig.instruments`.

    Args:
        seed: of the shade, which differs a little between instruments, and of what is `mixed`.
    """
    if family == "graspers":
        return _graspers()
    rng = np.random.default_rng([seed, 9])
    if family == "mixed":
        first, second = rng.choice(list(_PAIRS), 2, replace=False)
        pair = _marked(_PAIRS[first]()[0], rng), _marked(_PAIRS[second]()[1], rng)
    else:
        pair = _PAIRS[family]()
    return _shaded(pair[0], rng), _shaded(pair[1], rng)


def _shaded(tool: Instrument, rng: np.random.Generator) -> Instrument:
    """The instrument, a little lighter or darker."""
    tone = rng.uniform(0.88, 1.12)
    return replace(tool, materials=tuple(replace(m, color=tuple(tone * c for c in m.color)) for m in tool.materials))


def _marked(tool: Instrument, rng: np.random.Generator) -> Instrument:
    """The instrument with printed rings and text on its shaft, and signs of wear."""
    shaft = tool.materials[0]
    ink = (0.02, 0.02, 0.03) if np.mean(shaft.color) > 0.2 else (0.62, 0.62, 0.58)
    start = tool.clear_mm if tool.clear_mm < _FAR_MM else 22.0
    rings = start + rng.uniform(2, 5), rng.uniform(2.5, 4.0), rng.uniform(0.6, 1.1), float(rng.integers(2, 5))
    text = rings[0] + rings[1] * rings[3] + rng.uniform(1, 3)
    worn = [replace(m, wear=rng.uniform(0.5, 0.9), mottle=0.10) for m in tool.materials]
    worn[0] = replace(worn[0], mark=ink, rings=rings, print_at=(text, rng.uniform(14, 24)))
    return replace(tool, materials=tuple(worn))
