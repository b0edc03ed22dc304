"""Period and amplitude of a trace that waves, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tiptrace.evaluation.serial_noise import lag_one, sandwich
from tiptrace.types import FloatArray

_LEAST_PERIODS = 1.5  # fewer do not show that anything repeats
_LEAST_SIGNIFICANCE = 5.0  # amplitude over its standard deviation
_LEAST_R2 = 0.7


@dataclass(frozen=True, slots=True)
class PeriodicFit:
    """A sinusoid across the travel, common to all traces; each has its own phase, offset and slope.

    Attributes:
        period_m: Period along the travel.
        period_std_m: Its standard deviation.
        amplitude_m: Peak deviation.
        amplitude_std_m: Its standard deviation.
        r2: Part of the lateral variance that the sinusoid explains.
        noise_m: Scatter about it.
        memory_m: Way along the travel over which the scatter is forgotten (to 1/e); 0 where it has no memory.
    """

    period_m: float
    period_std_m: float
    amplitude_m: float
    amplitude_std_m: float
    r2: float
    noise_m: float = 0.0
    memory_m: float = 0.0


def fit_periodic(traces: Sequence[FloatArray]) -> PeriodicFit | None:
    """Sinusoid through traces in plane coordinates (u along, v across), (n_k, 2) m each; None where none fits.

    Period and amplitude are shared; the linear parts (cosine, sine, offset, slope) are solved for each trace, so
    that errors of their anchors do not matter.
    """
    from scipy.optimize import minimize_scalar

    traces = [t for t in traces if len(t) >= 8]
    if not traces:
        return None
    span = max(float(np.ptp(t[:, 0])) for t in traces)
    step = max(float(np.median(np.abs(np.diff(t[:, 0])))) for t in traces)
    low, high = _LEAST_PERIODS / span, 1.0 / max(4 * step, span / 200)
    if not high > low:
        return None
    grid = np.arange(low, high, 0.2 / span)
    cost = np.array([_linear(traces, f)[0] for f in grid])
    best = float(grid[np.argmin(cost)])
    width = 0.2 / span
    result = minimize_scalar(
        lambda f: _linear(traces, f)[0], bounds=(max(low, best - width), best + width), method="bounded",
        options={"xatol": 1e-6 * best},
    )  # fmt: skip
    fit = _describe(traces, float(result.x))
    clear = fit.r2 >= _LEAST_R2 and fit.amplitude_m >= _LEAST_SIGNIFICANCE * fit.amplitude_std_m
    return fit if clear else None


def _design(u: FloatArray, frequency: float) -> FloatArray:
    w = 2 * np.pi * frequency * u
    return np.column_stack([np.cos(w), np.sin(w), np.ones_like(u), u - u.mean()])


def _linear(
    traces: Sequence[FloatArray], frequency: float
) -> tuple[float, list[FloatArray], list[FloatArray]]:
    """Sum of squares at a frequency, with coefficients (4,) and residuals of each trace."""
    coefficients, residuals = [], []
    for t in traces:
        X = _design(t[:, 0], frequency)
        c, *_ = np.linalg.lstsq(X, t[:, 1], rcond=None)
        coefficients.append(np.asarray(c, dtype=np.float64))
        residuals.append(t[:, 1] - X @ c)
    return float(sum(r @ r for r in residuals)), coefficients, residuals


def _describe(traces: Sequence[FloatArray], frequency: float) -> PeriodicFit:
    """Common amplitude and period, and their uncertainty from the full Jacobian."""
    total, coefficients, residuals = _linear(traces, frequency)
    n = sum(len(t) for t in traces)
    q = 1 + 4 * len(traces)
    sigma = float(np.sqrt(total / max(1, n - q)))
    jacobians = []
    for k, (t, c) in enumerate(zip(traces, coefficients, strict=True)):
        u = t[:, 0]
        w = 2 * np.pi * frequency * u
        J = np.zeros((len(t), q))
        J[:, 0] = 2 * np.pi * u * (-c[0] * np.sin(w) + c[1] * np.cos(w))  # ∂v/∂f
        J[:, 1 + 4 * k : 5 + 4 * k] = _design(u, frequency)
        jacobians.append(J)
    phi = lag_one(residuals)
    covariance = sandwich(jacobians, sigma, phi)
    step = float(np.median(np.concatenate([np.abs(np.diff(t[:, 0])) for t in traces])))
    amplitudes = np.array([np.hypot(c[0], c[1]) for c in coefficients])
    gradient = np.zeros(q)  # of the mean amplitude
    for k, (c, a) in enumerate(zip(coefficients, amplitudes, strict=True)):
        gradient[1 + 4 * k : 3 + 4 * k] = c[:2] / max(a, 1e-12) / len(traces)
    variance = sum(float(np.sum((t[:, 1] - t[:, 1].mean()) ** 2)) for t in traces)
    return PeriodicFit(
        period_m=1.0 / frequency,
        period_std_m=float(np.sqrt(covariance[0, 0])) / frequency**2,
        amplitude_m=float(amplitudes.mean()),
        amplitude_std_m=float(np.sqrt(gradient @ covariance @ gradient)),
        r2=1.0 - total / variance if variance > 0 else 0.0,
        noise_m=sigma,
        memory_m=-step / float(np.log(phi)) if phi > 0 else 0.0,
    )
