"""The hand between samples: exact on smooth motion, better than interpolation on noise."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.errors import GeometryError
from tiptrace.estimation.pose_track import PoseTrack
from tiptrace.geometry.transforms import interpolate, rotation_exp, rotation_log, transform
from tiptrace.types import FloatArray, PoseSample


def hand(s: float) -> FloatArray:
    return transform(rotation_exp([0.2 * s, 0.1 * np.sin(2 * s), 0.0]), [0.1 * s * s, 0.02 * s, 0.3])


def track(hz: float, noise_m: float = 0.0, seconds: float = 0.9) -> PoseTrack:
    rng = np.random.default_rng(0)
    samples = []
    for k in range(int(seconds * hz)):
        T = hand(k / hz)
        T[:3, 3] += noise_m * rng.standard_normal(3)
        samples.append(PoseSample(round(k / hz * 1e9), T))
    out = PoseTrack()
    out.extend(samples)
    return out


@pytest.mark.parametrize("hz", [25.0, 125.0, 500.0])
def test_smooth_motion_and_its_velocity_are_recovered(hz: float) -> None:
    state = track(hz).at([0.513e9])
    T = hand(0.513)
    assert state.T_B_E[0, :3, 3] == pytest.approx(T[:3, 3], abs=1e-6)
    assert np.linalg.norm(rotation_log(T[:3, :3].T @ state.T_B_E[0, :3, :3])) < 2e-5
    assert state.velocity_B[0] == pytest.approx([0.2 * 0.513, 0.02, 0.0], abs=1e-4)
    ahead, behind = hand(0.514), hand(0.512)
    rate = rotation_log(behind[:3, :3].T @ ahead[:3, :3]) / 0.002
    assert state.rate_E[0] == pytest.approx(rate, abs=2e-3)


def test_smoothing_beats_linear_interpolation() -> None:
    noisy = track(125.0, noise_m=5e-5)
    at = np.linspace(0.2, 0.8, 200)
    smooth = noisy.at(at * 1e9).T_B_E[:, :3, 3] - np.stack([hand(s)[:3, 3] for s in at])
    size = len(noisy)
    linear = []
    for s in at:
        k = int(s * 125)
        assert k + 1 < size
        T = interpolate(noisy._T[k], noisy._T[k + 1], s * 125 - k)
        linear.append(T[:3, 3] - hand(s)[:3, 3])
    assert np.std(smooth) < 0.6 * np.std(linear)


def test_memory_is_bounded_and_time_does_not_run_back() -> None:
    out = PoseTrack(memory_s=0.5)
    out.extend(PoseSample(k * 8_000_000, hand(0.0)) for k in range(1000))
    assert len(out._stamps) <= 256
    newest = out.newest_ns
    out.extend([PoseSample(0, hand(1.0))])
    assert out.newest_ns == newest
    assert out.covers(newest)
    assert not out.covers(0)


def test_too_few_samples_raise() -> None:
    with pytest.raises(GeometryError, match="at least 4"):
        PoseTrack().at([0])
