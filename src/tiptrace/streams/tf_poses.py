"""T_B_E from TF messages: collects the links, finds the chain, composes it in time."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tiptrace.errors import GeometryError, RecordingError
from tiptrace.geometry.screw import interpolate_screw
from tiptrace.geometry.transforms import invert, rotation_from_quaternion, transform
from tiptrace.streams.checks import MAX_DISAGREEMENT_S
from tiptrace.streams.mapping import TfChain
from tiptrace.streams.raw_messages import MessageSource, RawMessage
from tiptrace.streams.survey import Stamps_ns
from tiptrace.streams.topics import NS
from tiptrace.types import FloatArray, PoseSample

TF_TYPE = "tf2_msgs/msg/TFMessage"
_REACH_M = 3.0
_MAX_GAP_NS = round(0.2 * NS)  # between samples of one link nothing is interpolated beyond this


@dataclass(slots=True)
class _Link:
    """Samples of one parent → child transform: stamps and x, y, z, qx, qy, qz, qw."""

    parent: str
    child: str
    static: bool
    header_ns: array[int] = field(default_factory=lambda: array("q"))
    log_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))


class TfPoses:
    """Collects TF messages and composes chains of their links.

    Args:
        source: Decodes the messages.
    """

    def __init__(self, source: MessageSource) -> None:
        self._source = source
        self._where = f"{source.path}: TF"
        self._links: dict[str, _Link] = {}  # by child: a frame has one parent

    @property
    def frames(self) -> list[str]:
        """All frames seen, sorted."""
        return sorted({name for link in self._links.values() for name in (link.parent, link.child)})

    def add(self, raw: RawMessage) -> None:
        """Take a message.

        Raises:
            RecordingError: it is of another type.
        """
        if raw.type != TF_TYPE:
            raise RecordingError(f"{self._where}: {raw.topic}: type is {raw.type}, expected {TF_TYPE}")
        for item in self._source.decode(raw).transforms:
            self._add_transform(item, raw)

    def _add_transform(self, item: Any, raw: RawMessage) -> None:
        parent, child = item.header.frame_id.strip("/"), item.child_frame_id.strip("/")
        link = self._links.get(child)
        if link is None or link.parent != parent:
            link = self._links[child] = _Link(parent, child, static=raw.topic.endswith("static"))
        stamp, p, q = item.header.stamp, item.transform.translation, item.transform.rotation
        link.header_ns.append(stamp.sec * NS + stamp.nanosec)
        link.log_ns.append(raw.log_time_ns)
        link.values.extend((p.x, p.y, p.z, q.x, q.y, q.z, q.w))

    def connects(self, base: str, end_effector: str) -> bool:
        """Whether there is a chain between two frames in which something moves."""
        try:
            return bool(self._moving(TfChain(base=base, end_effector=end_effector)))
        except RecordingError:
            return False

    def poses(self, chain: TfChain, use_log: bool, *, trust_header: bool = False) -> list[PoseSample]:
        """T_B_E at the stamps of the chain's fastest link, in order.

        Args:
            chain: Which frames.
            use_log: Whether the recorder's clock dates the links, and not their headers.
            trust_header: Whether headers are used even where they differ from the recorder's clock.

        Raises:
            RecordingError: no such frames, no connection between them, nothing moves, or values that cannot be
                meant; the clocks disagree and neither was chosen.
        """
        moving = self._moving(chain)
        if not use_log and not trust_header:
            self._check_clock(moving)
        up, down = self._branches(chain)
        times = np.unique(_stamps(max(moving, key=lambda link: len(link.log_ns)), use_log))
        T_up, known_up = self._compose(up, times, use_log)
        T_down, known_down = self._compose(down, times, use_log)
        T_B_E = invert(T_up) @ T_down  # (n, 4, 4)
        keep = known_up & known_down
        return [PoseSample(int(t), T) for t, T, k in zip(times, T_B_E, keep, strict=True) if k]

    def _branches(self, chain: TfChain) -> tuple[list[_Link], list[_Link]]:
        """Links from the base and from the end effector up to where they meet."""
        up, down = self._path(chain.base), self._path(chain.end_effector)
        while up and down and up[-1] is down[-1]:  # the common way to the root
            up.pop()
            down.pop()
        root_base = up[-1].parent if up else chain.base.strip("/")
        root_tool = down[-1].parent if down else chain.end_effector.strip("/")
        if root_base != root_tool:
            raise RecordingError(
                f"{self._where}: {chain.base!r} and {chain.end_effector!r} are not connected; record /tf_static "
                "too, or choose other frames in the map file"
            )
        return up, down

    def _moving(self, chain: TfChain) -> list[_Link]:
        """The links of a chain that are not static."""
        up, down = self._branches(chain)
        moving = [link for link in (*up, *down) if not link.static]
        if not moving:
            raise RecordingError(
                f"{self._where}: nothing moves between {chain.base!r} and {chain.end_effector!r}; choose the "
                "robot's base and its flange or tool frame"
            )
        return moving

    def _path(self, frame: str) -> list[_Link]:
        """Links from a frame up to the root."""
        name, path = frame.strip("/"), []
        if name not in self.frames:
            there = ", ".join(self.frames) or "none"
            raise RecordingError(f"{self._where}: there is no frame {frame!r}; frames there: {there}")
        while name in self._links:
            link = self._links[name]
            if link in path:
                raise RecordingError(
                    f"{self._where}: the frames form a loop at {name!r}; remove one publisher"
                )
            path.append(link)
            name = link.parent
        return path

    def _check_clock(self, moving: list[_Link]) -> None:
        for link in moving:
            difference = np.array(link.header_ns, dtype=np.int64) - np.array(link.log_ns, dtype=np.int64)
            worst_s = float(difference[np.argmax(np.abs(difference))]) / NS
            if abs(worst_s) > MAX_DISAGREEMENT_S:
                raise RecordingError(
                    f"{self._where}: header stamps of {link.child!r} differ from the recorder's clock by "
                    f"{worst_s:.1f} s; say which to use with --stamps header or --stamps log"
                )

    def _compose(self, path: list[_Link], times: Stamps_ns, use_log: bool) -> tuple[FloatArray, np.ndarray]:
        """Product of a path's links from the root to its frame: (n, 4, 4), and where all are known, (n,)."""
        T = np.broadcast_to(np.eye(4), (len(times), 4, 4))
        known = np.ones(len(times), dtype=bool)
        for link in reversed(path):
            T_link, link_known = self._at(link, times, use_log)
            T, known = T @ T_link, known & link_known
        return T, known

    def _at(self, link: _Link, times: Stamps_ns, use_log: bool) -> tuple[FloatArray, np.ndarray]:
        """One link at the given times."""
        values = np.array(link.values).reshape(-1, 7)
        if np.max(np.abs(values[:, :3])) > _REACH_M:
            raise RecordingError(
                f"{self._where}: {link.parent!r} to {link.child!r} is longer than {_REACH_M:g} m: it looks like "
                "millimetres; publish metres"
            )
        try:
            T = transform(rotation_from_quaternion(values[:, 3:]), values[:, :3])
        except GeometryError as error:
            raise RecordingError(f"{self._where}: {link.parent!r} to {link.child!r}: {error}") from None
        if link.static:
            return np.broadcast_to(T[-1], (len(times), 4, 4)), np.ones(len(times), dtype=bool)
        stamps, first = np.unique(_stamps(link, use_log), return_index=True)
        T = T[first]
        after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
        if len(stamps) == 1:
            return np.broadcast_to(T[0], (len(times), 4, 4)), times == stamps[0]
        span = stamps[after] - stamps[after - 1]
        fraction = (times - stamps[after - 1]) / span
        exact = np.isin(times, stamps)
        known = exact | ((fraction >= 0) & (fraction <= 1) & (span <= _MAX_GAP_NS))
        return interpolate_screw(T[after - 1], T[after], np.clip(fraction, 0, 1)), known


def _stamps(link: _Link, use_log: bool) -> Stamps_ns:
    return np.array(link.log_ns if use_log else link.header_ns, dtype=np.int64)
