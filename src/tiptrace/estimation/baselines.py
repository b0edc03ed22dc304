"""Baselines that the paper left out: what costs no tactile sensing, and what the literature did before.

``ee-only`` is in :mod:`tiptrace.estimation.ee_only`; it takes any estimator's anchor.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from tiptrace.config import Tool
from tiptrace.errors import GeometryError
from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.patch import PatchConfig, in_contact
from tiptrace.estimation.priors import require_tip
from tiptrace.geometry.kabsch import kabsch
from tiptrace.geometry.transforms import apply, invert
from tiptrace.types import Anchor, Event, FloatArray, Phase, SensedPair, Status, TipEstimate


class NominalTipEstimator:
    """``nominal-tip``: the tip of the tool's file, constant in F_E."""

    def __init__(self, tool: Tool | None) -> None:
        """Take the tip.

        Raises:
            GeometryError: the tool's file states no tip.
        """
        self._prior: TipPrior = require_tip(tool)
        self._anchor: Anchor | None = None
        self.events: list[Event] = []

    @property
    def anchor(self) -> Anchor | None:
        """The tip at the first pair."""
        return self._anchor

    def update(self, pair: SensedPair) -> TipEstimate:
        """Follow the end effector."""
        R_B_E = pair.left.T_B_E[:3, :3]
        p_B, covariance = apply(pair.left.T_B_E, self._prior.c), R_B_E @ self._prior.covariance @ R_B_E.T
        if self._anchor is None:
            self._anchor = Anchor(p_B, covariance, 0.0, 0)
        status = Status.ANCHORING if pair.phase is Phase.ANCHORING else Status.OK
        return TipEstimate(pair.stamp_ns, pair.phase, status, p_B=p_B, R_B_E=R_B_E, covariance=covariance)


class EeOracleEstimator:
    """``ee-oracle``: the true tip at the end of Stage I, then constant in F_E. Needs the ground truth."""

    def __init__(self, truth_at: Callable[[int], FloatArray]) -> None:
        """Take the truth.

        Args:
            truth_at: True tip (3,) in F_B at a stamp in ns.
        """
        self._truth_at = truth_at
        self._anchor: Anchor | None = None
        self._c_E: FloatArray | None = None
        self.events: list[Event] = []

    @property
    def anchor(self) -> Anchor | None:
        """The true tip at the first pair."""
        return self._anchor

    def update(self, pair: SensedPair) -> TipEstimate:
        """The truth during Stage I, afterwards the end effector with the last true tip."""
        T_B_E = pair.left.T_B_E
        if pair.phase in (None, Phase.ANCHORING) or self._c_E is None:
            p_B = self._truth_at(pair.stamp_ns)
            if self._anchor is None:
                self._anchor = Anchor(p_B, None, 0.0, 0)
            self._c_E = apply(invert(T_B_E), p_B)
        status = Status.ANCHORING if pair.phase is Phase.ANCHORING else Status.OK
        p_B = apply(T_B_E, self._c_E)
        return TipEstimate(pair.stamp_ns, pair.phase, status, p_B=p_B, R_B_E=T_B_E[:3, :3])


class LocalAnchoringEstimator:
    """``local-anchoring``: the paper's Stage I, solved anew in a sliding window all along the trial.

    A window without rotation says nothing; there the last estimate, carried by the tool's motion, fills in (ridge).
    """

    def __init__(self, window: int = 25, ridge_rad: float = 0.3) -> None:
        """Set the window.

        Args:
            window: Frames.
            ridge_rad: Rotation in the window at which it counts as much as the last estimate.
        """
        self._window: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=window)  # R_t (3, 3), d_t (3,)
        self._ridge = ridge_rad**2
        self._p_0: FloatArray | None = None  # last estimate, carried back to frame 0
        self._X_0: FloatArray | None = None
        self._use: FloatArray | None = None
        self._R_B_E_0: FloatArray = np.eye(3)
        self._anchor: Anchor | None = None
        self.events: list[Event] = []

    @property
    def anchor(self) -> Anchor | None:
        """The estimate of the last full window within Stage I."""
        return self._anchor

    def update(self, pair: SensedPair) -> TipEstimate:
        """Kabsch to this frame, fixed point over the window."""
        markers = PadMarkers.of(pair)
        X = apply(pair.left.T_B_E, markers.X)  # (N, 3)
        if self._X_0 is None:
            contact = [in_contact(markers.x_S[markers.pad == k], PatchConfig()) for k in (0, 1)]
            self._X_0, self._use, self._R_B_E_0 = X, np.concatenate(contact), pair.left.T_B_E[:3, :3]
        use = np.asarray(self._use, dtype=bool) & np.isfinite(X[:, 0]) & np.isfinite(self._X_0[:, 0])
        anchoring = pair.phase is Phase.ANCHORING
        try:
            motion = kabsch(self._X_0[use], X[use])
        except GeometryError:
            return TipEstimate(pair.stamp_ns, pair.phase, Status.LOST, markers=int(use.sum()))
        self._window.append((motion.R, motion.d))
        p_B = self._fixed_point(X[use].mean(axis=0))
        if anchoring and len(self._window) == self._window.maxlen:
            self._anchor = Anchor(p_B, None, motion.residual_m, len(self._window))
        return TipEstimate(
            pair.stamp_ns,
            pair.phase,
            Status.ANCHORING if anchoring else Status.OK,
            p_B=p_B,
            R_B_E=motion.R @ self._R_B_E_0,
            residual_m=motion.residual_m,
            markers=int(use.sum()),
        )

    def _fixed_point(self, middle: FloatArray) -> FloatArray:
        """Least squares of ``(I − Q) p = e`` over the window, Q and e the motion from the newest frame to each."""
        R_now, d_now = self._window[-1]
        N, b = np.zeros((3, 3)), np.zeros(3)
        for R, d in self._window:
            Q = R @ R_now.T
            A = np.eye(3) - Q
            N += A.T @ A
            b += A.T @ (d - Q @ d_now)
        last = middle if self._p_0 is None else R_now @ self._p_0 + d_now
        ridge = self._ridge * len(self._window) * (1e-4 if self._p_0 is None else 1.0)
        p = np.linalg.solve(N + ridge * np.eye(3), b + ridge * last)
        if len(self._window) == self._window.maxlen:
            self._p_0 = R_now.T @ (p - d_now)
        return np.asarray(p)
