"""Statistics over trials. Trials are the unit: frames of one trial are not independent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.types import FloatArray

NAN = float("nan")
BOOTSTRAP_SAMPLES = 2000
_SEED = 20261122  # intervals must not change from run to run


@dataclass(frozen=True, slots=True)
class Summary:
    """Distribution of one number over trials; NaN values are left out and not counted.

    Attributes:
        n: Trials that have the number.
        mean: Mean.
        std: Sample standard deviation (n − 1).
        median: Median.
        p95: 95th percentile.
        min: Smallest.
        max: Largest.
    """

    n: int
    mean: float = NAN
    std: float = NAN
    median: float = NAN
    p95: float = NAN
    min: float = NAN
    max: float = NAN


@dataclass(frozen=True, slots=True)
class RankCorrelation:
    """Spearman's ρ with its p value and a 95 % bootstrap interval over trials."""

    n: int
    rho: float = NAN
    p_value: float = NAN
    low: float = NAN
    high: float = NAN


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """A method against a baseline on the same trials, smaller is better.

    Attributes:
        n: Trials that both have.
        wins: Trials in which the method is better.
        losses: Trials in which it is worse.
        median_difference: Median of method − baseline.
        low: Its 95 % bootstrap interval, lower end.
        high: Upper end.
        p_value: Wilcoxon signed-rank test, two-sided; 1 where nothing differs, NaN without trials.
    """

    n: int
    wins: int = 0
    losses: int = 0
    median_difference: float = NAN
    low: float = NAN
    high: float = NAN
    p_value: float = NAN


def summarise(values: ArrayLike) -> Summary:
    """Summary of one number over trials."""
    x = np.asarray(values, dtype=np.float64).ravel()
    x = x[np.isfinite(x)]
    if len(x) == 0:
        return Summary(0)
    return Summary(
        n=len(x),
        mean=float(x.mean()),
        std=float(x.std(ddof=1)) if len(x) > 1 else NAN,
        median=float(np.median(x)),
        p95=float(np.percentile(x, 95)),
        min=float(x.min()),
        max=float(x.max()),
    )


def spearman(x: ArrayLike, y: ArrayLike, samples: int = BOOTSTRAP_SAMPLES) -> RankCorrelation:
    """Spearman's ρ of two numbers over trials; trials that lack one of them are left out.

    NaN with fewer than four trials or where one of the numbers does not vary.
    """
    from scipy.stats import spearmanr

    x, y = np.asarray(x, dtype=np.float64).ravel(), np.asarray(y, dtype=np.float64).ravel()
    both = np.isfinite(x) & np.isfinite(y)
    x, y = x[both], y[both]
    if len(x) < 4 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return RankCorrelation(len(x))
    result = spearmanr(x, y)
    low, high = bootstrap_interval(lambda k: _row_spearman(x[k], y[k]), len(x), samples)
    return RankCorrelation(len(x), float(result.statistic), float(result.pvalue), low, high)


def compare(method: ArrayLike, baseline: ArrayLike, samples: int = BOOTSTRAP_SAMPLES) -> PairedComparison:
    """Compare errors trial by trial; both arrays are in the same order of trials."""
    from scipy.stats import wilcoxon

    d = np.asarray(method, dtype=np.float64).ravel() - np.asarray(baseline, dtype=np.float64).ravel()
    d = d[np.isfinite(d)]
    if len(d) == 0:
        return PairedComparison(0)
    low, high = bootstrap_interval(lambda k: np.median(d[k], axis=1), len(d), samples)
    return PairedComparison(
        n=len(d),
        wins=int(np.sum(d < 0)),
        losses=int(np.sum(d > 0)),
        median_difference=float(np.median(d)),
        low=low,
        high=high,
        p_value=float(wilcoxon(d).pvalue) if np.any(d != 0) else 1.0,
    )


def bootstrap_interval(
    statistic: Callable[[np.ndarray[tuple[int, ...], np.dtype[np.int64]]], ArrayLike], n: int, samples: int
) -> tuple[float, float]:
    """95 % percentile interval; ``statistic`` maps resampled indices (samples, n) to values (samples,)."""
    indices = np.random.default_rng(_SEED).integers(0, n, size=(samples, n))
    values = np.asarray(statistic(indices), dtype=np.float64)
    values = values[np.isfinite(values)]  # a resample without variation has no ρ
    if len(values) == 0:
        return NAN, NAN
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def _row_spearman(x: FloatArray, y: FloatArray) -> FloatArray:
    """ρ of each row: (b, n), (b, n) → (b,)."""
    from scipy.stats import rankdata

    rx, ry = rankdata(x, axis=1), rankdata(y, axis=1)
    rx, ry = rx - rx.mean(axis=1, keepdims=True), ry - ry.mean(axis=1, keepdims=True)
    norm = np.sqrt(np.sum(rx**2, axis=1) * np.sum(ry**2, axis=1))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sum(rx * ry, axis=1) / np.where(norm == 0, np.nan, norm))
