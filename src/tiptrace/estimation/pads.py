"""Both fingers' markers in F_E, one row per marker for the whole trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.geometry.transforms import apply
from tiptrace.types import FloatArray, SensedPair


@dataclass(frozen=True, slots=True)
class PadMarkers:
    """Markers of one pair.

    Attributes:
        X: (N, 3) in F_E, m, left finger first; NaN where lost.
        x_S: (N, 3) the same in their own F_S.
        pad: (N,) 0 left, 1 right.
        axes: (2, 3, 3) columns u, v, normal of each pad in F_E.
        doubtful: Whether a finger cannot tell whose dots are whose.
    """

    X: FloatArray
    x_S: FloatArray
    pad: FloatArray
    axes: FloatArray
    doubtful: bool = False

    @classmethod
    def of(cls, pair: SensedPair) -> PadMarkers:
        """Stack a pair."""
        fingers = (pair.left, pair.right)
        x_S = [np.where(f.markers.tracked[:, None], f.markers.x_S, np.nan) for f in fingers]
        X = np.concatenate([apply(f.T_E_S, x) for f, x in zip(fingers, x_S, strict=True)])
        axes = np.array([f.T_E_S[:3, :3] for f in fingers])
        pad = np.repeat([0, 1], [len(x) for x in x_S])
        doubtful = any(f.markers.doubtful for f in fingers)
        return cls(X, np.concatenate(x_S), pad, axes, doubtful)
