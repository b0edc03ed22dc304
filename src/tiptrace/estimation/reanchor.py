"""Anchoring anew in mid-trial, when the tip rests again and the hand turns: after a slip, or by the way."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.errors import GeometryError
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.stage_one import Anchoring, StageOne
from tiptrace.estimation.tip_map import TipMap
from tiptrace.geometry.transforms import rotation_log
from tiptrace.types import FloatArray, SensedPair


class ReanchorConfig(BaseModel):
    """When a tip counts as resting."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    window_s: float = Field(default=3.0, gt=0)
    spread_m: float = Field(default=8e-4, gt=0)  # of the estimate, slip error included, about its mean
    turn_rad: float = Field(default=0.08, gt=0)  # range of the hand's orientation within the window
    every: int = Field(default=12, ge=1)  # frames between attempts
    latency_std_s: float = Field(default=0.02, gt=0)  # by which the time offset may have changed
    latency_sigmas: float = Field(default=4.0, gt=0)  # a change beyond is told
    latency_change_s: float = Field(default=0.010, gt=0)


@dataclass(frozen=True, slots=True)
class _Row:
    stamp_ns: int
    p_B: FloatArray
    R_B_E: FloatArray


@dataclass(frozen=True, slots=True)
class Renewed:
    """A new anchor.

    Attributes:
        anchoring: What the window gave.
        off_m: How far off the trace was there.
        latency_change_s: New latency less the old one where they differ for certain, else None.
    """

    anchoring: Anchoring
    off_m: float
    latency_change_s: float | None


class Reanchoring:
    """Watches the last seconds; bounded memory."""

    def __init__(self, config: ReanchorConfig, like: StageOne) -> None:
        self._config, self._like = config, like
        self._segment = like.fresh()
        self._rows: deque[_Row] = deque()
        self._count = 0

    def update(
        self, pair: SensedPair, markers: PadMarkers, p_B: FloatArray, R_B_E: FloatArray, known: TipMap
    ) -> Renewed | None:
        """Take a frame; a new anchor once the tip has rested long enough under a turning hand."""
        self._segment.add_poses(pair.poses)
        self._segment.add(pair.stamp_ns, markers)
        self._rows.append(_Row(pair.stamp_ns, p_B, R_B_E))
        start_ns = pair.stamp_ns - round(self._config.window_s * 1e9)
        complete = self._rows[0].stamp_ns <= start_ns
        while self._rows[0].stamp_ns < start_ns:
            self._rows.popleft()
        self._segment.keep_from(start_ns)
        self._count += 1
        if not complete or self._count % self._config.every or not self._rests():
            return None
        try:
            anchoring = self._segment.solve((known.latency_s, self._config.latency_std_s), None, known)
        except (GeometryError, np.linalg.LinAlgError):
            return None
        off = np.median(np.stack([r.p_B for r in self._rows]), axis=0) - anchoring.tip_map.p
        self._segment, self._count = self._like.fresh(), 0
        self._rows.clear()
        return Renewed(anchoring, float(np.linalg.norm(off)), self._latency_change(anchoring.tip_map, known))

    def _latency_change(self, now: TipMap, before: TipMap) -> float | None:
        change = now.latency_s - before.latency_s
        sigma = float(np.sqrt(now.covariance[15, 15] + before.covariance[15, 15]))
        certain = abs(change) > max(self._config.latency_sigmas * sigma, self._config.latency_change_s)
        return change if certain and bool(now.learned[15]) else None

    def _rests(self) -> bool:
        p = np.stack([r.p_B for r in self._rows])
        middle = np.median(p, axis=0)
        spread = float(np.sqrt(np.median(np.sum((p - middle) ** 2, axis=1))))
        R = np.stack([r.R_B_E for r in self._rows])
        turn = float(np.linalg.norm(rotation_log(R[0].T @ R), axis=1).max())
        return spread < self._config.spread_m and turn > self._config.turn_rad
