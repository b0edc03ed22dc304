"""Random faults while a session runs: does it survive, say what is wrong, and come back?

    python benchmarks/live_soak.py trial.mcap --faults 200

Camera stall, disconnect, frozen, repeated, dropped, cut off and garbage images, a camera clock that is set; robot
drop-out, silence and clock; a slow disk. A fault every three seconds. The servers play the trial forwards and
backwards, so the true tip is known at every instant.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from live_bench import LEAD_S, PORTS, Trial, begin_with_the_trial, make_session, rss_mb  # noqa: E402
from tests.live.servers import Fault, in_child, play_trial  # noqa: E402

from tiptrace.live.session import LiveSession  # noqa: E402
from tiptrace.streams.recording import Recording  # noqa: E402
from tiptrace.types import SIDES, ImageSample, Phase, Snapshot, Status  # noqa: E402

CAMERA_FAULTS = ("stall", "disconnect", "freeze", "repeat", "drop", "truncate", "garbage", "clock")
ROBOT_FAULTS = ("disconnect", "stall", "clock")
SILENT_ERROR_M = 0.003  # beyond the same session's median without faults


def draw(count: int, begin_s: float, seed: int) -> tuple[Fault, ...]:
    """Faults of 0.2 to 1.5 s, one every 3.5 s."""
    rng = np.random.default_rng(seed)
    kinds = [(kind, side) for kind in CAMERA_FAULTS for side in SIDES]
    kinds += [(kind, "robot") for kind in ROBOT_FAULTS] * 3 + [("slow", "disk")] * 2
    faults = []
    for k in range(count):
        kind, target = kinds[int(rng.integers(len(kinds)))]
        at = begin_s + 3.5 * k
        faults.append(Fault(kind, target, at, at + float(rng.uniform(0.2, 1.5))))
    return tuple(faults)


class Disk:
    """``os.fsync`` that is slow while a fault says so."""

    def __init__(self, faults: tuple[Fault, ...], start: float) -> None:
        self._faults, self._start, self._fsync = [f for f in faults if f.kind == "slow"], start, os.fsync

    def __call__(self, number: int) -> None:
        now = time.monotonic() - self._start
        for fault in self._faults:
            if fault.start_s <= now < fault.end_s:
                time.sleep(fault.end_s - now)
        self._fsync(number)


class Watch:
    """Keeps what is judged at the end: play time, status, error against the truth."""

    def __init__(self, session: LiveSession, trial: Trial, start: float, end_s: float) -> None:
        self._session, self._trial, self._start, self._end_s = session, trial, start, end_s
        truth = trial.recording.truth()
        self._truth_s = np.array([(t.stamp_ns - trial.first_ns) * 1e-9 + trial.latency_s for t in truth])
        self._truth = np.stack([t.p_B for t in truth])
        self.rows: list[tuple[float, Status, Phase | None, float]] = []
        self.notes: tuple[str, ...] = ()
        self.last = time.monotonic()
        self.longest_silence_s = 0.0

    def __call__(self, snapshot: Snapshot) -> None:
        now, e = time.monotonic(), snapshot.estimate
        self.longest_silence_s = max(self.longest_silence_s, now - self.last)
        self.last = now
        timeline = self._session.stream.timeline
        t_s = (e.stamp_ns - timeline.offset_ns) * 1e-9 - self._start
        error = float("nan")
        if e.p_B is not None:
            D = self._trial.duration_s
            phase = t_s % (2 * D)
            s = phase if phase <= D else 2 * D - phase
            true = [np.interp(s, self._truth_s, self._truth[:, i]) for i in range(3)]
            error = float(np.linalg.norm(e.p_B - true))
        self.rows.append((t_s, e.status, e.phase, error))
        self.notes = snapshot.notes
        if now - self._start > self._end_s:
            self._session.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    trial = Trial.read(arguments.recording)
    start = time.monotonic() + 3.0 - (2.0 * trial.duration_s - LEAD_S)
    begin_s = 2.0 * trial.duration_s + trial.set_off_s + 3.0
    faults = draw(arguments.faults, begin_s, arguments.seed)
    servers = in_child(play_trial, arguments.recording, start, faults, PORTS, trial.latency_s)
    with servers, tempfile.TemporaryDirectory() as folder:
        time.sleep(3.0)
        os.fsync = Disk(faults, start)
        out = Path(folder) / "soak.mcap"
        session = make_session(trial, out)
        watch = Watch(session, trial, start, faults[-1].end_s + 4.0)
        session.subscribe(watch)
        begin_with_the_trial(session, trial, start)
        memory = rss_mb()
        summary = session.run()
        print(f"{len(faults)} faults in {summary.seconds:.0f} s, {summary.pairs} pairs")
        judge(watch, faults)
        print(f"  memory before / after          {memory:.0f} / {rss_mb():.0f} MB")
        print(f"  events                         {dict(Counter(e.kind for e in summary.events))}")
        states = {name: health.status.value for name, health in summary.devices.items()}
        print(f"  at the end                     {states} {watch.notes}")
        print(f"  longest time without a word    {watch.longest_silence_s:.2f} s")
        print(f"  device faults                  { {n: dict(h.faults) for n, h in summary.devices.items()} }")
        print(f"  recorder                       {summary.recorder}")
        check(out)


def judge(watch: Watch, faults: tuple[Fault, ...]) -> None:
    t = np.array([row[0] for row in watch.rows])
    status = np.array([row[1].value for row in watch.rows])
    error = np.array([row[3] for row in watch.rows])
    late = np.array([row[2] is Phase.RECONSTRUCTION for row in watch.rows])
    touched = np.zeros(len(t), dtype=bool)
    for fault in faults:
        touched |= (t >= fault.start_s - 0.1) & (t <= fault.end_s + 2.0)
    calm = late & ~touched & np.isfinite(error)
    usual = float(np.median(error[calm])) if calm.any() else float("nan")
    claimed = late & touched & np.isfinite(error) & (status == "ok")
    wrong = claimed & (error > usual + SILENT_ERROR_M)
    print(
        f"  error without faults           median {np.median(error[calm]) * 1e3:.2f}, p99 {usual * 1e3:.2f} mm"
    )
    if claimed.any():
        middle, most = np.median(error[claimed]) * 1e3, error[claimed].max() * 1e3
        print(f"  error of 'ok' about faults     median {middle:.2f}, max {most:.2f} mm")
    print(f"  'ok' and 3 mm off about faults  {int(wrong.sum())} of {int(claimed.sum())}")
    for k in np.flatnonzero(wrong)[:5]:
        near = min(faults, key=lambda f: abs(f.end_s - t[k]))
        before = t[max(k - 3, 0) : k] - t[k]
        print(
            f"      {error[k] * 1e3:.1f} mm, {t[k] - near.end_s:+.2f} s from the end of {near.kind} of {near.target} "
            f"({near.end_s - near.start_s:.1f} s long), pairs before it at {np.round(before, 2)} s"
        )
    print(f"  status about faults            {dict(Counter(status[touched].tolist()))}")
    recoveries = {}
    for fault in faults:
        after = t[(t > fault.end_s) & (status != "lost")]
        recoveries[fault] = float(after.min() - fault.end_s) if len(after) else float("inf")
    worst = sorted(recoveries.items(), key=lambda item: -item[1])[:3]
    slow = sum(value > 2.0 for value in recoveries.values())
    print(
        f"  recovery                       median {np.median(list(recoveries.values())):.2f} s, over 2 s: {slow}"
    )
    for fault, value in worst:
        print(
            f"      {value:.2f} s after {fault.kind} of {fault.target}, {fault.end_s - fault.start_s:.1f} s long"
        )


def check(out: Path) -> None:
    recording = Recording(out)
    images, ordered = 0, True
    for survey in recording.survey.values():
        if survey.has_header:
            ordered &= bool(np.all(np.diff(survey.header_ns) > 0))
    for sample in recording:
        images += isinstance(sample, ImageSample)
    print(
        f"  recording                      {images} images, stamps in order: {ordered}, notes: {recording.notes}"
    )


if __name__ == "__main__":
    main()
