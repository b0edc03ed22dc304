"""T_B_E by composing a chain of transforms as they come, one message after the other."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tiptrace.drivers.timeline import NS
from tiptrace.geometry.screw import interpolate_screw
from tiptrace.geometry.transforms import invert
from tiptrace.types import FloatArray

_MEMORY = 256  # samples of a link
_MAX_GAP_NS = round(0.2 * NS)  # between samples of one link nothing is interpolated beyond this
_BACK_NS = NS  # stamps that go back by more begin anew: a bag that loops


@dataclass(frozen=True, slots=True)
class Transform:
    """One transform: ``p_parent = T @ p_child``, (4, 4), stamped in ns."""

    parent: str
    child: str
    stamp_ns: int
    T: FloatArray


@dataclass(slots=True)
class _Link:
    """Samples of one parent → child transform, in order."""

    parent: str
    static: bool
    stamps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_MEMORY))
    T: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=_MEMORY))

    def add(self, stamp_ns: int, T: FloatArray) -> None:
        if self.stamps_ns and stamp_ns < self.stamps_ns[-1] - _BACK_NS:
            self.stamps_ns.clear()
            self.T.clear()
        if self.static or not self.stamps_ns or stamp_ns > self.stamps_ns[-1]:
            self.stamps_ns.append(stamp_ns)
            self.T.append(T)

    def at(self, stamp_ns: int) -> FloatArray | None:
        """(4, 4) at an instant; None where it is not known."""
        if self.static:
            return self.T[-1]
        k = bisect_left(self.stamps_ns, stamp_ns)
        if k == len(self.stamps_ns):
            return None
        if self.stamps_ns[k] == stamp_ns:
            return self.T[k]
        if k == 0 or self.stamps_ns[k] - self.stamps_ns[k - 1] > _MAX_GAP_NS:
            return None
        fraction = (stamp_ns - self.stamps_ns[k - 1]) / (self.stamps_ns[k] - self.stamps_ns[k - 1])
        found: FloatArray = interpolate_screw(self.T[k - 1][None], self.T[k][None], np.array([fraction]))[0]
        return found


class TfChain:
    """What ``tf2_ros`` would look up at each message: T_B_E at the newest instant that all moving links have reached.

    Args:
        base: Frame B.
        end_effector: Frame E.
    """

    def __init__(self, base: str, end_effector: str) -> None:
        self._base, self._end_effector = base.strip("/"), end_effector.strip("/")
        self._links: dict[str, _Link] = {}  # by child: a frame has one parent
        self._last_ns: int | None = None

    def add(self, transforms: Iterable[Transform], *, static: bool = False) -> tuple[int, FloatArray] | None:
        """Take a message; stamp (ns) and T_B_E where that gives a newer one."""
        for item in transforms:
            parent, child = item.parent.strip("/"), item.child.strip("/")
            link = self._links.get(child)
            if link is None or link.parent != parent or link.static != static:
                link = self._links[child] = _Link(parent, static)
            link.add(item.stamp_ns, item.T)
        return self._newest()

    def _newest(self) -> tuple[int, FloatArray] | None:
        base, tool = self._to_root(self._base), self._to_root(self._end_effector)
        if base is None or tool is None:
            return None
        while base and tool and base[-1] is tool[-1]:  # the common way to the root
            base.pop()
            tool.pop()
        if _root(base, self._base) != _root(tool, self._end_effector):
            return None
        moving = [link.stamps_ns[-1] for link in (*base, *tool) if not link.static]
        if not moving:
            return None
        stamp_ns = min(moving)
        if self._last_ns is not None and self._last_ns - _BACK_NS <= stamp_ns <= self._last_ns:
            return None
        T_base, T_tool = _product(base, stamp_ns), _product(tool, stamp_ns)
        if T_base is None or T_tool is None:
            return None
        self._last_ns = stamp_ns
        return stamp_ns, invert(T_base) @ T_tool

    def _to_root(self, frame: str) -> list[_Link] | None:
        """Links from a frame up to the root; None for a loop."""
        path: list[_Link] = []
        while frame in self._links:
            link = self._links[frame]
            if len(path) > len(self._links):
                return None
            path.append(link)
            frame = link.parent
        return path


def _root(path: list[_Link], frame: str) -> str:
    return path[-1].parent if path else frame


def _product(path: list[_Link], stamp_ns: int) -> FloatArray | None:
    """Product of a path's links from its root to its frame, (4, 4); None where one is not known."""
    T: FloatArray = np.eye(4)
    for link in reversed(path):
        T_link = link.at(stamp_ns)
        if T_link is None:
            return None
        T = T @ T_link
    return T
