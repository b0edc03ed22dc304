"""Plane, centreline and period from traces with serial noise and anchors that are off."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from tiptrace.evaluation.serial_noise import ar1_covariance, lag_one, sandwich
from tiptrace.evaluation.smoothing_spline import SmoothingSpline
from tiptrace.evaluation.surface_centreline import fit_centreline
from tiptrace.evaluation.surface_periodic import fit_periodic
from tiptrace.evaluation.surface_plane import fit_plane
from tiptrace.geometry.transforms import rotation_exp
from tiptrace.types import FloatArray


def serial_noise(rng: np.random.Generator, n: int, sigma: float, phi: float) -> FloatArray:
    e = rng.standard_normal(n) * sigma * np.sqrt(1 - phi**2)
    out = np.empty(n)
    out[0] = rng.standard_normal() * sigma
    for k in range(1, n):
        out[k] = phi * out[k - 1] + e[k]
    return out


def groove(
    rng: np.random.Generator,
    period: float = 0.05,
    amplitude: float = 4e-3,
    sigma: float = 2e-4,
    phi: float = 0.0,
) -> FloatArray:
    """(250, 3) trace in plane coordinates with an anchor that is off by millimetres."""
    u = np.linspace(0, 0.2, 250)
    v = amplitude * np.sin(2 * np.pi * u / period)
    noise = np.stack([serial_noise(rng, 250, sigma, phi) for _ in range(3)], axis=1)
    return np.stack([u, v, np.zeros(250)], axis=1) + noise + rng.normal(0, 1.5e-3, 3)


def test_serial_correlation_is_found_and_inflates_the_mean_as_theory_says():
    rng = np.random.default_rng(0)
    phi = lag_one([serial_noise(rng, 20000, 1.0, 0.8)])
    assert phi == pytest.approx(0.8, abs=0.02)
    n = 400
    variance = sandwich([np.ones((n, 1))], 1.0, 0.8)[0, 0]
    assert variance == pytest.approx(np.sum(ar1_covariance(n, 1.0, 0.8)) / n**2)
    assert variance == pytest.approx((1 + 0.8) / (1 - 0.8) / n, rel=0.05)
    assert lag_one([np.zeros(5)]) == 0.0


def test_plane_of_an_exact_tilted_trace():
    rng = np.random.default_rng(0)
    R = rotation_exp([0.05, -0.03, 0.4])
    p = groove(rng, sigma=0.0) @ R.T + [0.4, 0.1, 0.02]
    fit = fit_plane([p])
    assert np.abs(fit.normal_B @ R[:, 2]) == pytest.approx(1.0, abs=1e-12)
    assert fit.normal_B[2] > 0
    assert fit.rms_m < 1e-12
    assert np.allclose(fit.to_base(fit.to_plane(p)), p)


def test_plane_ignores_single_outliers():
    rng = np.random.default_rng(1)
    p = groove(rng, sigma=1e-4)
    clean = fit_plane([p])
    p[[50, 120]] += [0, 0, 0.03]
    fit = fit_plane([p])
    assert not fit.inliers[[50, 120]].any()
    assert np.degrees(np.arccos(min(1.0, fit.normal_B @ clean.normal_B))) < 0.1


def test_a_straight_trace_does_not_pretend_to_know_the_tilt_across():
    rng = np.random.default_rng(2)
    fit = fit_plane([groove(rng, amplitude=0.0, sigma=2e-4)])
    assert not fit.across_determined
    assert np.isnan(fit.tilt_across_std_rad)
    assert fit.axes_B[1][2] == pytest.approx(0.0, abs=1e-12)  # level across


def test_uncertainty_of_the_plane_matches_its_spread():
    errors, stds = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        fit = fit_plane([groove(rng, sigma=2e-4, phi=0.9)])
        errors.append([fit.axes_B[0][2], fit.axes_B[1][2]])
        stds.append([fit.tilt_along_std_rad, fit.tilt_across_std_rad])
    ratio = np.std(errors, axis=0) / np.median(stds, axis=0)
    assert np.all(ratio > 0.6)
    assert np.all(ratio < 1.7)


@pytest.mark.parametrize(("period", "amplitude"), [(0.05, 4e-3), (0.02, 2e-3), (0.1, 8e-3)])
@pytest.mark.parametrize("traces", [1, 4])
def test_period_and_amplitude_lie_within_their_uncertainty(period: float, amplitude: float, traces: int):
    z = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        fit = fit_periodic([groove(rng, period, amplitude, 2e-4, 0.9)[:, :2] for _ in range(traces)])
        assert fit is not None
        assert fit.period_m == pytest.approx(period, rel=0.01)
        assert fit.amplitude_m == pytest.approx(amplitude, rel=0.1)
        z.append(
            [(fit.period_m - period) / fit.period_std_m, (fit.amplitude_m - amplitude) / fit.amplitude_std_m]
        )
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all(rms > 0.4)
    assert np.all(rms < 2.0)


def test_smoothing_spline_is_scipys():
    rng = np.random.default_rng(0)
    u = np.sort(rng.random(60)) * 0.2
    v, w = np.sin(40 * u) + rng.normal(0, 0.1, 60), rng.uniform(0.5, 3, 60)
    ours = SmoothingSpline(u, w)
    x = np.linspace(u[0], u[-1], 300)
    for smoothing in (1e-9, 1e-6, 1e-3):
        theirs = make_smoothing_spline(u, v, w=w, lam=smoothing)
        np.testing.assert_allclose(ours.at(ours.fit(v, smoothing), x), theirs(x), atol=1e-6)
        np.testing.assert_allclose(ours.matrix(smoothing) @ v, ours.fit(v, smoothing), atol=1e-10)


def test_what_does_not_repeat_has_no_period():
    rng = np.random.default_rng(0)
    straight = groove(rng, amplitude=0.0, phi=0.9)[:, :2]
    assert fit_periodic([straight]) is None
    arc = groove(rng, amplitude=0.0)[:, :2]
    arc[:, 1] += 8e-3 * (1 - ((np.linspace(0, 0.2, 250) - 0.1) / 0.1) ** 2)
    assert fit_periodic([arc]) is None
    assert fit_periodic([straight[:5]]) is None
    assert fit_periodic([]) is None


@pytest.mark.parametrize(("traces", "phi"), [(1, 0.0), (5, 0.0), (5, 0.8)])
def test_band_of_the_centreline_holds_the_true_shape(traces: int, phi: float):
    held = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        fit = fit_centreline([groove(rng, sigma=3e-4, phi=phi)[:, :2] for _ in range(traces)])
        assert fit is not None
        # The anchors' offsets move the curve as a whole, along and across: judge the shape alone.
        shifts = np.linspace(-5e-3, 5e-3, 201)
        curves = [4e-3 * np.sin(2 * np.pi * (fit.along_m - s) / 0.05) for s in shifts]
        offsets = [fit.across_m - c - np.mean(fit.across_m - c) for c in curves]
        best = min(offsets, key=lambda o: float(np.sum(o**2)))
        held.append(np.mean(np.abs(best) <= 1.96 * fit.std_m))
    assert 0.75 < np.mean(held) <= 1.0


def test_offsets_between_traces_do_not_roughen_the_curve():
    rng = np.random.default_rng(3)
    u = np.linspace(0, 0.2, 250)
    traces = [
        np.column_stack([u, 4e-3 * np.sin(2 * np.pi * u / 0.05) + shift]) for shift in rng.normal(0, 2e-3, 6)
    ]
    fit = fit_centreline(traces)
    assert fit is not None
    assert fit.noise_m < 1e-4
    assert fit.offset_std_m == pytest.approx(2e-3 / np.sqrt(6), rel=0.5)


def test_a_trace_that_is_too_short_has_no_centreline():
    assert fit_centreline([np.zeros((5, 2))]) is None
    assert fit_centreline([]) is None
