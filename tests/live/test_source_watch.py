"""Estimates right after a fault are degraded, with an event that says why; all others stay as they are."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.drivers.base import DeviceHealth, DeviceStatus
from tiptrace.drivers.timeline import NS, ClockMap
from tiptrace.live.source_watch import SourceWatch
from tiptrace.streams.live import Arrival
from tiptrace.types import (
    FingerObservation,
    MarkerSample,
    Observation,
    Phase,
    PoseSample,
    Side,
    Status,
    TipEstimate,
)

PERIOD_NS = 40_000_000
SIGMA2 = 1e-8


class Play:
    """Pairs at 25 Hz with poses at 500 Hz, into a watch."""

    def __init__(self) -> None:
        self.watch, self.now_ns, self.pose_ns = SourceWatch(0.04), 10 * NS, 10 * NS
        self.faults: tuple[tuple[str, int], ...] = ()

    def turn(
        self,
        wait_ns: int = PERIOD_NS,
        after: str = "",
        settled: bool = True,
        poses: bool = True,
        status: Status = Status.OK,
    ) -> TipEstimate:
        self.now_ns += wait_ns
        T = np.eye(4)
        T[0, 3] = self.now_ns * 1e-9  # 1 m/s
        stamps = range(self.pose_ns, self.now_ns, 2_000_000) if poses else range(self.now_ns, self.now_ns + 1)
        samples = tuple(PoseSample(stamp, T) for stamp in stamps)
        self.pose_ns = self.now_ns
        sides: tuple[Side, Side] = ("left", "right")
        left, right = (
            FingerObservation(MarkerSample(side, self.now_ns, np.zeros((1, 3))), T) for side in sides
        )
        observation = Observation(self.now_ns, left, right, Phase.RECONSTRUCTION, poses=samples)
        covariance = SIGMA2 * np.eye(3)
        estimate = TipEstimate(self.now_ns, Phase.RECONSTRUCTION, status, np.zeros(3), covariance=covariance)
        arrivals: dict[Side, Arrival | None] = {
            "left": Arrival(self.now_ns, after, settled),
            "right": Arrival(self.now_ns, "", True),
        }
        health = DeviceHealth("robot", DeviceStatus.OK, faults=self.faults)
        return self.watch.mark(observation, estimate, arrivals, health)


def statuses(play: Play, count: int) -> list[Status]:
    return [play.turn().status for _ in range(count)]


def test_nothing_is_marked_without_a_fault() -> None:
    play = Play()
    assert set(statuses(play, 100)) == {Status.OK}
    assert play.watch.events == []


@pytest.mark.parametrize("after", ["repeated", "garbled", "late", "lost"])
def test_the_pairs_after_images_that_were_left_out_are_marked(after: str) -> None:
    play = Play()
    statuses(play, 5)
    assert play.turn(2 * PERIOD_NS, after).status is Status.DEGRADED
    assert statuses(play, 5) == [Status.DEGRADED] * 2 + [Status.OK] * 3
    kind = "frame-repeated" if after == "repeated" else "frame-stale"
    (event,) = play.watch.events
    assert (event.kind, "left" in event.detail, after in event.detail) == (kind, True, True)
    assert event.end_ns - event.start_ns == 4 * PERIOD_NS, "from the last good pair on"


def test_a_pause_of_both_cameras_is_marked_though_no_fault_was_told() -> None:
    play = Play()
    statuses(play, 5)
    degraded = play.turn(10 * PERIOD_NS)
    assert degraded.status is Status.DEGRADED
    assert degraded.covariance is not None
    assert np.allclose(degraded.covariance, 4 * SIGMA2 * np.eye(3))
    assert {e.detail for e in play.watch.events} == {
        f"{side} images pause for 0.40 s" for side in ("left", "right")
    }


def test_stamps_of_a_clock_that_was_just_set_cost_ten_milliseconds_of_the_way() -> None:
    play = Play()
    statuses(play, 5)
    marked = play.turn(settled=False)
    assert marked.status is Status.DEGRADED
    assert marked.covariance is not None
    assert np.isclose(marked.covariance[0, 0], 4 * SIGMA2 + (1.0 * 0.01) ** 2)
    assert np.isclose(marked.covariance[1, 1], 4 * SIGMA2)
    assert play.turn().status is Status.OK


def test_a_robot_that_pauses_or_whose_clock_is_set_marks_the_pairs_after() -> None:
    play = Play()
    statuses(play, 5)
    for _ in range(4):
        play.turn(poses=False)
    statuses(play, 5)
    play.faults = (("clock-jump", 1),)
    assert statuses(play, 14) == [Status.DEGRADED] * 13 + [Status.OK]
    play = Play()
    statuses(play, 5)
    play.pose_ns = play.now_ns + 3 * PERIOD_NS
    marked = [play.turn(status=Status.OK, wait_ns=5 * PERIOD_NS), *(play.turn() for _ in range(4))]
    assert marked[0].status is Status.DEGRADED
    assert marked[-1].status is Status.OK
    assert any(e.kind == "pose-gap" for e in play.watch.events)


@pytest.mark.parametrize(
    "status", [Status.ANCHORING, Status.NO_CONTACT, Status.RELATIVE, Status.UNOBSERVABLE]
)
def test_other_statuses_stay(status: Status) -> None:
    play = Play()
    statuses(play, 3)
    assert play.turn(9 * PERIOD_NS, status=status).status is status


def test_a_clock_settles_within_half_a_second_and_anew_after_a_step() -> None:
    clock = ClockMap()
    found = []
    for k in range(60):
        step = -5 * NS if k >= 30 else 0
        clock.stamp_ns(100 * NS + k * PERIOD_NS + step, 7 * NS + k * PERIOD_NS)
        found.append(clock.settled)
    assert found == [k % 30 >= 13 for k in range(60)]
