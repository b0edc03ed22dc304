"""Pairs the two fingers' images and puts a pose, a phase and an opening to each pair.

What comes out depends on the samples alone and not on the order of their delivery, as long as none is later
than the settings allow. Buffers are bounded, so the same class serves recordings and live streams.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter

from tiptrace.errors import ConfigError
from tiptrace.streams.pose_track import PoseGap, PoseTrack
from tiptrace.streams.sync_report import SyncReport
from tiptrace.streams.topics import NS
from tiptrace.types import (
    SIDES,
    FingerObservation,
    ImageSample,
    MarkerSample,
    Observation,
    OpeningSample,
    Phase,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
    Stream,
    TactileSample,
)

_stamp = attrgetter("stamp_ns")


@dataclass(frozen=True, slots=True)
class SyncSettings:
    """Limits of synchronisation.

    Attributes:
        max_pair_gap_s: The two images of a pair are at most this far apart.
        max_pose_gap_s: Between poses further apart than this nothing is interpolated.
        max_delay_s: A sample may come this much later than a newer one of its kind; observations wait for it.
        min_frame_spacing_s: Known least time between frames of one camera. Spares a live stream, with
            max_delay_s = 0, the wait for the next frame that would show no better partner.
        max_lag_s: The other finger and the poses are no longer waited for when they are this far behind the
            newest image. Poses may run ahead of the images by twice as much.
    """

    max_pair_gap_s: float = 0.020
    max_pose_gap_s: float = 0.200
    max_delay_s: float = 0.250
    min_frame_spacing_s: float = 0.0
    max_lag_s: float = 3.0

    def __post_init__(self) -> None:
        if min(self.max_pair_gap_s, self.max_pose_gap_s, self.max_delay_s, self.min_frame_spacing_s) < 0:
            raise ConfigError("synchronisation limits must not be negative")
        if self.max_lag_s <= self.max_delay_s + 2 * self.max_pair_gap_s:
            raise ConfigError("max_lag_s must exceed max_delay_s + 2 max_pair_gap_s")


LIVE = SyncSettings(max_delay_s=0.0, min_frame_spacing_s=0.02, max_lag_s=0.5)
"""For hardware: each kind comes in order, an observation leaves as soon as its poses are in."""


def synchronise(
    stream: Stream, settings: SyncSettings | None = None, report: SyncReport | None = None
) -> Iterator[Observation]:
    """Observations of a stream, in order; ``report`` collects what was dropped and why."""
    synchroniser = Synchroniser(settings, report)
    for sample in stream:
        yield from synchroniser.push(sample)
    yield from synchroniser.flush()


class Synchroniser:
    """Samples in, observations out.

    Pairing walks through both sides in time order: the oldest image waiting is paired with the oldest of the
    other side within ``max_pair_gap_s``, unless the next image of its own side lies nearer to that one; then
    it stays alone. So no unused image is ever nearer to an image than its partner.
    """

    def __init__(self, settings: SyncSettings | None = None, report: SyncReport | None = None) -> None:
        self.settings = settings or SyncSettings()
        self.report = report if report is not None else SyncReport()
        self._pair_gap_ns = round(self.settings.max_pair_gap_s * NS)
        self._lag_ns = round(self.settings.max_lag_s * NS)
        delay_ns = round(self.settings.max_delay_s * NS)
        self._delay_ns = delay_ns
        self._lead_ns = round(self.settings.min_frame_spacing_s * NS) if delay_ns == 0 else 0
        self._images: dict[Side, list[TactileSample]] = {"left": [], "right": []}
        self._newest: dict[Side, int | None] = {"left": None, "right": None}
        self._decided: dict[Side, int | None] = {"left": None, "right": None}
        self._newest_image: int | None = None
        self._ended = False
        self._pairs: list[tuple[TactileSample, TactileSample]] = []
        self._track = PoseTrack(round(self.settings.max_pose_gap_s * NS), delay_ns, self._lag_ns)
        self._phases: list[PhaseSample] = []
        self._openings: list[OpeningSample] = []

    def push(self, sample: Sample) -> Iterator[Observation]:
        """Take one sample; give the observations that it completes."""
        if isinstance(sample, ImageSample | MarkerSample):
            self._push_image(sample)
        elif isinstance(sample, PoseSample):
            self._push_pose(sample)
        elif isinstance(sample, PhaseSample):
            insort(self._phases, sample, key=_stamp)
        elif isinstance(sample, OpeningSample):
            insort(self._openings, sample, key=_stamp)
            self._forget_openings()
        else:
            return  # the truth is not for estimators
        yield from self._advance()

    def flush(self) -> Iterator[Observation]:
        """The stream has ended: decide what is still waiting."""
        self._ended = True
        yield from self._advance()

    # --- taking in -----------------------------------------------------------------------------------------

    def _push_image(self, sample: TactileSample) -> None:
        side, stamp = sample.side, sample.stamp_ns
        self.report.images[side] += 1
        waiting, decided = self._images[side], self._decided[side]
        place = bisect_left(waiting, stamp, key=_stamp)
        if decided == stamp or (place < len(waiting) and waiting[place].stamp_ns == stamp):
            self.report.repeated[side] += 1
            return
        if decided is not None and stamp < decided:
            self.report.late[side] += 1
            return
        waiting.insert(place, sample)
        newest, newest_image = self._newest[side], self._newest_image
        self._newest[side] = stamp if newest is None else max(stamp, newest)
        self._newest_image = stamp if newest_image is None else max(stamp, newest_image)

    def _push_pose(self, sample: PoseSample) -> None:
        self.report.poses += 1
        if not self._track.add(sample):
            self.report.poses_dropped += 1

    def _forget_openings(self) -> None:
        if self._newest_image is not None:
            index = _latest(self._openings, self._newest_image - 2 * self._lag_ns)
            del self._openings[: index or 0]

    # --- pairing -------------------------------------------------------------------------------------------

    def _advance(self) -> Iterator[Observation]:
        while self._pair_oldest():
            pass
        while self._pairs:
            observation = self._complete(*self._pairs[0])
            if observation is None:
                break
            self._pairs.pop(0)
            if isinstance(observation, Observation):
                self.report.pairs += 1
                yield observation

    def _none_before(self, side: Side, stamp_ns: int) -> bool:
        """Whether no image of a side with an earlier stamp can still come."""
        if self._ended:
            return True
        assert self._newest_image is not None
        if stamp_ns <= self._newest_image - self._lag_ns:
            return True
        newest = self._newest[side]
        return newest is not None and stamp_ns <= newest - self._delay_ns + self._lead_ns

    def _pair_oldest(self) -> bool:
        """Decide on the oldest waiting image, if that can be done already."""
        heads = [self._images[side][0] for side in SIDES if self._images[side]]
        if not heads:
            return False
        first = min(heads, key=_stamp)
        side: Side = first.side
        other: Side = "right" if side == "left" else "left"
        own, others = self._images[side], self._images[other]
        if not all(self._none_before(s, first.stamp_ns) for s in SIDES):
            return False
        if not others or others[0].stamp_ns - first.stamp_ns > self._pair_gap_ns:
            if not self._none_before(other, first.stamp_ns + self._pair_gap_ns + 1):
                return False
            return self._leave_alone(first)
        partner = others[0]
        if not self._none_before(other, partner.stamp_ns):
            return False
        rival_before = (
            2 * partner.stamp_ns - first.stamp_ns
        )  # an own image before this is nearer to the partner
        if len(own) > 1 and own[1].stamp_ns < rival_before:
            return self._leave_alone(first)
        if not self._none_before(side, rival_before):
            return False
        own.pop(0)
        others.pop(0)
        self._decided[side], self._decided[other] = first.stamp_ns, partner.stamp_ns
        self._pairs.append((first, partner) if side == "left" else (partner, first))
        return True

    def _leave_alone(self, sample: TactileSample) -> bool:
        self._images[sample.side].pop(0)
        self._decided[sample.side] = sample.stamp_ns
        self.report.unpaired[sample.side] += 1
        return True

    # --- completing a pair ---------------------------------------------------------------------------------

    def _complete(self, left: TactileSample, right: TactileSample) -> Observation | PoseGap | None:
        """The observation; a gap if the pair has no pose; None while it must wait."""
        stamp_ns = (left.stamp_ns + right.stamp_ns) // 2
        last_ns = max(left.stamp_ns, right.stamp_ns)
        if not (self._ended or self._track.complete_to(last_ns, self._newest_image)):
            return None
        if not (self._ended or self._marks_complete_to(stamp_ns)):
            return None
        T_B_E = self._track.at((left.stamp_ns, right.stamp_ns))  # (2, 4, 4)
        if isinstance(T_B_E, PoseGap):
            self.report.add_gap(stamp_ns, T_B_E)
            return T_B_E
        phase, opening = self._phase_at(stamp_ns), self._opening_at(stamp_ns)
        return Observation(
            stamp_ns=stamp_ns,
            left=FingerObservation(left, T_B_E[0]),
            right=FingerObservation(right, T_B_E[1]),
            phase=phase,
            opening_m=opening,
            poses=self._track.take_until(last_ns),
        )

    def _marks_complete_to(self, stamp_ns: int) -> bool:
        """Whether marks up to an instant have come; they are dated and delivered by the recorder's clock."""
        assert self._newest_image is not None
        return stamp_ns <= self._newest_image - self._delay_ns

    def _phase_at(self, stamp_ns: int) -> Phase | None:
        index = _latest(self._phases, stamp_ns)
        if index is None:
            return None
        del self._phases[:index]
        return self._phases[0].phase

    def _opening_at(self, stamp_ns: int) -> float | None:
        index = _latest(self._openings, stamp_ns)
        if index is None:
            return None
        del self._openings[:index]
        return self._openings[0].opening_m


def _latest(samples: list[PhaseSample] | list[OpeningSample], stamp_ns: int) -> int | None:
    """Index of the last sample not after an instant."""
    index = bisect_left(samples, stamp_ns + 1, key=_stamp) - 1
    return index if index >= 0 else None
