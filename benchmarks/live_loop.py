"""Live loop on loopback: two 640×480 MJPEG cameras at 25 fps over HTTP, a UR at 500 Hz over RTDE, recording on.

    python benchmarks/live_loop.py trial.mcap --seconds 600

The servers run in a process of their own and play the trial forwards and backwards. Prints pairs sent and lost, latency
from the later image's arrival to the estimate, CPU of this process, and memory at the beginning and at the end.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.live.servers import FPS, in_child, play_trial

from tiptrace.config import Rig
from tiptrace.drivers.opening import open_camera, open_robot
from tiptrace.drivers.timeline import Timeline
from tiptrace.live.recorder import Recorder
from tiptrace.live.session import LiveSession
from tiptrace.streams.live import LiveStream
from tiptrace.streams.recording import Recording
from tiptrace.types import SIDES, Side, Snapshot

PORTS = (18081, 18082)


def live_rig(rig: Rig) -> Rig:
    """The recording's rig with the pose that a UR gives."""
    return rig.model_copy(update={"frames": rig.frames.model_copy(update={"end_effector": "tcp"})})


def rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class Watch:
    """Memory along the way."""

    def __init__(self) -> None:
        self.rss: list[tuple[float, float]] = []
        self.next = 0.0

    def __call__(self, snapshot: Snapshot) -> None:
        now = time.monotonic()
        if now > self.next:
            self.rss.append((now, rss_mb()))
            self.next = now + 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--no-record", action="store_true")
    arguments = parser.parse_args()
    recording = Recording(arguments.recording)
    start = time.monotonic() + 3.0
    with in_child(play_trial, arguments.recording, start, (), PORTS), tempfile.TemporaryDirectory() as folder:
        time.sleep(max(start - time.monotonic(), 0.0))
        run(recording, arguments.seconds, None if arguments.no_record else Path(folder) / "live.mcap")


def run(recording: Recording, seconds: float, out: Path | None) -> None:
    timeline, rig = Timeline(), live_rig(recording.rig)
    ports: dict[Side, int] = dict(zip(SIDES, PORTS, strict=True))
    cameras = {
        side: open_camera(
            f"http://127.0.0.1:{ports[side]}/", rig.sensor(side), timeline, encode=out is not None
        )
        for side in SIDES
    }
    robot = open_robot("ur://127.0.0.1", timeline)
    recorder = None if out is None else Recorder(out, timeline, rig=rig, references=recording.references)
    stream = LiveStream(rig, cameras, robot, timeline, tool=recording.tool, references=recording.references)
    session, watch = LiveSession(stream, recorder=recorder), Watch()
    session.subscribe(watch)
    with stream:
        cpu, wall = time.process_time(), time.perf_counter()
        summary = session.run(seconds, opened=True)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    half = len(watch.rss) // 2
    settled = [mb for _, mb in watch.rss[min(10, half) :]]
    assert summary.latency_ms is not None
    p50, p99, most = summary.latency_ms
    expected = round(summary.seconds * FPS) + 1
    rows = [
        ("pairs estimated / expected", f"{summary.pairs} / {expected}", f"lost {expected - summary.pairs}"),
        ("latency p50, p99, max", f"{p50:.1f}, {p99:.1f}, {most:.1f} ms", "limits 15, 40 ms"),
        ("CPU of tiptrace", f"{100 * cpu / wall:.0f} % of one core", "limit 80 %"),
        ("memory after 10 s / at the end", f"{settled[0]:.0f} / {settled[-1]:.0f} MB", "flat"),
        ("robot", f"{summary.devices['robot'].rate_hz or 0:.0f} Hz", str(summary.devices["robot"].faults)),
        *(
            (side, f"{summary.devices[side].rate_hz or 0:.2f} Hz", str(summary.devices[side].faults))
            for side in SIDES
        ),
        ("left out", "; ".join(summary.sentences) or "nothing", f"bad pairs {summary.bad_pairs}"),
    ]
    if out is not None and recorder is not None:
        check = Recording(out)
        counts = {topic: len(survey.log_ns) for topic, survey in check.survey.items()}
        rows.append(("recording", f"{out.stat().st_size / 1e6:.1f} MB", f"{counts} notes {check.notes}"))
    print(f"{seconds:.0f} s, {'recording' if out else 'not recording'}")
    for name, value, remark in rows:
        print(f"  {name:32s} {value:34s} {remark}")


if __name__ == "__main__":
    main()
