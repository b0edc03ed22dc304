"""The numbers that the paper reports: hardware, 51 trials, mean ± std over trials."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

LABEL = "published, hardware, n = 51"


@dataclass(frozen=True, slots=True)
class MeanStd:
    """Mean and standard deviation over trials."""

    mean: float
    std: float


PUBLISHED = MappingProxyType(
    {
        "trajectory_rmse_mm": MeanStd(8.59, 2.41),
        "shape_rmse_mm": MeanStd(5.96, 1.16),
        "initial_contact_error_mm": MeanStd(9.48, 3.77),
        "loop_rate_hz": MeanStd(14.00, 4.11),
    }
)
LOOP_RATE_RANGE_HZ = (6.14, 23.68)
SPEARMAN = MappingProxyType({"trajectory_rmse_mm": 0.80, "shape_rmse_mm": 0.16})
SET_SHAPE_RANGE_MM = (5.0, 6.6)
TRIALS = 51
