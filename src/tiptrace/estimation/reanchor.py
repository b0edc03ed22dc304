"""Anchoring anew in mid-trial, when the tip rests again and the hand turns: after a slip, or by the way."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.errors import GeometryError
from tiptrace.estimation.observability import weak_axes
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.stage_one import Anchoring, StageOne
from tiptrace.estimation.tip_map import TipMap
from tiptrace.estimation.tip_map_config import P
from tiptrace.geometry.transforms import rotation_log
from tiptrace.types import FloatArray, SensedPair


class ReanchorConfig(BaseModel):
    """When a tip counts as resting."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    window_s: float = Field(default=5.0, gt=0)  # at most
    least_s: float = Field(default=2.0, gt=0)
    away_m: float = Field(default=1.2e-3, gt=0)  # of the last second's place: the tip was on its way there
    spread_m: float = Field(default=8e-4, gt=0)  # of the estimate, slip error included, about its mean
    turn_rad: float = Field(default=0.08, gt=0)  # range of the hand's orientation within the window
    sigma_m: float = Field(
        default=1e-3, gt=0
    )  # of the new anchor on any axis; waits for more motion until then
    every: int = Field(default=12, ge=1)  # frames between attempts
    later: int = Field(default=3, ge=1)  # frames after which an attempt's result is taken
    latency_std_s: float = Field(default=0.02, gt=0)  # by which the time offset may have changed
    latency_sigmas: float = Field(default=4.0, gt=0)  # a change beyond is told
    latency_change_s: float = Field(default=0.010, gt=0)
    latency_sigma_s: float = Field(default=0.004, gt=0)  # vaguer ones are not believed
    latency_most_s: float = Field(default=0.050, gt=0)  # nor are changes beyond
    latency_held_s: float = Field(default=0.002, gt=0)  # uncertainty of a time offset that has not changed
    slack_m: float = Field(default=3e-4, gt=0)  # of a trace that is as good as its anchor
    contradiction: float = Field(
        default=16.3, gt=0
    )  # χ² of three axes at which one anchor must be wrong (99.9 %)


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
        contradicts: Whether it was further off than both anchors' uncertainties explain.
        latency_change_s: New latency less the old one where they differ for certain, else None.
    """

    anchoring: Anchoring
    off_m: float
    contradicts: bool
    latency_change_s: float | None


class _Attempt:
    """The anchor of a window as it was when the attempt began, worked out part by part."""

    def __init__(self, config: ReanchorConfig, window: StageOne, rows: Iterable[_Row], known: TipMap) -> None:
        rows = list(rows)
        self.here = np.median([r.p_B for r in rows], axis=0)
        self.began_ns, self.known, self.age = rows[-1].stamp_ns, known, 0
        self._config, self._window = config, window
        self._parts = self._solve()
        self._anchoring: Anchoring | None = None

    def advance(self) -> bool:
        """Do one part; whether there was one."""
        try:
            next(self._parts)
        except (StopIteration, GeometryError, np.linalg.LinAlgError):
            return False
        return True

    def result(self) -> Anchoring | None:
        """The window's anchor, None where it is too vague; does what is left."""
        while self.advance():
            pass
        return self._anchoring

    def _solve(self) -> Iterator[None]:
        """What creeps in a short window looks like another time offset: unless that is certain, the old one holds."""
        c, known = self._config, self.known
        self._window.prepare()
        yield
        anchoring = self._window.solve((known.latency_s, c.latency_std_s), None, known)
        if weak_axes(anchoring.tip_map.covariance[P, P], c.sigma_m):
            return
        if latency_change(anchoring.tip_map, known, c) is None:
            yield
            anchoring = self._window.solve((known.latency_s, c.latency_held_s), None, known)
            if weak_axes(anchoring.tip_map.covariance[P, P], c.sigma_m):
                return
        self._anchoring = anchoring


def latency_change(now: TipMap, before: TipMap, c: ReanchorConfig) -> float | None:
    """New latency less the old one, s, where they differ for certain."""
    change = now.latency_s - before.latency_s
    own = float(np.sqrt(now.covariance[15, 15]))
    sigma = math.hypot(own, float(np.sqrt(before.covariance[15, 15])))
    certain = abs(change) > max(c.latency_sigmas * sigma, c.latency_change_s)
    sure = own < c.latency_sigma_s and abs(change) < c.latency_most_s
    return change if certain and sure and bool(now.learned[15]) else None


class Reanchoring:
    """Watches the last seconds; bounded memory.

    An attempt takes as long as several frames do. Its result is taken a few frames after it began, whether it was
    worked out meanwhile, by :meth:`advance` between the frames, or not: so it does not depend on anybody's time.
    """

    def __init__(self, config: ReanchorConfig, like: StageOne) -> None:
        self._config = config
        self._segment = like.fresh()
        self._rows: deque[_Row] = deque()
        self._count = 0
        self._attempt: _Attempt | None = None

    def advance(self) -> None:
        """Do a part of what is pending."""
        if self._attempt is not None:
            self._attempt.advance()

    def abandon(self) -> None:
        """The tool slipped: what is pending belongs to the grasp before."""
        self._attempt = None

    def update(
        self, pair: SensedPair, markers: PadMarkers, p_B: FloatArray, R_B_E: FloatArray, known: TipMap
    ) -> Renewed | None:
        """Take a frame; a new anchor once the tip has rested long enough under a turning hand."""
        self._segment.add_poses(pair.poses)
        self._segment.add(pair.stamp_ns, markers)
        self._rows.append(_Row(pair.stamp_ns, p_B, R_B_E))
        self._forget(pair.stamp_ns - round(self._config.window_s * 1e9))
        self._count += 1
        if self._attempt is not None:
            self._attempt.age += 1
            return self._renewed(self._attempt) if self._attempt.age >= self._config.later else None
        if self._count % self._config.every == 0 and self._rests(pair.stamp_ns):
            self._attempt = _Attempt(self._config, self._segment.copy(), self._rows, known)
        return None

    def _renewed(self, attempt: _Attempt) -> Renewed | None:
        """The end of an attempt; after a new anchor the next window begins where this one ended."""
        self._attempt, anchoring = None, attempt.result()
        if anchoring is None:
            return None
        tip_map, known = anchoring.tip_map, attempt.known
        off = attempt.here - tip_map.p
        self._forget(attempt.began_ns + 1)
        self._count = attempt.age
        return Renewed(
            anchoring,
            float(np.linalg.norm(off)),
            self._contradicts(off, tip_map, known),
            latency_change(tip_map, known, self._config),
        )

    def _contradicts(self, off: FloatArray, now: TipMap, before: TipMap) -> bool:
        """Whether both anchors cannot be right, by the distance (3,) of the trace from where the tip rests."""
        covariance = now.covariance[P, P] + before.covariance[P, P] + self._config.slack_m**2 * np.eye(3)
        return bool(off @ np.linalg.solve(covariance, off) > self._config.contradiction)

    def _forget(self, stamp_ns: int) -> None:
        while self._rows[0].stamp_ns < stamp_ns:
            self._rows.popleft()
        self._segment.keep_from(stamp_ns)

    def _rests(self, now_ns: int) -> bool:
        """Whether the tip has rested for long enough under a turning hand; forgets how it got there."""
        p = np.stack([r.p_B for r in self._rows])
        stamps = np.array([r.stamp_ns for r in self._rows])
        here = np.median(p[stamps > now_ns - 10**9], axis=0)
        away = np.flatnonzero(np.linalg.norm(p - here, axis=1) > self._config.away_m)
        if away.size and away[-1] == len(p) - 1:
            return False
        if away.size:
            self._forget(int(stamps[away[-1] + 1]))
            p = p[away[-1] + 1 :]
        if now_ns - self._rows[0].stamp_ns < self._config.least_s * 1e9:
            return False
        spread = float(np.sqrt(np.median(np.sum((p - np.median(p, axis=0)) ** 2, axis=1))))
        R = np.stack([r.R_B_E for r in self._rows])
        turn = float(np.linalg.norm(rotation_log(R[0].T @ R), axis=1).max())
        return spread < self._config.spread_m and turn > self._config.turn_rad
