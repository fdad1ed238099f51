"""An elastic sheet against closed forms of its law: uniaxial stretch, pure shear, a bent plate."""

from __future__ import annotations

import numpy as np
import pytest

from endoprior.core.geometry import strain_between
from endoprior.phantom.sheet import NoEquilibrium, Sheet, offset, tangents

THICKNESS = 2.0


def flat(rows: int, columns: int, wide: float, high: float) -> np.ndarray:
    """(rows, columns, 3) vertices of a flat sheet."""
    y, x = np.meshgrid(np.linspace(0, high, rows), np.linspace(0, wide, columns), indexing="ij")
    return np.stack([x, y, 0 * x], -1)


def pulled(factor: float, holds_sides: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """A 12 mm x 6 mm sheet pulled along x: its vertices before and after, and the force on the pulled side."""
    rest = flat(7, 13, 12, 6)
    sheet, none = Sheet(rest, (1, 1), THICKNESS), np.zeros((rest.size // 3, 3))
    fixed = np.zeros(rest.shape, bool)
    fixed[:, [0, -1], 0] = fixed[..., 2] = fixed[3, :, 1] = True
    if holds_sides:
        fixed[[0, -1], :, 1] = True
    start = rest * [factor - 1, 0, 0]
    start[:, 1:-1, :2] += np.random.default_rng(0).normal(0, 0.05, (7, 11, 2)) * ~fixed[:, 1:-1, :2]
    moved = sheet.equilibrium(start.reshape(-1, 3), none[:, 0], none, fixed.reshape(-1, 3))
    force = sheet.forces(moved, none[:, 0], none).reshape(rest.shape)[:, -1, 0].sum()
    return rest, rest + moved.reshape(rest.shape), float(force)


@pytest.mark.parametrize("factor", [1.6, 1.1, 0.7])
def test_uniaxial_stretch_is_that_of_the_neo_hookean_law(factor):
    before, after, force = pulled(factor, holds_sides=False)
    strain = strain_between(tangents(before), tangents(after))
    expected = sorted([factor, factor**-0.5], reverse=True)
    assert strain.stretch == pytest.approx(np.broadcast_to(expected, strain.stretch.shape), abs=1e-6)
    assert strain.area == pytest.approx(np.full(strain.area.shape, factor**0.5), abs=1e-6)
    along = [1, 0, 0] if factor > 1 else [0, 1, 0]
    assert np.abs(strain.direction @ along) == pytest.approx(np.ones(strain.area.shape), abs=1e-9)
    assert force == pytest.approx(THICKNESS * 6 * (factor - factor**-2), abs=1e-5)


@pytest.mark.parametrize("factor", [1.6, 0.8])
def test_pure_shear_is_that_of_the_neo_hookean_law(factor):
    before, after, force = pulled(factor, holds_sides=True)
    strain = strain_between(tangents(before), tangents(after))
    expected = sorted([factor, 1.0], reverse=True)
    assert strain.stretch == pytest.approx(np.broadcast_to(expected, strain.stretch.shape), abs=1e-6)
    assert force == pytest.approx(THICKNESS * 6 * (factor - factor**-3), abs=1e-5)


def bent(columns: int) -> tuple[float, float]:
    """Largest error of stretch and of area on both faces of a plate 1 mm thick whose border is bent to a cylinder."""
    radius, angle = 20.0, 1.0
    rows, wide = columns // 2 + 1, 20.0
    rest = flat(rows, columns, wide, 10)
    turn = rest[..., 0] / radius - angle / 2
    cylinder = np.stack([radius * np.sin(turn) + wide / 2, rest[..., 1], radius * (1 - np.cos(turn))], -1)
    fixed, start = np.ones(rest.shape, bool), cylinder - rest
    fixed[2:-2, 2:-2] = False
    start[2:-2, 2:-2] *= 0.8
    none = np.zeros((rest.size // 3, 3))
    sheet = Sheet(rest, (10 / (rows - 1), wide / (columns - 1)), 1.0)
    moved = sheet.equilibrium(start.reshape(-1, 3), none[:, 0], none, fixed.reshape(-1, 3))
    errors = []
    for face in (-0.5, 0.5):
        before, after = (tangents(offset(x, face)) for x in (rest, rest + moved.reshape(rest.shape)))
        strain, expected = strain_between(before, after), 1 - face / radius
        stretch = np.abs(strain.stretch - sorted([expected, 1.0], reverse=True)).max()
        errors.append((stretch, np.abs(strain.area - expected).max()))
    return tuple(np.max(errors, 0))


def test_a_bent_plate_stretches_on_top_and_the_error_falls_with_the_mesh():
    coarse, medium, fine = (np.array(bent(columns)) for columns in (11, 21, 41))
    assert (coarse < 0.0035).all() and (medium < 0.35 * coarse).all()
    assert (fine < 0.0005).all()  # of a stretch that differs from 1 by 0.025


def test_forces_are_the_gradient_of_the_energy():
    rest = flat(4, 5, 4, 3) + np.random.default_rng(0).normal(0, 0.1, (4, 5, 3))
    sheet = Sheet(rest, (1, 1), THICKNESS)
    moved, step, target = np.random.default_rng(1).normal(0, 0.1, (3, 20, 3))
    stiffness = np.linspace(0, 1, 20)
    ends = [sheet.energy(moved + share * step, stiffness, target) for share in (-1e-5, 1e-5)]
    assert (sheet.forces(moved, stiffness, target) * step).sum() == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-6)


def test_a_start_without_an_equilibrium_nearby_is_said():
    rest = flat(5, 5, 4, 4)
    sheet, none = Sheet(rest, (1, 1), THICKNESS), np.zeros((25, 3))
    start = none.copy()
    start[6] = rest[0, 0] - rest[1, 1]  # on top of another vertex
    with pytest.raises(NoEquilibrium, match="no area"):
        sheet.equilibrium(start, none[:, 0], none, np.zeros((25, 3), bool))
