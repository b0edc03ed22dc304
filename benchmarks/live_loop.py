"""Live loop on loopback: two 640×480 MJPEG cameras at 25 fps over HTTP, a UR at 500 Hz over RTDE, recording on.

    python benchmarks/live_loop.py trial.mcap --seconds 600

The servers run in a process of their own and play the trial forwards and backwards; the session begins with the
trial's anchoring. Prints pairs lost, latency from the later image's arrival to the estimate, CPU of this process, and
memory at the beginning and at the end.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from live_bench import LEAD_S, PORTS, Trial, begin_with_the_trial, make_session, rss_mb  # noqa: E402
from tests.live.servers import FPS, in_child, play_trial  # noqa: E402

from tiptrace.live.session import LiveSession  # noqa: E402
from tiptrace.live.summary import LiveSummary  # noqa: E402
from tiptrace.snapshot import Snapshot  # noqa: E402
from tiptrace.streams.recording import Recording  # noqa: E402
from tiptrace.types import SIDES  # noqa: E402


class Watch:
    """Begins to count with the first pair; memory along the way."""

    def __init__(self, session: LiveSession, seconds: float) -> None:
        self._session, self._seconds = session, seconds
        self.rss: list[float] = []
        self.cpu, self.wall, self._next = 0.0, 0.0, 0.0

    def __call__(self, snapshot: Snapshot) -> None:
        now = time.monotonic()
        if snapshot.latency_ms is None:
            return
        if not self.wall:
            self.cpu, self.wall = time.process_time(), now
        if now > self._next:
            self.rss.append(rss_mb())
            self._next = now + 1.0
        if now - self.wall > self._seconds:
            self._session.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--no-record", action="store_true")
    arguments = parser.parse_args()
    trial = Trial.read(arguments.recording)
    start = time.monotonic() + 3.0 - (2.0 * trial.duration_s - LEAD_S)
    servers = in_child(play_trial, arguments.recording, start, (), PORTS, trial.latency_s)
    with servers, tempfile.TemporaryDirectory() as folder:
        time.sleep(3.0)
        out = None if arguments.no_record else Path(folder) / "live.mcap"
        session = make_session(trial, out)
        watch = Watch(session, arguments.seconds)
        session.subscribe(watch)
        begin_with_the_trial(session, trial, start)
        summary = session.run()
        cpu = (time.process_time() - watch.cpu) / (time.monotonic() - watch.wall)
        print(f"{arguments.seconds:.0f} s, {'recording' if out else 'not recording'}")
        for name, value, remark in rows(summary, watch, cpu, out):
            print(f"  {name:32s} {value:34s} {remark}")


def rows(summary: LiveSummary, watch: Watch, cpu: float, out: Path | None) -> list[tuple[str, str, str]]:
    settled = watch.rss[min(20, len(watch.rss) // 2) :]
    slope = float(np.polyfit(np.arange(len(settled)), settled, 1)[0]) * 60 if len(settled) > 2 else 0.0
    assert summary.latency_ms is not None
    p50, p99, most = summary.latency_ms
    expected = round(summary.seconds * FPS) + 1
    found = [
        ("pairs estimated / expected", f"{summary.pairs} / {expected}", f"lost {expected - summary.pairs}"),
        ("latency p50, p99, max", f"{p50:.1f}, {p99:.1f}, {most:.1f} ms", "limits 15, 40 ms"),
        ("CPU of tiptrace", f"{100 * cpu:.0f} % of one core", "limit 80 %"),
        ("memory", f"{settled[0]:.0f} … {settled[-1]:.0f} MB", f"{slope:+.1f} MB/min"),
        *(
            (name, f"{summary.devices[name].rate_hz or 0:.1f} Hz", str(summary.devices[name].faults))
            for name in (*SIDES, "robot")
        ),
        (
            "left out",
            "; ".join(summary.sentences) or "nothing",
            f"pairs that could not be used: {summary.bad_pairs}",
        ),
    ]
    if out is not None:
        check = Recording(out)
        counts = {topic: len(survey.log_ns) for topic, survey in check.survey.items()}
        found.append(("recording", f"{out.stat().st_size / 1e6:.1f} MB", f"{counts}, notes {check.notes}"))
    return found


if __name__ == "__main__":
    main()
