"""Random faults while a session runs: does it survive, say what is wrong, and come back?

    python benchmarks/live_soak.py trial.mcap --faults 200

Camera stall, disconnect, frozen, repeated, dropped, cut off and garbage images, a camera clock that is set; robot
drop-out, silence and clock; the machine's wall clock set by up to an hour and back; a slow disk. A fault every 3.5 s.
The servers play the trial forwards and backwards, so the true tip is known at every instant. Exit code 1 where a limit
is not kept.
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from live_bench import LEAD_S, PORTS, Trial, begin_with_the_trial, make_session, rss_mb  # noqa: E402
from tests.live.servers import Fault, in_child, play_trial  # noqa: E402

from tiptrace.live.session import LiveSession  # noqa: E402
from tiptrace.snapshot import Snapshot  # noqa: E402
from tiptrace.streams.recording import Recording  # noqa: E402
from tiptrace.types import SIDES, BoolArray, FloatArray, ImageSample, Phase, Status  # noqa: E402

CAMERA_FAULTS = ("stall", "disconnect", "freeze", "repeat", "drop", "truncate", "garbage", "clock")
ROBOT_FAULTS = ("disconnect", "stall", "clock")
HANG_S = 10.0
RECOVERY_S = 2.0
PAUSE_S = 0.11  # between two pairs: more than two periods
SILENT_ERROR_M = 0.003  # beyond the same session's median without faults


def draw(count: int, begin_s: float, seed: int) -> tuple[Fault, ...]:
    """Faults of 0.2 to 1.5 s, one every 3.5 s."""
    rng = np.random.default_rng(seed)
    kinds = [(kind, side) for kind in CAMERA_FAULTS for side in SIDES]
    kinds += [(kind, "robot") for kind in ROBOT_FAULTS] * 3 + [("slow", "disk"), ("clock", "wall")] * 2
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


class WallClock:
    """``time.time`` and ``time.time_ns`` of this process, set by up to an hour while a fault says so."""

    def __init__(self, faults: tuple[Fault, ...], start: float) -> None:
        self._faults, self._start = [f for f in faults if f.target == "wall"], start
        self._time_ns = time.time_ns

    def install(self) -> None:
        """Every module calls them through ``time``."""
        time.time_ns = self.time_ns
        time.time = lambda: self.time_ns() * 1e-9

    def time_ns(self) -> int:
        now = time.monotonic() - self._start
        for k, fault in enumerate(self._faults):
            if fault.start_s <= now < fault.end_s:
                return self._time_ns() + (-1) ** k * round(3600e9 / (1 + k % 7) ** 3)
        return self._time_ns()


def watch_for_hangs(watch: Watch) -> None:
    """End the process where nothing was said for ten seconds."""

    def look() -> None:
        while time.monotonic() - watch.last < HANG_S:
            time.sleep(0.5)
        print(f"  HANG: nothing was said for {HANG_S:g} s", flush=True)
        faulthandler.dump_traceback()
        os._exit(3)

    threading.Thread(target=look, daemon=True).start()


class Watch:
    """Keeps what is judged at the end: play time, status, error against the truth."""

    def __init__(self, session: LiveSession, trial: Trial, start: float, end_s: float) -> None:
        self._session, self._trial, self._start, self._end_s = session, trial, start, end_s
        truth = trial.recording.truth()
        self._truth_s = np.array([(t.stamp_ns - trial.first_ns) * 1e-9 + trial.latency_s for t in truth])
        self._truth = np.stack([t.p_B for t in truth])
        self.rows: list[tuple[float, Status, Phase | None, float, bool]] = []
        self.notes: tuple[str, ...] = ()
        self.last = time.monotonic()
        self.longest_silence_s = 0.0

    def __call__(self, snapshot: Snapshot) -> None:
        now, e = time.monotonic(), snapshot.estimate
        if self.rows:  # before there is the time to open everything
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
        self.rows.append((t_s, e.status, e.phase, error, snapshot.latency_ms is not None))
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
        WallClock(faults, start).install()
        watch = Watch(session, trial, start, faults[-1].end_s + 4.0)
        session.subscribe(watch)
        begin_with_the_trial(session, trial, start)
        memory = rss_mb()
        watch_for_hangs(watch)
        summary = session.run()
        watch.last = float("inf")
        print(
            f"{len(faults)} faults (seed {arguments.seed}) in {summary.seconds:.0f} s, {summary.pairs} pairs"
        )
        drawn = Counter(f"{fault.kind} of {fault.target}" for fault in faults)
        say("faults", ", ".join(f"{name} {count}" for name, count in sorted(drawn.items())))
        say("crashes, hangs", f"none, none (longest time without a word {watch.longest_silence_s:.2f} s)")
        kept = [judge(watch, faults), check(out)]
        say("memory before / after", f"{memory:.0f} / {rss_mb():.0f} MB")
        say("events", str(dict(Counter(e.kind for e in summary.events))))
        states = {name: health.status.value for name, health in summary.devices.items()}
        say("at the end", f"{states} {watch.notes}")
        say("device faults", str({n: dict(h.faults) for n, h in summary.devices.items()}))
        say("recorder", str(summary.recorder))
    sys.exit(not all(kept))


def say(name: str, value: str) -> None:
    print(f"  {name:34s} {value}")


def judge(watch: Watch, faults: tuple[Fault, ...]) -> bool:
    """Whether nothing was silently wrong, every pair after a pause was marked, and all came back in time."""
    t = np.array([row[0] for row in watch.rows])
    status = np.array([row[1].value for row in watch.rows])
    error = np.array([row[3] for row in watch.rows])
    late = np.array([row[2] is Phase.RECONSTRUCTION for row in watch.rows])
    touched = np.zeros(len(t), dtype=bool)
    for fault in faults:
        touched |= (t >= fault.start_s - 0.1) & (t <= fault.end_s + 2.0)
    calm = late & ~touched & np.isfinite(error)
    usual = float(np.median(error[calm])) if calm.any() else 0.0
    if calm.any():
        say("error without faults", f"{spread(error[calm])} ({calm.sum()} pairs)")
    for name in ("ok", "degraded"):
        about = late & touched & np.isfinite(error) & (status == name)
        if about.any():
            say(f"error of '{name}' about faults", f"{spread(error[about])} ({about.sum()} pairs)")
    claimed = late & touched & np.isfinite(error) & (status == "ok")
    wrong = claimed & (error > usual + SILENT_ERROR_M)
    say("silently wrong ('ok', 3 mm off)", f"{int(wrong.sum())} of {int(claimed.sum())}")
    tell_wrong(t, error, wrong, faults)
    unmarked = after_a_pause(t, np.array([row[4] for row in watch.rows])) & (status == "ok") & late
    say("'ok' right after a pause", f"{int(unmarked.sum())}")
    tell_wrong(t, error, unmarked, faults)
    say("status about faults", str(dict(Counter(status[touched].tolist()))))
    slow = tell_recovery(t, status, faults)
    return not (wrong.any() or unmarked.any() or slow)


def spread(error: FloatArray) -> str:
    median, p99, most = np.percentile(error * 1e3, [50, 99, 100])
    return f"median {median:.2f}, p99 {p99:.2f}, max {most:.2f} mm"


def after_a_pause(t: FloatArray, known: BoolArray) -> BoolArray:
    """Pairs whose predecessor is more than two periods older."""
    found, last = np.zeros(len(t), dtype=bool), t[0]
    for k in np.flatnonzero(known):
        found[k] = t[k] - last > PAUSE_S
        last = t[k]
    return found


def tell_wrong(t: FloatArray, error: FloatArray, wrong: BoolArray, faults: tuple[Fault, ...]) -> None:
    for k in np.flatnonzero(wrong)[:5]:
        near = min(faults, key=lambda f: abs(f.end_s - t[k]))
        before = t[:k][np.isfinite(error[:k])][-3:] - t[k]
        print(
            f"      {error[k] * 1e3:.1f} mm, {t[k] - near.end_s:+.2f} s from the end of {near.kind} of {near.target} "
            f"({near.end_s - near.start_s:.1f} s long), pairs before it at {np.round(before, 2)} s"
        )


def tell_recovery(t: FloatArray, status: NDArray[np.str_], faults: tuple[Fault, ...]) -> bool:
    """Time from a fault's end to the next position, and to the next `ok`; whether one took too long."""
    slow = 0
    for name, usable in (("position", ("ok", "degraded")), ("'ok'", ("ok",))):
        times = {}
        for fault in faults:
            after = t[(t > fault.end_s) & np.isin(status, usable)]
            times[fault] = float(after.min() - fault.end_s) if len(after) else float("inf")
        (fault, worst), values = max(times.items(), key=lambda item: item[1]), list(times.values())
        over = sum(value > RECOVERY_S for value in values)
        slow += over if name == "position" else 0
        say(
            f"recovery to {name}",
            f"median {np.median(values):.2f} s, worst {worst:.2f} s ({fault.kind} of {fault.target}, "
            f"{fault.end_s - fault.start_s:.1f} s long), over {RECOVERY_S:g} s: {over}",
        )
    return slow > 0


def check(out: Path) -> bool:
    """Whether the recording is there, readable to its end, with all stamps in order."""
    recording = Recording(out)
    images, ordered = 0, True
    for survey in recording.survey.values():
        if survey.has_header:
            ordered &= bool(np.all(np.diff(survey.header_ns) > 0))
    for sample in recording:
        images += isinstance(sample, ImageSample)
    say(
        "recording",
        f"{images} images, read to the end, stamps in order: {ordered}, notes: {recording.notes or 'none'}",
    )
    return ordered and not recording.notes


if __name__ == "__main__":
    main()
