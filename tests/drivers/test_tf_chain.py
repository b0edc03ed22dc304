"""TF chains: composed as they come, at the newest instant that every moving link has reached."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tiptrace.drivers.ros2 import listen_to_tf
from tiptrace.drivers.tf_chain import TfChain, Transform
from tiptrace.geometry.transforms import invert, rotation_exp, transform
from tiptrace.types import FloatArray

MS = 1_000_000


def pose(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))


def link(parent: str, child: str, T: FloatArray, stamp_ns: int = 0) -> Transform:
    return Transform(parent, child, stamp_ns, T)


def test_links_up_and_down_a_tree_are_composed() -> None:
    """World to base and table; base to flange to tool: a robot that is not at the root."""
    chain = TfChain("/base", "tool0")
    world, flange, tool = pose(1), pose(2), pose(3)
    static = [link("world", "base", world), link("flange", "tool0", tool), link("world", "table", pose(4))]
    assert chain.add(static, static=True) is None
    found = chain.add([link("base", "flange", flange, 5 * MS)])
    assert found is not None
    assert found[0] == 5 * MS
    np.testing.assert_allclose(found[1], flange @ tool, atol=1e-12)
    turned = TfChain("tool0", "table")
    turned.add(static, static=True)
    back = turned.add([link("base", "flange", flange, 5 * MS)])
    assert back is not None
    np.testing.assert_allclose(
        back[1], invert(world @ flange @ tool) @ world @ invert(world) @ pose(4), atol=1e-12
    )


def test_two_moving_links_are_taken_at_the_older_of_their_newest_stamps() -> None:
    chain = TfChain("a", "c")
    T_1, T_2, T_3 = (transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 0.1, 0.3))
    assert chain.add([link("a", "b", T_1, 0)]) is None
    assert chain.add([link("b", "c", T_1, 5 * MS)]) is None, "the first link is not known at that instant"
    found = chain.add([link("a", "b", T_2, 10 * MS)])
    assert found is not None
    assert found[0] == 5 * MS
    assert found[1][0, 3] == pytest.approx(0.05)
    assert chain.add([link("a", "b", T_3, 20 * MS)]) is None, (
        "nothing newer: the second link has not moved on"
    )
    found = chain.add([link("b", "c", T_1, 15 * MS)])
    assert found is not None
    assert found[1][0, 3] == pytest.approx(0.2)


def test_no_pose_across_a_gap_without_a_way_or_in_a_loop() -> None:
    chain = TfChain("a", "c")
    T = np.eye(4)
    chain.add([link("a", "b", T, 0)])
    chain.add([link("b", "c", T, 200 * MS)])
    assert chain.add([link("a", "b", T, 400 * MS)]) is None, "0.4 s between two samples"
    assert TfChain("a", "z").add([link("a", "b", T, 1)]) is None
    loop = TfChain("a", "c")
    assert loop.add([link("a", "b", T, 1), link("b", "a", T, 1), link("a", "c", T, 1)]) is None
    still = TfChain("a", "b")
    assert still.add([link("a", "b", T, 0)], static=True) is None, "nothing moves"


def test_stamps_out_of_order_are_left_out_and_a_bag_that_loops_begins_anew() -> None:
    chain = TfChain("a", "b")
    stamps = [10, 30, 20, 30, 40, 5000, 10, 20]
    found = [chain.add([link("a", "b", np.eye(4), s * MS)]) for s in stamps]
    assert [f[0] // MS for f in found if f] == [10, 30, 40, 5000, 10, 20]


class Node:
    """Keeps what is subscribed."""

    def __init__(self) -> None:
        self.takes: dict[str, Any] = {}
        self.qos: dict[str, Any] = {}

    def create_subscription(self, kind: Any, topic: str, take: Any, qos: Any) -> None:
        self.takes[topic], self.qos[topic] = take, qos


def message(parent: str, child: str, T: FloatArray, stamp_ns: int, w: float = 1.0) -> Any:
    x, y, z = T[:3, 3]
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    item = SimpleNamespace(
        header=SimpleNamespace(frame_id=parent, stamp=stamp),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=x, y=y, z=z), rotation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=w)
        ),
    )
    return SimpleNamespace(transforms=[item])


def test_messages_become_poses_and_static_ones_are_asked_for_from_the_past(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    qos = ModuleType("rclpy.qos")
    policy = SimpleNamespace(BEST_EFFORT="best effort", TRANSIENT_LOCAL="transient local")
    vars(qos).update(
        QoSProfile=lambda **settings: settings, ReliabilityPolicy=policy, DurabilityPolicy=policy
    )
    messages = ModuleType("tf2_msgs.msg")
    vars(messages)["TFMessage"] = object
    monkeypatch.setitem(sys.modules, "rclpy.qos", qos)
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", messages)
    node, found = Node(), []
    listen_to_tf(node, "base", "tool0", lambda stamp, T: found.append((stamp, T)))
    assert node.qos["/tf"]["reliability"] == "best effort"
    assert node.qos["/tf_static"]["durability"] == "transient local"
    shift = transform(np.eye(3), np.array([0.0, 0.0, 0.1]))
    node.takes["/tf_static"](message("flange", "tool0", shift, 0))
    node.takes["/tf"](message("base", "flange", shift, 3 * 10**9 + 7))
    node.takes["/tf"](message("base", "flange", shift, 3 * 10**9 + 8, w=float("nan")))
    assert found[0][0] == 3 * 10**9 + 7
    assert found[0][1][2, 3] == pytest.approx(0.2)
    assert found[1] == (0, None)
