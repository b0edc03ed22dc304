"""Stage I as it goes: how well the tip is known along each axis, which motion is missing, when it is enough."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.observability import advice, weak_axes
from tiptrace.tracer import TipTracer
from tiptrace.types import FloatArray, Phase, TipEstimate

_UNKNOWN_M = 0.5


class MonitorConfig(BaseModel):
    """When the anchoring is enough."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    enough_sigma_m: float = Field(default=1e-3, gt=0)  # in the worst direction
    every: int = Field(default=5, ge=1)  # frames between two looks
    memory: int = Field(default=300, ge=10)


@dataclass(frozen=True, slots=True)
class StageOneView:
    """What to tell the user during Stage I.

    Attributes:
        sigma_mm: (3,) standard deviation of the tip along x, y, z of the base; None while nothing is known.
        worst_mm: In the worst direction.
        enough: Whether the anchoring can end.
        missing: Which motion is missing; empty where none is.
    """

    sigma_mm: FloatArray | None
    worst_mm: float | None
    enough: bool
    missing: str

    @property
    def sentence(self) -> str:
        """All of it in a line."""
        if self.sigma_mm is None or self.worst_mm is None:
            return "rotate the hand about the tip, about two axes"
        known = " ".join(
            f"{axis} {sigma:.1f}" if sigma < _UNKNOWN_M * 1e3 else f"{axis} unknown"
            for axis, sigma in zip("xyz", self.sigma_mm, strict=True)
        )
        return f"tip known to {known} mm; " + ("enough: set off" if self.enough else self.missing)


class StageOneMonitor:
    """Watches the estimator; the paper's method and the baselines tell nothing."""

    def __init__(self, tracer: TipTracer, config: MonitorConfig | None = None) -> None:
        self._estimator = tracer.estimator if isinstance(tracer.estimator, FullEstimator) else None
        self._config = config or MonitorConfig()
        self._rotations: deque[FloatArray] = deque(maxlen=self._config.memory)
        self._frames = 0
        self.view: StageOneView | None = None

    def update(self, estimate: TipEstimate) -> StageOneView | None:
        """Take a frame; None outside Stage I."""
        if self._estimator is None or estimate.phase is not Phase.ANCHORING:
            self.view = None
            return None
        if estimate.R_B_E is not None:
            self._rotations.append(estimate.R_B_E)
        self._frames += 1
        if self.view is None or self._frames % self._config.every == 0:
            self.view = self._look(self._estimator.running_covariance)
        return self.view

    def _look(self, covariance: FloatArray | None) -> StageOneView:
        if covariance is None or len(self._rotations) < 3:
            return StageOneView(None, None, False, "")
        limit = self._config.enough_sigma_m
        weak = weak_axes(covariance, limit)
        sigma_mm = 1e3 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
        worst_mm = 1e3 * float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
        missing = advice(weak[:1], covariance, np.stack(self._rotations), limit) if weak else ""
        return StageOneView(sigma_mm, worst_mm, not weak, missing)
