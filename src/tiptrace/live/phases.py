"""Marks of the trial's phases: in order, by a key, a topic or a caller."""

from __future__ import annotations

import threading
from collections.abc import Callable

from tiptrace.errors import ConfigError
from tiptrace.types import Phase

_ORDER = (Phase.ANCHORING, Phase.RECONSTRUCTION, Phase.END)
_NEXT_STEP = {
    None: "begin the anchoring",
    Phase.ANCHORING: "end the anchoring, begin the reconstruction",
    Phase.RECONSTRUCTION: "end the trial",
    Phase.END: "",
}


class PhaseMarker:
    """Remembers the phase and refuses marks in the wrong order.

    Args:
        emit: Called with each accepted mark.
        waiting: Whether the trial waits for the mark that begins the anchoring; else it begins at once and the first
            mark ends it.
    """

    def __init__(self, emit: Callable[[Phase], None], *, waiting: bool) -> None:
        self._emit = emit
        self._lock = threading.Lock()
        self._phase: Phase | None = None
        self._first = Phase.ANCHORING if waiting else Phase.RECONSTRUCTION

    @property
    def phase(self) -> Phase | None:
        """The phase marked last; None before any."""
        return self._phase

    @property
    def next_step(self) -> str:
        """What the next mark does; empty after the last."""
        return _NEXT_STEP[Phase.ANCHORING if self._unmarked else self._phase]

    @property
    def _unmarked(self) -> bool:
        return self._phase is None and self._first is Phase.RECONSTRUCTION

    def advance(self) -> Phase | None:
        """The next mark in order; None after the last."""
        with self._lock:
            following = self._first if self._phase is None else _after(self._phase)
            if following is not None:
                self._phase = following
                self._emit(following)
            return following

    def mark(self, phase: Phase) -> None:
        """A certain mark.

        Raises:
            ConfigError: not in order.
        """
        with self._lock:
            before = self._phase
            if before is not None and _ORDER.index(phase) <= _ORDER.index(before):
                raise ConfigError(
                    f"phase {phase.value!r} was marked after {before.value!r}: one trial goes through anchoring, "
                    "reconstruction and end, in this order; start another trial"
                )
            if before is None and self._first is Phase.ANCHORING and phase is not Phase.ANCHORING:
                raise ConfigError(
                    f"phase {phase.value!r} was marked before 'anchoring': mark the anchoring first"
                )
            self._phase = phase
            self._emit(phase)


def _after(phase: Phase) -> Phase | None:
    k = _ORDER.index(phase) + 1
    return _ORDER[k] if k < len(_ORDER) else None
