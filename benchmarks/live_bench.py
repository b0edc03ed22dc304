"""What the live benchmarks share: a session on loopback servers that play a trial forwards and backwards."""

from __future__ import annotations

import resource
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from tiptrace.config import Rig
from tiptrace.drivers.opening import open_camera, open_robot
from tiptrace.drivers.timeline import Timeline
from tiptrace.live.recorder import Recorder
from tiptrace.live.session import LiveSession
from tiptrace.streams.live import LiveStream
from tiptrace.streams.recording import Recording
from tiptrace.types import SIDES, ImageSample, Phase, PhaseSample, Side

PORTS = (18081, 18082)
LEAD_S = 12.0  # of play before the trial begins anew: time to open everything


@dataclass(frozen=True, slots=True)
class Trial:
    """A recording and the times in it, s since its first image."""

    recording: Recording
    first_ns: int
    duration_s: float
    set_off_s: float
    latency_s: float

    @classmethod
    def read(cls, path: Path) -> Trial:
        recording = Recording(path)
        images, set_off = [], 0
        for sample in recording:
            if isinstance(sample, ImageSample):
                images.append(sample.stamp_ns)
            elif isinstance(sample, PhaseSample) and sample.phase is Phase.RECONSTRUCTION:
                set_off = sample.stamp_ns
        first, last = min(images), max(images)
        latency_s = float(recording.trial.get("truth", {}).get("latency_s", 0.0))
        return cls(recording, first, round((last - first) * 25e-9) / 25, (set_off - first) * 1e-9, latency_s)


def live_rig(rig: Rig) -> Rig:
    """The recording's rig with the pose that a UR gives, and the latency that the servers leave: none."""
    sensors = {
        str(side): rig.sensor(side).model_copy(update={"latency_s": 0.0, "latency_std_s": 0.005})
        for side in SIDES
    }
    return rig.model_copy(
        update={
            "frames": rig.frames.model_copy(update={"end_effector": "tcp"}),
            "sensors": rig.sensors.model_copy(update=sensors),
        }
    )


def make_session(trial: Trial, out: Path | None) -> LiveSession:
    timeline, rig = Timeline(), live_rig(trial.recording.rig)
    ports: dict[Side, int] = dict(zip(SIDES, PORTS, strict=True))
    cameras = {
        side: open_camera(
            f"http://127.0.0.1:{ports[side]}/", rig.sensor(side), timeline, encode=out is not None
        )
        for side in SIDES
    }
    references = trial.recording.references
    recorder = None if out is None else Recorder(out, timeline, rig=rig, references=references)
    stream = LiveStream(
        rig,
        cameras,
        open_robot("ur://127.0.0.1", timeline),
        timeline,
        tool=trial.recording.tool,
        references=references,
    )
    return LiveSession(stream, recorder=recorder, wait_for_mark=True)


def begin_with_the_trial(session: LiveSession, trial: Trial, start: float) -> None:
    """Mark the phases when the servers come to the trial's beginning, and stop never."""

    def marks() -> None:
        period = 2.0 * trial.duration_s
        now = time.monotonic() - start
        begin = start + (now // period + 1) * period
        for at in (begin + 0.05, begin + trial.set_off_s + 0.05):
            time.sleep(max(at - time.monotonic(), 0.0))
            session.advance()

    threading.Thread(target=marks, daemon=True).start()


def rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6
