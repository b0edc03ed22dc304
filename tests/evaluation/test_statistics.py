"""Statistics against scipy and against cases that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tiptrace.evaluation.statistics import compare, spearman, summarise


@pytest.mark.parametrize("seed", range(4))
def test_spearman_equals_scipy_with_ties_and_gaps(seed: int):
    rng = np.random.default_rng(seed)
    x = rng.integers(0, 12, 51).astype(float)  # ties
    y = x + rng.normal(0, 4, 51)
    expected = stats.spearmanr(np.delete(x, [3, 7]), np.delete(y, [3, 7]))
    x[3], y[7] = np.nan, np.nan
    c = spearman(x, y)
    assert c.n == 49
    assert c.rho == pytest.approx(expected.statistic, abs=1e-12)
    assert c.p_value == pytest.approx(expected.pvalue, rel=1e-9)
    assert c.low < c.rho < c.high


def test_bootstrap_interval_covers_the_population_value():
    rng = np.random.default_rng(0)
    rho = 0.6
    population = 6 / np.pi * np.arcsin(rho / 2)  # Spearman of a bivariate normal
    inside = 0
    for _ in range(200):
        x = rng.standard_normal(60)
        y = rho * x + np.sqrt(1 - rho**2) * rng.standard_normal(60)
        c = spearman(x, y, samples=400)
        inside += c.low <= population <= c.high
    assert 0.88 <= inside / 200 <= 0.99


def test_spearman_without_enough_variation_is_unknown():
    assert np.isnan(spearman([1, 2, 3], [1, 2, 3]).rho)
    assert np.isnan(spearman([1, 1, 1, 1, 1], [1, 2, 3, 4, 5]).rho)
    assert spearman([], []).n == 0


def test_summary_leaves_out_what_is_unknown():
    s = summarise([1.0, 2.0, np.nan, 3.0, 10.0])
    assert (s.n, s.mean, s.median, s.min, s.max) == (4, 4.0, 2.5, 1.0, 10.0)
    assert s.std == pytest.approx(np.std([1, 2, 3, 10], ddof=1))
    assert summarise([]).n == 0
    assert np.isnan(summarise([5.0]).std)


def test_paired_comparison_counts_wins_and_tests_them():
    baseline = np.arange(20.0)
    method = baseline - 1.0
    method[0] += 3.0  # one loss
    method[1] += 1.0  # one tie
    c = compare(method, baseline)
    assert (c.n, c.wins, c.losses) == (20, 18, 1)
    assert c.median_difference == -1.0
    assert c.low == c.high == -1.0
    assert c.p_value == pytest.approx(stats.wilcoxon(method - baseline).pvalue)
    assert c.p_value < 0.01


def test_paired_comparison_of_equals_and_of_nothing():
    same = compare([1.0, 2.0], [1.0, 2.0])
    assert (same.wins, same.losses, same.p_value) == (0, 0, 1.0)
    assert compare([np.nan], [1.0]).n == 0
