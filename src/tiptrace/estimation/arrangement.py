"""Are the two images what the rig says: left left, right right, neither mirrored?

A swapped or mirrored image moves its markers the wrong way, but the two fingers can still agree with each other:
exchanging them turns the in-grasp motion by half a turn about the tool. Stage I tells: with the right
arrangement the tip rests, with a wrong one it appears to wander. So the fixed point is also fitted under every
wrong arrangement, and the trial is refused where one of them explains the motion clearly better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tiptrace.errors import GeometryError
from tiptrace.geometry.fixed_point import FixedPointAccumulator
from tiptrace.geometry.kabsch import kabsch
from tiptrace.geometry.transforms import apply
from tiptrace.types import SIDES, FloatArray, IntArray, SensedPair, Side

_BETTER = (
    1.5  # residual as it is over the alternative's; right data gave at most 1.1 where Stage I moves enough
)
_AT_LEAST_M = 1.0e-3  # smaller residuals are noise under any arrangement
_RESTS_M = 4.0e-3  # a tool that slips rests under no arrangement, and nobody is to blame for that
_AS_IS = (1.0, 1.0, 1.0)
_ALONG_X, _ALONG_Y, _TURNED = (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, -1.0, 1.0)


@dataclass(frozen=True, slots=True)
class _Arrangement:
    """A hypothesis: signs applied to each finger's (x, y, z), and whether the fingers are exchanged."""

    sentence: str
    left: tuple[float, float, float] = _AS_IS
    right: tuple[float, float, float] = _AS_IS
    exchanged: bool = False


_RIGHT_ONE = _Arrangement("")
_WRONG_ONES = (
    _Arrangement("left and right image were exchanged", exchanged=True),
    _Arrangement("the left image were mirrored left to right", left=_ALONG_X),
    _Arrangement("the left image were mirrored top to bottom", left=_ALONG_Y),
    _Arrangement("the right image were mirrored left to right", right=_ALONG_X),
    _Arrangement("the right image were mirrored top to bottom", right=_ALONG_Y),
    _Arrangement("both images were mirrored left to right", left=_ALONG_X, right=_ALONG_X),
    _Arrangement("both images were mirrored top to bottom", left=_ALONG_Y, right=_ALONG_Y),
    _Arrangement(
        "both sensors were turned by half (T_E_S quaternions are x, y, z, w)", left=_TURNED, right=_TURNED
    ),
)


class ArrangementCheck:
    """Fits Stage I under every arrangement at once; constant memory, under a millisecond per frame."""

    def __init__(self) -> None:
        self._arrangements = (_RIGHT_ONE, *_WRONG_ONES)
        self._fits = [FixedPointAccumulator() for _ in self._arrangements]
        self._X_0: list[FloatArray] = []

    def add(self, x_S: dict[Side, FloatArray], T_B_S: dict[Side, FloatArray]) -> None:
        """Take an anchoring frame: chosen markers of both fingers (K, 3) m, and their sensors' poses (4, 4)."""
        X_t = [_arranged(arrangement, x_S, T_B_S) for arrangement in self._arrangements]
        if not self._X_0:
            self._X_0 = X_t
        for fit, before, now in zip(self._fits, self._X_0, X_t, strict=True):
            seen = np.isfinite(before + now).all(axis=1)
            try:
                motion = kabsch(before[seen], now[seen])
            except GeometryError:
                continue
            fit.add(motion.R, motion.d)

    def verify(self) -> None:
        """Judge Stage I once it is over.

        Raises:
            GeometryError: another arrangement explains the resting tip clearly better.
        """
        residuals = [_residual_m(fit) for fit in self._fits]
        best = int(np.argmin(residuals[1:])) + 1
        told = _AT_LEAST_M < residuals[0] < np.inf and residuals[best] < _RESTS_M
        if told and residuals[0] > _BETTER * residuals[best]:
            raise GeometryError(
                f"during anchoring the markers move as if {self._arrangements[best].sentence}: the tip would then "
                f"rest within {residuals[best] * 1e3:.1f} mm, as recorded only within {residuals[0] * 1e3:.1f} mm; "
                "check which camera is which, its flip setting, and T_E_S"
            )


def _arranged(
    arrangement: _Arrangement, x_S: dict[Side, FloatArray], T_B_S: dict[Side, FloatArray]
) -> FloatArray:
    """Markers in the base frame, (2 K, 3), as an arrangement reads them."""
    signs: dict[Side, tuple[float, float, float]] = {"left": arrangement.left, "right": arrangement.right}
    sources = tuple(reversed(SIDES)) if arrangement.exchanged else SIDES
    points = [
        apply(T_B_S[side], x_S[source] * np.asarray(signs[side]))
        for side, source in zip(SIDES, sources, strict=True)
    ]
    return np.concatenate(points)


def _residual_m(fit: FixedPointAccumulator) -> float:
    solution = fit.solve()
    return np.inf if solution is None else solution.residual_m


class ArrangementWatch:
    """The same for the full estimator: every sixth frame, all markers that it trusts at the first of them."""

    def __init__(self, every: int = 6) -> None:
        """Look at one frame in ``every``."""
        self._check, self._every, self._frames = ArrangementCheck(), every, 0
        self._rows: dict[Side, IntArray] = {}

    def add(self, pair: SensedPair, trust: Callable[[], FloatArray]) -> None:
        """Take an anchoring frame; ``trust()`` gives the weight of every marker (N,), left finger first."""
        self._frames += 1
        if self._frames % self._every != 1:
            return
        if not self._rows:
            left, right = np.split(trust(), [len(pair.left.markers.x_S)])
            self._rows = {"left": np.flatnonzero(left > 0), "right": np.flatnonzero(right > 0)}
        x_S: dict[Side, FloatArray] = {}
        T_B_S: dict[Side, FloatArray] = {}
        for side in SIDES:
            finger = pair.finger(side)
            seen = finger.markers.tracked[:, None]
            x_S[side] = np.where(seen, finger.markers.x_S, np.nan)[self._rows[side]]
            T_B_S[side] = finger.T_B_E @ finger.T_E_S
        self._check.add(x_S, T_B_S)

    def complaint(self) -> str | None:
        """The sentence that names a wrong arrangement once Stage I is over; None where all is right."""
        try:
            self._check.verify()
        except GeometryError as error:
            return str(error)
        return None
