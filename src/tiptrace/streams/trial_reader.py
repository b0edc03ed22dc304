"""Turns stored messages into samples, for recordings of any origin: checks once, then reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from tiptrace.config import Rig
from tiptrace.errors import RecordingError
from tiptrace.geometry.transforms import quaternion_from_rotation
from tiptrace.streams import checks
from tiptrace.streams.raw_messages import MessageSource, RawMessage, peek_header
from tiptrace.streams.sample_reader import ImageStep, SampleReader, TrialTopics
from tiptrace.streams.survey import Stamps_ns, survey
from tiptrace.streams.topics import NS, Stamps
from tiptrace.types import (
    FloatArray,
    ImageSample,
    MarkerSample,
    Phase,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
    TruthSample,
)

_MAX_PROBED_POSES = 5000  # of the anchoring segment, for the quaternion order


class TrialReader:
    """Samples of one recording.

    Args:
        source: Where the messages are.
        topics: Which topic plays which part.
        rig: What the user believes about the rig.
        stamps: Which clock dates the messages.
        prepare: Crop, flip and scale an image, per side.
        poses: Poses found in another way than from ``topics.pose`` (a TF chain); called after the survey with
            whether the recorder's clock is in use.
        watch: Sees every message of the survey (to collect that chain).
        remedy: What to do about a missing topic.

    Raises:
        RecordingError: a topic is missing or has the wrong type, clocks disagree or have no time in common,
            values are not in the units of the format, phases are in a wrong order.
    """

    def __init__(
        self,
        source: MessageSource,
        topics: TrialTopics,
        rig: Rig,
        stamps: Stamps,
        *,
        prepare: Mapping[Side, ImageStep] | None = None,
        poses: Callable[[bool], list[PoseSample]] | None = None,
        watch: Callable[[RawMessage], None] | None = None,
        remedy: str = "",
    ) -> None:
        self.notes: list[str] = []
        self._source = source
        self._topics = topics
        self._rig = rig
        self._where = str(source.path)
        self._remedy = remedy
        self._watch = watch
        self._decode = SampleReader(source, topics, rig, prepare or {})
        self._start_ns: int | None = None
        self._seen: set[str] = set()  # image topics of which an image could be decoded
        self._phases: list[Phase] = []
        self._probe: list[FloatArray] = []
        self.survey = survey(source, self._visit)
        self._note_damage()
        self._tactile = self._find_tactile()
        used = [self.survey[topic] for topic in self._decode.roles if topic in self.survey]
        self._use_log, self._shift_ns = checks.choose_clock(self._where, used, stamps)
        self._poses = poses(self._use_log) if poses is not None else []
        self._check({entry.topic: entry.stamps_ns(self._use_log) for entry in used})

    def samples(self) -> Iterator[Sample]:
        """All samples but the truth, in log-time order."""
        poses = iter(self._poses)
        pose = next(poses, None)
        tactile = 0
        self._decode.undecodable.clear()
        for raw in self._source.messages():
            if raw.topic not in self._decode.roles or raw.topic == self._topics.truth:
                continue
            stamp_ns = self._stamp(raw)
            while pose is not None and pose.stamp_ns <= stamp_ns:
                yield pose
                pose = next(poses, None)
            sample = self._decode.sample(raw, stamp_ns)
            if sample is not None:
                tactile += isinstance(sample, ImageSample | MarkerSample)
                yield sample
        if pose is not None:
            yield pose
            yield from poses
        self._note_undecodable(tactile)

    def truth(self) -> list[TruthSample]:
        """The true tip, in order."""
        found = [
            self._decode.sample(raw, self._stamp(raw))
            for raw in (self._source.messages() if self._topics.truth in self.survey else ())
            if raw.topic == self._topics.truth
        ]
        truths = [sample for sample in found if isinstance(sample, TruthSample)]
        return sorted(truths, key=lambda sample: sample.stamp_ns)

    def _stamp(self, raw: RawMessage) -> int:
        header = None if self._use_log else peek_header(raw)
        return raw.log_time_ns + self._shift_ns if header is None else header.stamp_ns

    # --- the survey and its checks -------------------------------------------------------------------------

    def _visit(self, raw: RawMessage) -> None:
        """Look at everything small, and at one image of each side, before anything is used."""
        if self._start_ns is None:
            self._start_ns = self._decode.start_ns = raw.log_time_ns
        if self._watch is not None:
            self._watch(raw)
        if raw.topic not in self._decode.roles or raw.topic in self._seen:
            return
        sample = self._decode.sample(raw, raw.log_time_ns)
        if isinstance(sample, ImageSample):
            self._seen.add(raw.topic)
        elif isinstance(sample, PhaseSample):
            self._phases.append(sample.phase)
        elif isinstance(sample, PoseSample):
            resting = bool(self._phases) and self._phases[-1] is Phase.ANCHORING
            if resting and len(self._probe) < _MAX_PROBED_POSES:
                self._probe.append(sample.T_B_E)

    def _find_tactile(self) -> dict[Side, str]:
        """Topics of both fingers: markers where there are any, or else images.

        Raises:
            RecordingError: a topic without messages.
        """
        for candidates in (self._topics.markers, self._topics.images):
            if candidates and all(topic in self.survey for topic in candidates.values()):
                return dict(candidates)
        raise self._missing([topic for topic in self._topics.images.values() if topic not in self.survey])

    def _missing(self, topics: list[str]) -> RecordingError:
        there = ", ".join(sorted(self.survey)) or "none"
        cut = f" (the recording is {self._source.damage})" if self._source.damage else ""
        return RecordingError(
            f"{self._where}: no messages on {' and '.join(topics)}{cut}; topics there: {there}{self._remedy}"
        )

    def _check(self, stamps: Mapping[str, Stamps_ns]) -> None:
        topics = self._topics
        if topics.pose is not None and topics.pose not in self.survey:
            raise self._missing([topics.pose])
        self._check_frames()
        for topic, values in stamps.items():
            if topic != topics.phase:
                self.notes += checks.check_order(self._where, topic, values)
        tactile = {topic: stamps[topic] for topic in self._tactile.values()}
        checks.check_overlap(self._where, tactile, self._pose_stamps(stamps))
        if self._phases and topics.phase:
            checks.check_phases(self._where, topics.phase, self._phases)
        if self._probe and topics.pose:
            T = np.stack(self._probe)  # (n, 4, 4)
            q = quaternion_from_rotation(T[:, :3, :3])
            checks.check_quaternion_order(self._where, topics.pose, q, T[:, :3, 3])
        self._probe.clear()

    def _check_frames(self) -> None:
        for side, topic in self._tactile.items():
            checks.check_side(self._where, topic, self.survey[topic].frame_ids, side)
        base = self._rig.frames.base
        for name in (self._topics.pose, self._topics.truth):
            if name is not None and name in self.survey:
                frame_ids = self.survey[name].frame_ids
                checks.check_frame(self._where, name, frame_ids, base, "frames.base of the rig file")

    def _pose_stamps(self, stamps: Mapping[str, Stamps_ns]) -> tuple[str, Stamps_ns]:
        if self._topics.pose is not None:
            return self._topics.pose, stamps[self._topics.pose]
        return "the TF chain", np.array([pose.stamp_ns for pose in self._poses], dtype=np.int64)

    # --- notes ---------------------------------------------------------------------------------------------

    def _since_start_s(self, log_time_ns: int) -> float:
        return (log_time_ns - (self._start_ns or 0)) / NS

    def _note_damage(self) -> None:
        if self._source.damage is None:
            return
        last_ns = max((int(entry.log_ns.max()) for entry in self.survey.values()), default=0)
        self.notes.append(
            f"recording is {self._source.damage}, after {self._since_start_s(last_ns):.2f} s; "
            "used as far as it goes"
        )

    def _note_undecodable(self, tactile: int) -> None:
        """Tell of images that were left out.

        Raises:
            RecordingError: there is no other.
        """
        for topic, times in self._decode.undecodable.items():
            note = (
                f"{topic}: images that cannot be decoded, left out: {len(times)} "
                f"(the first at {self._since_start_s(times[0]):.2f} s)"
            )
            if not tactile:
                raise RecordingError(f"{self._where}: {note}; none is left: record them again")
            if note not in self.notes:
                self.notes.append(note)
