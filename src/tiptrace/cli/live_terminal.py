"""What ``tiptrace live`` and ``tiptrace record`` show in a terminal, and the space key."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tiptrace.calibration.gel_health import GelHealth
from tiptrace.drivers.base import DeviceHealth, DeviceStatus
from tiptrace.live.session import LiveSession
from tiptrace.live.summary import LiveSummary
from tiptrace.snapshot import Snapshot
from tiptrace.types import Phase, Status

_REFRESH_S = 0.2
_LINE_S = 1.0
_HELD_S = 0.8  # a held key is one mark: terminals wait for up to 0.7 s before they repeat it
_COLOURS = {
    Status.OK: "green",
    Status.ANCHORING: "cyan",
    Status.RELATIVE: "cyan",
    Status.DEGRADED: "yellow",
}


class Marked(Protocol):
    """A session that takes marks."""

    def advance(self) -> Phase | None:
        """The next mark."""
        ...

    def stop(self) -> None:
        """End."""
        ...


class Terminal:
    """Redraws a few lines in place, or prints a line a second where there is no terminal."""

    def __init__(self, session: LiveSession, console: Console) -> None:
        self._session, self._console = session, console
        self._snapshot: Snapshot | None = None
        session.subscribe(self._take)

    def _take(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the session while the block runs."""
        done = threading.Event()
        thread = threading.Thread(target=self._run, args=(done,), name="terminal", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join(timeout=2.0)

    def _run(self, done: threading.Event) -> None:
        if not self._console.is_terminal:
            while not done.wait(_LINE_S):
                if self._snapshot is not None:
                    self._console.print(estimate_line(self._snapshot), highlight=False, soft_wrap=True)
            return
        with Live(console=self._console, refresh_per_second=5, transient=True) as live:
            while not done.wait(_REFRESH_S):
                live.update(self._picture())

    def _picture(self) -> Group:
        parts: list[Text | Table] = []
        if self._snapshot is not None:
            parts += [estimate_line(self._snapshot), *map(_note, self._snapshot.notes)]
            if self._snapshot.advice:
                parts.insert(1, Text(self._snapshot.advice, style="cyan"))
            parts += [
                Text(f"{event.kind}: {event.detail}", style="dim") for event in self._snapshot.events[-3:]
            ]
        parts.append(device_table(self._session.stream.health()))
        step = self._session.phases.next_step
        parts.append(Text((f"space: {step}   " if step else "") + "q: stop", style="bold"))
        return Group(*parts)


def _note(sentence: str) -> Text:
    return Text(sentence, style="yellow")


def estimate_line(snapshot: Snapshot) -> Text:
    """Status, tip, uncertainty, rate and latency in a line."""
    e = snapshot.estimate
    line = Text()
    line.append(f"{e.status.value:12s}", style=_COLOURS.get(e.status, "red"))
    if e.p_B is not None:
        line.append("tip " + " ".join(f"{c * 1e3:8.2f}" for c in e.p_B) + " mm")
        if e.covariance is not None:
            sigma = [max(float(v), 0.0) ** 0.5 * 1e3 for v in e.covariance.diagonal()]
            line.append("  ± " + " ".join(f"{c:.2f}" for c in sigma))
    if snapshot.rate_hz is not None:
        line.append(f"  {snapshot.rate_hz:4.1f} Hz")
    if snapshot.latency_ms is not None:
        line.append(f"  {snapshot.latency_ms:4.0f} ms")
    if e.p_B is None and snapshot.notes:
        line.append(f"  {snapshot.notes[0]}")
    return line


def device_table(devices: dict[str, DeviceHealth]) -> Table:
    """Status, rate, jitter and faults of each device."""
    table = Table(box=None, pad_edge=False)
    for heading in ("device", "status", "rate", "jitter", "faults"):
        table.add_column(heading, style="dim" if heading == "faults" else None)
    for name, health in devices.items():
        style = "green" if health.status is DeviceStatus.OK else "yellow"
        table.add_row(
            name,
            Text(health.status.value, style=style),
            "–" if health.rate_hz is None else f"{health.rate_hz:.1f} Hz",
            "–" if health.jitter_ms is None else f"{health.jitter_ms:.1f} ms",
            ", ".join(f"{kind} {count}" for kind, count in health.faults),
        )
    return table


def print_gel_health(console: Console, health: dict[str, GelHealth | str]) -> None:
    """A line per gel."""
    for side, score in health.items():
        if isinstance(score, str):
            console.print(Text(f"{side} gel: {score}", style="yellow"))
            continue
        bad = {name: verdict for name, verdict in score.verdicts().items() if verdict != "good"}
        worst = "worn" if "worn" in bad.values() else "watch" if bad else "good"
        told = ", ".join(f"{name.replace('_', ' ')} {verdict}" for name, verdict in bad.items())
        touched = ", touched" if score.touched else ""
        style = {"good": "green", "watch": "yellow", "worn": "red"}[worst]
        console.print(
            Text(
                f"{side} gel: {worst}{touched}" + (f" ({told}; tiptrace calibrate check)" if told else ""),
                style=style,
            )
        )


def print_summary(console: Console, summary: LiveSummary) -> None:
    """What the session was."""
    console.print(f"{summary.pairs} pairs in {summary.seconds:.1f} s", highlight=False)
    if summary.latency_ms is not None:
        p50, p99, most = summary.latency_ms
        console.print(
            f"latency from the later image's arrival: p50 {p50:.1f}, p99 {p99:.1f}, max {most:.1f} ms",
            highlight=False,
        )
    for sentence in summary.sentences:
        console.print(Text(sentence, style="yellow"))
    if summary.bad_pairs:
        console.print(Text(f"pairs with images that could not be used: {summary.bad_pairs}", style="yellow"))
    for event in summary.events:
        console.print(Text(f"{event.kind}: {event.detail}", style="dim"))


@contextmanager
def keys(session: Marked) -> Iterator[None]:
    """Space marks the next phase, q and Ctrl-C end the session; nothing where no key can come."""
    if not sys.stdin.isatty() or _in_background(sys.stdin.fileno()):
        yield
        return
    import termios
    import tty

    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    done = threading.Event()
    tty.setcbreak(number)
    thread = threading.Thread(target=_listen, args=(session, done), name="keys", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(timeout=1.0)
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def _in_background(number: int) -> bool:
    """Whether the terminal belongs to another job: to change it would stop this one."""
    import os

    try:
        return os.tcgetpgrp(number) != os.getpgrp()
    except OSError:
        return False  # a terminal that controls nothing


def _listen(session: Marked, done: threading.Event) -> None:
    import os
    import select

    number, last = sys.stdin.fileno(), 0.0
    while not done.is_set():
        ready, _, _ = select.select([number], [], [], 0.2)
        if not ready:
            continue
        try:
            pressed = os.read(number, 256)  # all of it: what a buffer keeps would be taken with the next key
        except OSError:
            return  # the terminal is gone
        if not pressed:
            return
        if b"q" in pressed:
            session.stop()
        elif b" " in pressed:
            if time.monotonic() - last > _HELD_S:
                session.advance()
            last = time.monotonic()
