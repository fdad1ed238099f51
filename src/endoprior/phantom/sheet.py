"""A thin elastic sheet in equilibrium, by finite elements: neo-Hookean, incompressible, with bending, on springs.

Energy per unit of undeformed area, in units of the shear modulus times mm, with the thickness t in mm:

- stretch: t/2 (tr C + 1/det C - 3), the neo-Hookean law in plane stress; C (2, 2) is the right Cauchy-Green tensor;
- bending: t^3/6 times the second derivatives of the displacement as in Kirchhoff's plate of Poisson's ratio 1/2;
- springs: k/2 |u - g|^2 with a stiffness k and a target displacement g at each vertex.

Letters: a grid of (GH, GW) vertices, V = GH * GW; two triangles a cell, E in all; displacements u (V, 3), mm.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

POISSON = 0.5
_TOLERANCE = 1e-7
"""Largest force on a vertex in equilibrium, in units of the shear modulus times mm^2."""
_MAX_STEPS = 60
_HALVINGS = 12


class NoEquilibrium(RuntimeError):
    """The solver found no equilibrium; the load steps are too large."""


class Sheet:
    """A sheet over a regular grid. Its undeformed shape may be curved; bending is that of the flat grid."""

    def __init__(self, rest: NDArray, spacing: tuple[float, float], thickness: float) -> None:
        """Args: rest: (GH, GW, 3) undeformed, mm. spacing: mm between the rows and between the columns of the grid."""
        rows, columns = rest.shape[:2]
        self.rest = rest.reshape(-1, 3).astype(np.float64)
        self.thickness, self._grid, self._spacing = thickness, (rows, columns), spacing
        self.triangles = _triangles(rows, columns)
        """(E, 3) vertex numbers."""
        corners = self.rest[self.triangles]
        edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)  # (E, 3, 2)
        lengths = np.linalg.qr(edges).R
        self._area = np.abs(np.linalg.det(lengths)) / 2
        # F = x^T G: gradients (E, 3, 2) of the three linear functions that are 1 at a corner and 0 at the others.
        inverse = np.linalg.inv(lengths)
        self._gradients = np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)
        share = np.repeat(self._area / 3, 3)
        self.area = np.bincount(self.triangles.ravel(), share, len(self.rest))
        """(V,) undeformed area of each vertex, mm^2."""

    def gradient(self, moved: NDArray) -> NDArray[np.float64]:
        """(E, 3, 2) deformation gradient of each triangle, from its plane to space, of displacements (V, 3)."""
        return np.swapaxes((self.rest + moved)[self.triangles], 1, 2) @ self._gradients

    def energy(self, moved: NDArray, stiffness: NDArray, target: NDArray) -> float:
        """Elastic energy of displacements (V, 3); springs of `stiffness` (V,) per area pull to `target` (V, 3)."""
        gradient = self.gradient(moved)
        square = np.swapaxes(gradient, 1, 2) @ gradient
        with np.errstate(divide="ignore"):
            density = np.trace(square, axis1=1, axis2=2) + 1 / np.linalg.det(square) - 3
        bent = (moved * (self._bending @ moved)).sum()
        sprung = (self.area * stiffness * ((moved - target) ** 2).sum(1)).sum()
        return float(self.thickness * (self._area * density).sum() + bent + sprung) / 2

    def forces(self, moved: NDArray, stiffness: NDArray, target: NDArray) -> NDArray[np.float64]:
        """(V, 3) force that holds each vertex there: the gradient of the energy."""
        stress = self._stress(self.gradient(moved))[0]
        on_corners = (self._area * self.thickness)[:, None, None] * self._gradients @ np.swapaxes(stress, 1, 2)
        found = np.stack(
            [np.bincount(self.triangles.ravel(), on_corners[..., k].ravel(), len(moved)) for k in range(3)], -1
        )
        sprung = (self.area * stiffness)[:, None] * (moved - target)
        return np.asarray(found + self._bending @ moved + sprung, np.float64)

    def equilibrium(
        self, start: NDArray, stiffness: NDArray, target: NDArray, fixed: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """(V, 3) displacements of least energy near `start`, by Newton's method.

        Args:
            start: (V, 3), which the `fixed` (V, 3) coordinates keep. stiffness, target: of the springs, as in `energy`.
        Raises:
            NoEquilibrium
        """
        moved, free = start.astype(np.float64).copy(), np.flatnonzero(~fixed)
        energy = self.energy(moved, stiffness, target)
        if not np.isfinite(energy):
            raise NoEquilibrium("a triangle has no area at the start")
        for _ in range(_MAX_STEPS):
            force = self.forces(moved, stiffness, target).ravel()[free]
            if np.abs(force).max(initial=0) < _TOLERANCE:
                return moved
            for convex in (False, True):  # far from equilibrium the true Hessian may lead uphill
                step = np.zeros(moved.size)
                hessian = self._hessian(moved, stiffness, convex)[free][:, free]
                step[free] = _solved(hessian, -force)
                found = self._descended(
                    moved, step.reshape(-1, 3), float(step[free] @ force), energy, stiffness, target
                )
                if found is not None:
                    moved, energy = found
                    break
            else:
                raise NoEquilibrium("no step lowers the energy")
        raise NoEquilibrium(f"not reached in {_MAX_STEPS} steps")

    def _descended(
        self, moved: NDArray, step: NDArray, slope: float, energy: float, stiffness: NDArray, target: NDArray
    ) -> tuple[NDArray[np.float64], float] | None:
        """Displacements and energy after the longest share of a step that lowers the energy enough; None without."""
        if slope >= 0:
            return None
        for halvings in range(_HALVINGS):
            share = 0.5**halvings
            there = moved + share * step
            # Near equilibrium the differences of energies are rounding.
            if (now := self.energy(there, stiffness, target)) <= energy + 1e-4 * share * slope + 1e-12 * abs(energy):
                return there, now
        return None

    def _stress(self, gradient: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """First Piola-Kirchhoff stress P = F - G / det C with G = F C^-1, then G, C^-1, 1 / det C."""
        square = np.swapaxes(gradient, 1, 2) @ gradient
        inverse, shrunk = np.linalg.inv(square), 1 / np.linalg.det(square)
        pulled = gradient @ inverse
        return gradient - shrunk[:, None, None] * pulled, pulled, inverse, shrunk

    def _hessian(self, moved: NDArray, stiffness: NDArray, convex: bool) -> sp.csc_matrix:
        """(3V, 3V) second derivative of the energy; `convex`: that of the triangles without negative eigenvalues."""
        gradient = self.gradient(moved)
        _, pulled, inverse, shrunk = self._stress(gradient)
        eye, plane = np.eye(3), np.eye(2)
        # dP_ik / dF_jl, by d(1/det C) = -2/det C (G : dF) and dG = (1 - G F^T) dF C^-1 - G dF^T G.
        normal = eye - pulled @ np.swapaxes(gradient, 1, 2)
        change = np.einsum("eij,ekl->eikjl", normal, inverse)
        change -= np.einsum("eil,ejk->eikjl", pulled, pulled) + 2 * np.einsum("eik,ejl->eikjl", pulled, pulled)
        tangent = np.einsum("ij,kl->ikjl", eye, plane)[None] - shrunk[:, None, None, None, None] * change
        if convex:
            values, vectors = np.linalg.eigh(tangent.reshape(-1, 6, 6))
            tangent = (vectors * np.maximum(values, 0)[:, None]) @ np.swapaxes(vectors, 1, 2)
            tangent = tangent.reshape(-1, 3, 2, 3, 2)
        tangent = tangent * (self._area * self.thickness)[:, None, None, None, None]
        blocks = np.einsum("eck,eikjl,edl->ecidj", self._gradients, tangent, self._gradients, optimize=True)
        pattern, places, constant = self._pattern
        data = constant + np.bincount(places, blocks.ravel(), len(constant))
        hessian = sp.csc_matrix((data, pattern.indices, pattern.indptr), shape=pattern.shape)
        return hessian + sp.diags(np.repeat(self.area * stiffness, 3), format="csc")

    @cached_property
    def _pattern(self) -> tuple[sp.csc_matrix, NDArray[np.intp], NDArray[np.float64]]:
        """Where the Hessian is not zero, where each entry of the triangles' blocks goes, and the part of bending."""
        unknown = (3 * self.triangles[..., None] + np.arange(3)).reshape(-1, 9)
        row, column = np.repeat(unknown, 9, 1).ravel(), np.tile(unknown, 9).ravel()
        bending = sp.kron(self._bending, sp.eye(3)).tocoo()
        size = 3 * len(self.rest)
        key = np.concatenate([column * size + row, bending.col.astype(np.int64) * size + bending.row])
        used, places = np.unique(key, return_inverse=True)
        ends = np.searchsorted(used // size, np.arange(size + 1))
        pattern = sp.csc_matrix((np.zeros(len(used)), used % size, ends), shape=(size, size))
        part = np.bincount(places[len(row) :], bending.data, len(used))
        return pattern, places[: len(row)], np.asarray(part, np.float64)

    @cached_property
    def _bending(self) -> sp.csr_matrix:
        """(V, V) Hessian of the bending energy in each coordinate."""
        (rows, columns), (down, across) = self._grid, self._spacing
        second_a = sp.kron(sp.eye(rows), _second(columns, across))
        second_b = sp.kron(_second(rows, down), sp.eye(columns))
        mixed = sp.kron(_first(rows, down), _first(columns, across))
        weights = sp.diags(np.kron(_lengths(rows, down), _lengths(columns, across)))
        mean = second_a + second_b
        cells = down * across * (mixed.T @ mixed)
        bent = (1 - POISSON) * (second_a.T @ weights @ second_a + second_b.T @ weights @ second_b + 2 * cells)
        return (self.thickness**3 / 3 * (bent + POISSON * (mean.T @ weights @ mean))).tocsr()


def offset(points: NDArray, distance: float) -> NDArray[np.float64]:
    """(GH, GW, 3) the face of a sheet at `distance` from its middle (GH, GW, 3), along columns x rows."""
    down, across = np.gradient(points, axis=(0, 1), edge_order=2)
    normal = np.cross(across, down)
    return points + distance * normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def tangents(points: NDArray) -> NDArray[np.float64]:
    """(GH, GW, 3, 2) tangents along the columns and the rows of a grid (GH, GW, 3), for one step of the grid."""
    across, down = np.gradient(points, axis=(1, 0), edge_order=2)
    return np.stack([across, down], -1)


def _triangles(rows: int, columns: int) -> NDArray[np.intp]:
    """(E, 3) two a cell; diagonals alternate, so that no direction is preferred."""
    first = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = first[:-1, :-1], first[:-1, 1:], first[1:, 1:], first[1:, :-1]
    other = ((np.indices(a.shape).sum(0) % 2) == 1)[..., None]
    one = np.where(other, np.stack([a, b, d], -1), np.stack([a, b, c], -1))
    two = np.where(other, np.stack([b, c, d], -1), np.stack([a, c, d], -1))
    return np.concatenate([one.reshape(-1, 3), two.reshape(-1, 3)])


def _second(count: int, step: float) -> sp.csr_matrix:
    """(count, count) second differences; none at the ends."""
    inner = np.diff(np.eye(count), 2, axis=0) / step**2
    return sp.csr_matrix(np.pad(inner, ((1, 1), (0, 0))))


def _first(count: int, step: float) -> sp.csr_matrix:
    """(count - 1, count) differences."""
    return sp.csr_matrix(np.diff(np.eye(count), axis=0) / step)


def _lengths(count: int, step: float) -> NDArray[np.float64]:
    """(count,) length of each vertex of a line."""
    lengths = np.full(count, float(step))
    lengths[[0, -1]] /= 2
    return lengths


def _solved(matrix: sp.csc_matrix, right: NDArray) -> NDArray[np.float64]:
    """Solution of a symmetric sparse system."""
    options = {"SymmetricMode": True}
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve(right)
