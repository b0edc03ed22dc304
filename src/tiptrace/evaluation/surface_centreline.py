"""Smoothed centreline of a groove from one or several traces, with a confidence band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tiptrace.evaluation.serial_noise import ar1_covariance, lag_one
from tiptrace.evaluation.smoothing_spline import SmoothingSpline
from tiptrace.evaluation.surface_periodic import PeriodicFit
from tiptrace.types import FloatArray

_LEAST_POINTS = 12
_GRID = 201
_CELL_M = 1e-3  # traces are averaged over this length before they are smoothed
_ALIGN_ROUNDS = 4
_ALIGN_LAMBDA_M3 = 1e-9  # light smoothing while traces are being aligned
_ALONG_PRIOR_M = 3e-3  # anchors are hardly farther off than this
_MOST_CELLS = 400
_MOST_FOLDS = 10
_BLOCK_CELLS = 5
_LAMBDAS_M3 = np.geomspace(1e-12, 1e-3, 28)  # scipy's λ, for metres

Merged = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class CentrelineFit:
    """Deviation across the travel as a function of the way along it, in plane coordinates.

    Attributes:
        along_m: (g,) way along the travel.
        across_m: (g,) smoothed deviation.
        std_m: (g,) standard deviation of its shape: noise of the traces, their common offset left out.
        offset_std_m: Standard deviation of the common offset across the travel, from the spread between traces or
            the anchors' covariance; NaN where neither tells.
        noise_m: Scatter of single positions about the curve.
        serial: Correlation of the noise from one cell to the next.
        smoothing: λ of the spline, m³.
    """

    along_m: FloatArray
    across_m: FloatArray
    std_m: FloatArray
    offset_std_m: float
    noise_m: float
    serial: float
    smoothing: float

    def band(self, factor: float = 1.96) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end of the confidence band of the shape, (g,) m each."""
        return self.across_m - factor * self.std_m, self.across_m + factor * self.std_m


def fit_centreline(
    traces: Sequence[FloatArray], offset_std_m: float = float("nan"), periodic: PeriodicFit | None = None
) -> CentrelineFit | None:
    """Smoothing spline v(u) through traces (n_k, 2) m in plane coordinates; None where they are too short.

    Traces of one groove differ mostly by the error of their anchors. Each is moved as a whole onto their mean
    before smoothing. λ minimises the error on the traces left out, or, with a single one, on blocks left
    out that are longer than the noise remembers.

    Args:
        traces: Positions along and across the travel.
        offset_std_m: Standard deviation across of a single trace's anchor, where known.
        periodic: What was found to repeat. A single trace cannot tell its noise from the groove, and the spline
            follows both; the sinusoid's scatter then stands in for the noise of the band.
    """
    span = max((float(np.ptp(t[:, 0])) for t in traces if len(t)), default=0.0)
    cell = max(_CELL_M, span / _MOST_CELLS)
    cells = [c for c in (_cells(t, cell) for t in traces if len(t)) if len(c) >= _LEAST_POINTS]
    if not cells:
        return None
    cells, shifts = _align(cells, cell)
    u, v, traces_there = merged = _merge(cells, cell)
    smoothing = _best_smoothing(_folds(cells), cell)
    spline = SmoothingSpline(u, traces_there)
    g = spline.fit(v, smoothing)
    residuals = [c[:, 1] - spline.at(g, c[:, 0]) for c in cells]
    grid = np.linspace(u[0], u[-1], _GRID)
    noise, serial = _noise(SmoothingSpline(u, traces_there), smoothing, residuals)
    if len(cells) == 1 and periodic is not None and periodic.noise_m > noise:
        noise = periodic.noise_m
        serial = float(np.exp(-cell / periodic.memory_m)) if periodic.memory_m > 0 else 0.0
    std = _std(grid, merged, smoothing, noise, serial)
    spread = float(np.std(shifts, ddof=1)) if len(shifts) > 1 else offset_std_m
    return CentrelineFit(
        along_m=grid,
        across_m=spline.at(g, grid),
        std_m=std,
        offset_std_m=spread / float(np.sqrt(len(shifts))),
        noise_m=noise,
        serial=serial,
        smoothing=smoothing,
    )


def _cells(trace: FloatArray, cell: float) -> FloatArray:
    """Means over cells of the way, (m, 2): along and across."""
    index = np.round(trace[:, 0] / cell).astype(np.int64)
    _, inverse, count = np.unique(index, return_inverse=True, return_counts=True)
    u = np.bincount(inverse, trace[:, 0]) / count
    v = np.bincount(inverse, trace[:, 1]) / count
    return np.column_stack([u, v])


def _align(cells: list[FloatArray], cell: float) -> tuple[list[FloatArray], FloatArray]:
    """Move traces onto their common mean, across and along; returns how far each was moved across, (k,) m.

    A shift along the travel shows only where the curve has a slope: it is held back by a prior.
    """
    across = np.zeros(len(cells))
    if len(cells) == 1:
        return cells, across
    for _ in range(_ALIGN_ROUNDS):
        u, v, traces = _merge(cells, cell)
        spline = SmoothingSpline(u, traces)
        g = spline.fit(v, _ALIGN_LAMBDA_M3)
        steps = np.array(
            [_shift(c, spline.at(g, c[:, 0]), spline.at(g, c[:, 0], 1)) for c in cells]
        )  # (k, 2)
        steps -= steps.mean(axis=0)
        cells = [c - step for c, step in zip(cells, steps, strict=True)]
        across = across + steps[:, 1]
    return cells, across


def _shift(cells: FloatArray, curve: FloatArray, slope: FloatArray) -> FloatArray:
    """(2,) shift along and across of a trace against a curve: v − f(u) ≈ δv − f'(u) δu."""
    X = np.column_stack([-slope, np.ones_like(slope)])
    r = cells[:, 1] - curve
    variance = max(float(np.var(r)), 1e-16)
    prior = np.diag([variance / _ALONG_PRIOR_M**2, 0.0])
    return np.asarray(np.linalg.solve(X.T @ X + prior, X.T @ r))


def _merge(cells: Sequence[FloatArray], cell: float) -> Merged:
    """All traces on one axis: along (strictly increasing), across, number of traces; (m,) each."""
    merged = np.concatenate(cells)
    index = np.round(merged[:, 0] / cell).astype(np.int64)
    _, inverse, count = np.unique(index, return_inverse=True, return_counts=True)
    u = np.bincount(inverse, merged[:, 0]) / count
    v = np.bincount(inverse, merged[:, 1]) / count
    return u, v, count.astype(np.float64)


def _folds(cells: Sequence[FloatArray]) -> list[FloatArray]:
    """What is left out in turn: traces, or blocks of a single trace, so that neighbours do not tell."""
    if len(cells) > 1:
        return [np.concatenate(cells[k::_MOST_FOLDS]) for k in range(min(_MOST_FOLDS, len(cells)))]
    block = np.arange(len(cells[0])) // _BLOCK_CELLS
    return [cells[0][block % 4 == k] for k in range(4)]


def _best_smoothing(folds: Sequence[FloatArray], cell: float) -> float:
    """λ with the least error on what is left out."""
    errors = np.zeros(len(_LAMBDAS_M3))
    for k, fold in enumerate(folds):
        u, v, traces = _merge([f for j, f in enumerate(folds) if j != k], cell)
        inside = fold[(fold[:, 0] >= u[0]) & (fold[:, 0] <= u[-1])]
        spline = SmoothingSpline(u, traces)
        fitted = np.column_stack([spline.fit(v, lam) for lam in _LAMBDAS_M3])  # (m, λ)
        errors += np.sum((inside[:, 1:] - spline.at(fitted, inside[:, 0])) ** 2, axis=0)
    return float(_LAMBDAS_M3[np.argmin(errors)])


def _noise(spline: SmoothingSpline, smoothing: float, residuals: Sequence[FloatArray]) -> tuple[float, float]:
    """Noise of one trace's cell, m, and its serial correlation; what the curve takes of it is added back."""
    freedom = float(np.trace(spline.matrix(smoothing)))
    rows, total = sum(len(r) for r in residuals), sum(float(r @ r) for r in residuals)
    return float(np.sqrt(total / max(1.0, rows - freedom))), lag_one(residuals)


def _std(grid: FloatArray, merged: Merged, smoothing: float, noise: float, serial: float) -> FloatArray:
    """Standard deviation of the spline on the grid, (g,): it is linear in the data."""
    u, _, traces = merged
    spline = SmoothingSpline(u, traces)
    response = spline.at(spline.matrix(smoothing), grid)  # (g, m)
    covariance = ar1_covariance(len(u), noise, serial) / np.sqrt(np.outer(traces, traces))
    variance = np.einsum("gi,ij,gj->g", response, covariance, response, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
