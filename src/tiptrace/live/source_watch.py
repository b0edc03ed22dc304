"""Marks estimates right after a fault of a camera or the robot: usable, but not as sure as the others."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from tiptrace.drivers.base import DeviceHealth, DeviceStatus
from tiptrace.drivers.timeline import NS
from tiptrace.streams.live import Arrival
from tiptrace.types import SIDES, Event, FloatArray, Observation, Side, Status, TipEstimate

_PAUSE_PERIODS = 2.5  # between two frames of a camera
_POSE_PAUSE_NS = round(0.1 * NS)
_HOLD_NS = round(0.1 * NS)  # after a pause: as long as the estimator's windows look back
_UNSETTLED_NS = round(0.5 * NS)  # until a robot's clock is followed again
_CLOCK_FAULTS = ("lost", "clock-jump")
_DEGRADED_SIGMA = 2.0  # times the usual
_STAMP_SIGMA_S = 0.01  # of stamps by a clock that has just been followed anew
_EVENTS = 2000
_REPEATS = (DeviceStatus.REPEATED, DeviceStatus.FROZEN)


@dataclass(frozen=True, slots=True)
class _Reason:
    """Why a pair is degraded: the event's kind and text, and whether its stamps are uncertain."""

    kind: str
    detail: str
    unsettled: bool = False


class SourceWatch:
    """Looks at each pair's way to the loop.

    An estimate is ``degraded``, its standard deviation doubled, and an event says why, where an image or pose of its
    pair is the first after a pause or after others that were left out, or came within 0.1 s of that, or where the
    stamps come from a clock that has been followed for less than 0.5 s (a new connection, or a clock that was set);
    then 10 ms of the tip's way are added too.

    Args:
        period_s: Between two frames of a camera; None where it is not known.
    """

    def __init__(self, period_s: float | None) -> None:
        self._pause_ns = None if period_s is None else round(_PAUSE_PERIODS * period_s * NS)
        self._last: Observation | None = None
        self._last_pose_ns: int | None = None
        self._clock_faults = 0
        self._until: dict[_Reason, int] = {}
        self._events: deque[Event] = deque(maxlen=_EVENTS)

    @property
    def events(self) -> list[Event]:
        """One per fault that touched a pair, latest last; the last 2000."""
        return list(self._events)

    def mark(
        self,
        observation: Observation,
        estimate: TipEstimate,
        arrivals: Mapping[Side, Arrival | None],
        robot: DeviceHealth,
    ) -> TipEstimate:
        """The estimate, marked where it has to be."""
        last, self._last = self._last, observation
        self._note_images(observation, last, arrivals)
        self._note_poses(observation, robot)
        now_ns = observation.stamp_ns
        self._until = {reason: until for reason, until in self._until.items() if until >= now_ns}
        if not self._until or last is None:
            return estimate
        for reason in self._until:
            self._log(reason, last.stamp_ns, now_ns)
        return _degraded(estimate, last, observation, any(r.unsettled for r in self._until))

    # --- reasons -------------------------------------------------------------------------------------------

    def _note_images(
        self, observation: Observation, last: Observation | None, arrivals: Mapping[Side, Arrival | None]
    ) -> None:
        for side in SIDES:
            stamp_ns, arrival = observation.finger(side).sample.stamp_ns, arrivals[side]
            if last is not None and self._pause_ns is not None:
                pause_ns = stamp_ns - last.finger(side).sample.stamp_ns
                if pause_ns > self._pause_ns:
                    self._hold(
                        _Reason("frame-stale", f"{side} images pause for {pause_ns / NS:.2f} s"), stamp_ns
                    )
            if arrival is not None and arrival.after:
                kind = "frame-repeated" if arrival.after in _REPEATS else "frame-stale"
                self._hold(_Reason(kind, f"{side} images were left out ({arrival.after})"), stamp_ns)
            if arrival is not None and not arrival.settled:
                detail = f"the {side} camera's clock was set, or its connection is new"
                self._until[_Reason("frame-stale", detail, unsettled=True)] = observation.stamp_ns

    def _note_poses(self, observation: Observation, robot: DeviceHealth) -> None:
        stamps = [pose.stamp_ns for pose in observation.poses]
        if self._last_pose_ns is not None:
            stamps.insert(0, self._last_pose_ns)
        for before, after in pairwise(stamps):
            if after - before > _POSE_PAUSE_NS:
                pause_s = (after - before) / NS
                self._hold(
                    _Reason("pose-gap", f"the robot's poses pause for {pause_s:.2f} s"), observation.stamp_ns
                )
        self._last_pose_ns = stamps[-1] if stamps else None
        faults = sum(count for kind, count in robot.faults if kind in _CLOCK_FAULTS)
        if faults > self._clock_faults:
            reason = _Reason(
                "pose-gap", "the robot's clock was set, or its connection is new", unsettled=True
            )
            self._until[reason] = observation.stamp_ns + _UNSETTLED_NS
        self._clock_faults = faults

    def _hold(self, reason: _Reason, stamp_ns: int) -> None:
        self._until[reason] = stamp_ns + _HOLD_NS

    def _log(self, reason: _Reason, since_ns: int, stamp_ns: int) -> None:
        """Begin an event, or prolong the one that goes on."""
        for k, event in enumerate(self._events):
            if event.kind == reason.kind and event.detail == reason.detail and event.end_ns >= since_ns:
                self._events[k] = replace(event, end_ns=stamp_ns)
                return
        self._events.append(Event(reason.kind, since_ns, stamp_ns, reason.detail))


def _degraded(estimate: TipEstimate, last: Observation, now: Observation, unsettled: bool) -> TipEstimate:
    status = Status.DEGRADED if estimate.status is Status.OK else estimate.status
    if estimate.covariance is None:
        return replace(estimate, status=status)
    covariance: FloatArray = _DEGRADED_SIGMA**2 * estimate.covariance  # (3, 3)
    if unsettled:
        dt_s = max((now.stamp_ns - last.stamp_ns) / NS, 1e-3)
        v = (now.left.T_B_E[:3, 3] - last.left.T_B_E[:3, 3]) / dt_s  # (3,) of the hand
        covariance = covariance + np.outer(v, v) * _STAMP_SIGMA_S**2
    return replace(estimate, status=status, covariance=covariance)
