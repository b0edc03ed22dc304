"""τ_cal without phase marks: Stage I ends where the hand sets off without turning."""

from __future__ import annotations

from collections import deque

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.geometry.transforms import rotation_log
from tiptrace.types import FloatArray, Phase


class PhaseConfig(BaseModel):
    """When a motion counts as travel."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    travel_m: float = Field(default=8e-3, gt=0)
    turn_rad: float = Field(default=0.012, gt=0)
    window_s: float = Field(default=1.5, gt=0)
    turned_before_rad: float = Field(default=0.03, gt=0)  # an anchoring motion has to have been there


class PhaseDetector:
    """Tells Stage I from Stage II by the hand alone, with a delay of less than a second."""

    def __init__(self, config: PhaseConfig) -> None:
        self._config = config
        self._window: deque[tuple[int, FloatArray]] = deque()
        self._first: FloatArray | None = None
        self._turned = 0.0
        self.end_ns: int | None = None

    @property
    def turned(self) -> bool:
        """Whether the hand has turned as in an anchoring motion; before it has, nothing says that the tip rests."""
        return self._turned >= self._config.turned_before_rad

    def update(self, stamp_ns: int, T_B_E: FloatArray) -> Phase:
        """Phase of this frame; ``end_ns`` is set once the end of Stage I is known."""
        if self.end_ns is not None:
            return Phase.RECONSTRUCTION
        if self._first is None:
            self._first = T_B_E[:3, :3]
        self._turned = max(self._turned, float(_angle(self._first, T_B_E[:3, :3])))
        self._window.append((stamp_ns, T_B_E))
        while stamp_ns - self._window[0][0] > self._config.window_s * 1e9:
            self._window.popleft()
        start = self._set_off(T_B_E)
        if start is None or not self.turned:
            return Phase.ANCHORING
        self.end_ns = start
        return Phase.RECONSTRUCTION

    def _set_off(self, T_B_E: FloatArray) -> int | None:
        """Stamp since which the hand travels without turning; None if it does not."""
        stamps = [stamp for stamp, _ in reversed(self._window)]
        T = np.array([T for _, T in reversed(self._window)])
        turned = _angle(T[:, :3, :3], T_B_E[:3, :3]) > self._config.turn_rad
        distances = np.linalg.norm(T[:, :3, 3] - T_B_E[:3, 3], axis=1)
        start, farthest = None, 0.0
        for stamp, away, distance in zip(stamps, turned, distances.tolist(), strict=True):
            if away:
                break
            if distance > farthest + 2e-5:
                start, farthest = stamp, distance
        return start if farthest > self._config.travel_m else None


def _angle(R_0: FloatArray, R_1: FloatArray) -> FloatArray:
    """Angles between rotations (..., 3, 3) and one (3, 3), (...) rad."""
    return np.asarray(np.linalg.norm(rotation_log(np.swapaxes(R_0, -1, -2) @ R_1), axis=-1))
