"""What the rig's and the tool's files say beforehand."""

from __future__ import annotations

import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.errors import GeometryError
from tiptrace.estimation.anchor import TipPrior


def calibrated_latency(rig: Rig | None) -> tuple[float, float] | None:
    """Mean and standard deviation of capture minus exposure in s, where the rig states it for both sensors."""
    if rig is None:
        return None
    sensors = (rig.sensors.left, rig.sensors.right)
    known = [(s.latency_s, s.latency_std_s or 0.005) for s in sensors if s.latency_s is not None]
    if len(known) < 2:
        return None
    return float(np.mean([m for m, _ in known])), float(max(s for _, s in known))


def tip_prior(tool: Tool | None) -> TipPrior | None:
    """Tip and covariance from the tool's file, where it states both."""
    if tool is None or tool.tip_E_m is None or tool.tip_sigma_m is None:
        return None
    return TipPrior(np.array(tool.tip_E_m), np.diag(np.square(tool.tip_sigma_m)))


def require_tip(tool: Tool | None) -> TipPrior:
    """The tool's tip, or an error that says what to write.

    Raises:
        GeometryError: the tool's file states no tip.
    """
    prior = tip_prior(tool)
    if prior is None:
        raise GeometryError("the tool's file states no tip: add tip_E_m and tip_sigma_m to tool.yaml")
    return prior
