"""Viewers of a live session: Rerun where it is installed and asked for, else the page."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from typing import Protocol

from tiptrace.errors import ConfigError
from tiptrace.snapshot import Snapshot
from tiptrace.viewers.page import PageServer

DEFAULT_PORT = 8321


class Watchable(Protocol):
    """A session that tells of every pair."""

    def subscribe(self, subscriber: Callable[[Snapshot], None]) -> Callable[[], None]:
        """Call with every snapshot, from the loop's thread; the result ends it."""
        ...


@contextmanager
def watch_live(session: Watchable, *, view: bool = False, serve: str | None = None) -> Iterator[str]:
    """Show a session while the block runs; gives the sentence that tells the user where.

    Args:
        session: Tells of every pair.
        view: Open Rerun, or the page where Rerun is not installed.
        serve: ``HOST:PORT``, ``PORT`` or ``HOST`` of the page; 127.0.0.1 unless a host is named.

    Raises:
        ConfigError: an address that is none.
        OutputError: the port is taken.
    """
    with ExitStack() as stack:
        told = []
        rerun = view and find_spec("rerun") is not None
        if serve is not None or (view and not rerun):
            host, port = parse_address(serve or "")
            page = stack.enter_context(PageServer(host, port, "live"))
            stack.callback(session.subscribe(page.show))
            told.append(f"page: {page.url}")
        if rerun:
            told.append("viewer: Rerun")
            stack.enter_context(_rerun(session))
        yield "   ".join(told)


@contextmanager
def _rerun(session: Watchable) -> Iterator[None]:
    """Log to Rerun from a thread of its own; a pair that it has no time for is left out."""
    from tiptrace.viewers.rerun_log import RerunLog

    waiting: queue.Queue[Snapshot | None] = queue.Queue(maxsize=4)
    rig = getattr(getattr(session, "stream", None), "rig", None)
    log = RerunLog("live", rig)
    log.spawn()

    def put(snapshot: Snapshot) -> None:
        with suppress(queue.Full):
            waiting.put_nowait(snapshot)

    def work() -> None:
        while (snapshot := waiting.get()) is not None:
            log.show(snapshot)

    thread = threading.Thread(target=work, name="rerun", daemon=True)
    thread.start()
    end = session.subscribe(put)
    try:
        yield
    finally:
        end()
        with suppress(queue.Full):
            waiting.put(None, timeout=1.0)
        thread.join(timeout=2.0)


def parse_address(text: str) -> tuple[str, int]:
    """``HOST:PORT``, ``PORT``, ``HOST`` or nothing → host and port.

    Raises:
        ConfigError: none of these.
    """
    host, colon, port = text.rpartition(":")
    if not colon:
        host, port = ("", text) if text.isdecimal() else (text, "")
    bare = ":" in host and not (host.startswith("[") and host.endswith("]"))  # which colon is it?
    if bare or (port and not (port.isdecimal() and int(port) < 65536)):
        raise ConfigError(f"address {text!r}: expected HOST:PORT, for example 127.0.0.1:{DEFAULT_PORT}")
    return host.strip("[]") or "127.0.0.1", int(port) if port else DEFAULT_PORT
