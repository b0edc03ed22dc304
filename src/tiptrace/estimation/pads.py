"""Both fingers' markers in F_E, one row per marker for the whole trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.geometry.transforms import apply
from tiptrace.types import SIDES, FloatArray, SensedPair


@dataclass(frozen=True, slots=True)
class PadMarkers:
    """Markers of one pair.

    Attributes:
        X: (N, 3) in F_E, m, left finger first; NaN where lost.
        x_S: (N, 3) the same in their own F_S.
        pad: (N,) 0 left, 1 right.
        axes: (2, 3, 3) columns u, v, normal of each pad in F_E.
    """

    X: FloatArray
    x_S: FloatArray
    pad: FloatArray
    axes: FloatArray

    @classmethod
    def of(cls, pair: SensedPair) -> PadMarkers:
        """Stack a pair."""
        x_S = [pair.finger(s).markers.x_S for s in SIDES]
        x_S = [
            np.where(pair.finger(s).markers.tracked[:, None], x, np.nan)
            for s, x in zip(SIDES, x_S, strict=True)
        ]
        X = np.concatenate([apply(pair.finger(s).T_E_S, x) for s, x in zip(SIDES, x_S, strict=True)])
        axes = np.stack([pair.finger(s).T_E_S[:3, :3] for s in SIDES])
        pad = np.repeat([0, 1], [len(x) for x in x_S])
        return cls(X, np.concatenate(x_S), pad, axes)
