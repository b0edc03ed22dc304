"""A lift is a loss of contact; a gel that springs back under a tip that stays is none."""

import numpy as np
import pytest

from tiptrace.estimation.contact_watch import ContactWatch
from tiptrace.estimation.integrity_reference import IntegrityConfig, Reference
from tiptrace.estimation.slip_detector import SlipDetector, SlipLevels, SlipLimits
from tiptrace.types import FloatArray

DOWN = np.diag([1.0, -1.0, -1.0])  # the hand's z axis points to the surface
TIP_E = np.array([0.0, 0.0, 0.06])
REFERENCE = Reference(
    chi2=1.0,
    axis_E=np.array([0.0, 0.0, 1.0]),
    normal_E=np.array([1.0, 0.0, 0.0]),
    axial_m=(-1.0e-3, 0.0),
    start_E=np.zeros(3),
    twist_rad=0.0,
    twist_spread_rad=0.0,
    slip=SlipLevels(0.0, 0.0),
    rows=np.arange(4),
)
PRESSED, FREE = np.array([0.0, -2e-3, -5e-4]), np.array([0.0, 0.0, 7e-4])


def hand(k: int, height_m: float, slope: float = 0.0) -> FloatArray:
    """20 mm/s along y, 25 frames a second, at a height above where the tip touches."""
    T = np.eye(4)
    T[:3, :3] = DOWN
    y = 8e-4 * k
    T[:3, 3] = [0.0, y, TIP_E[2] + slope * y + height_m]
    return T


def watched(D: list[FloatArray], heights_m: list[float], slope: float = 0.0) -> list[bool]:
    watch = ContactWatch(IntegrityConfig())
    rows = enumerate(zip(D, heights_m, strict=True))
    return [watch.update(d, TIP_E, hand(k, h, slope), REFERENCE) for k, (d, h) in rows]


@pytest.mark.parametrize("slope", [0.0, 0.3, -0.3])
def test_a_lift_is_a_loss_whatever_the_slope(slope: float) -> None:
    touching = watched(
        [PRESSED] * 40 + [FREE] * 10 + [PRESSED] * 10, [0.0] * 40 + [4e-3] * 10 + [0.0] * 10, slope
    )
    assert all(touching[:40])
    assert not any(touching[44:50])
    assert all(touching[52:])


def test_a_gel_that_springs_back_under_a_resting_tip_is_no_loss() -> None:
    assert all(watched([PRESSED] * 40 + [FREE] * 20, [0.0] * 60))


@pytest.mark.parametrize("slope", [0.0, 0.3, -0.3])
def test_pushed_in_is_what_a_lift_is_not(slope: float) -> None:
    watch = ContactWatch(IntegrityConfig())
    for k in range(44):
        watch.update(PRESSED if k < 40 else FREE, TIP_E, hand(k, 0.0, slope), REFERENCE)
    assert watch.pushed_m == pytest.approx((FREE - PRESSED)[2], abs=7e-4)  # and the shear on a slope
    assert watch.pushed_m > 5e-4


def slip_told(held: list[bool], pushed_m: float) -> list[bool]:
    """A kick of 1 mm into a pattern 40 µm away at frame 20: weak signs, which need the third."""
    detector = SlipDetector(SlipLimits())
    told = []
    for k, h in enumerate(held):
        D = np.array([0.0, 1.0e-3 * (k >= 20), 0.0])
        residual = np.zeros((4, 3))
        residual[:, 1] = 4.4e-5 * (k >= 20)
        told.append(detector.update(D, residual, pushed_m, REFERENCE.normal_E, REFERENCE.slip, h))
    return told


def test_weak_signs_of_a_slip_need_a_third() -> None:
    assert not any(slip_told([True] * 40, 0.0))
    told = slip_told([True] * 40, 8e-4)
    assert sum(told) == 1
    assert 20 < told.index(True) <= 32


def test_a_kick_that_ends_in_the_air_is_no_slip() -> None:
    assert not any(slip_told([True] * 25 + [False] * 15, 8e-4))
