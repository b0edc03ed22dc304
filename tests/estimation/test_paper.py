"""The paper's estimator on synthetic rigid markers, where the truth is exact."""

import numpy as np
import pytest

from tiptrace.errors import GeometryError, PerceptionError
from tiptrace.estimation.ee_only import EeOnlyEstimator
from tiptrace.estimation.paper import PaperEstimator
from tiptrace.geometry.transforms import apply, invert, rotation_exp, transform
from tiptrace.types import FingerMarkers, FloatArray, Phase, SensedFinger, SensedPair, Status, TipEstimate

TIP = np.array([0.40, -0.10, 0.02])  # the fixed point, F_B
DOWN = np.diag([1.0, -1.0, -1.0])  # F_E's z points down
T_E_LEFT = transform(np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]), [0.003, 0, 0.14])
T_E_RIGHT = transform(np.array([[0, 0, 1.0], [0, -1, 0], [1, 0, 0]]), [-0.003, 0, 0.14])


class Grasp:
    """Markers that move rigidly with a tool whose tip is known; hand and tool move independently."""

    def __init__(self, seed: int = 0, count: int = 20) -> None:
        rng = np.random.default_rng(seed)
        T_B_E = transform(DOWN, TIP + [0, 0, 0.2])
        self.x_T = {}  # markers in tool coordinates: base coordinates relative to the tip at frame 0
        for side, T_E_S in (("left", T_E_LEFT), ("right", T_E_RIGHT)):
            x_S = np.column_stack([rng.uniform(-8e-3, 8e-3, (count, 2)), -rng.uniform(2e-4, 1e-3, count)])
            self.x_T[side] = apply(T_B_E @ T_E_S, x_S) - TIP

    def pair(
        self, k: int, phase: Phase | None, w: FloatArray, tip: FloatArray, hand: FloatArray, lost: int = 0
    ) -> SensedPair:
        T_B_E = transform(rotation_exp(hand) @ DOWN, TIP + [0, 0, 0.2])
        fingers = {}
        for side, T_E_S in (("left", T_E_LEFT), ("right", T_E_RIGHT)):
            x_B = self.x_T[side] @ rotation_exp(w).T + tip
            x_S = apply(invert(T_B_E @ T_E_S), x_B)
            tracked = np.arange(len(x_S)) >= lost
            x_S[~tracked] = np.nan
            fingers[side] = SensedFinger(FingerMarkers(x_S, tracked), T_B_E, T_E_S)
        return SensedPair(k * 40_000_000, phase, fingers["left"], fingers["right"])


def rotations(n: int) -> FloatArray:
    s = np.linspace(0, 2 * np.pi, n)
    return 0.08 * np.column_stack([np.sin(s), np.sin(2 * s), 0.3 * np.sin(s)])


def anchor(estimator: PaperEstimator | EeOnlyEstimator, grasp: Grasp, n: int = 50) -> list[TipEstimate]:
    return [
        estimator.update(grasp.pair(k, Phase.ANCHORING, w, TIP, hand=0.5 * w))
        for k, w in enumerate(rotations(n))
    ]


def test_exact_fixed_point_and_propagation_to_a_micrometre() -> None:
    grasp, estimator = Grasp(), PaperEstimator()
    rows = anchor(estimator, grasp)
    assert {row.status for row in rows} == {Status.ANCHORING}
    assert rows[0].p_B is None  # nothing has rotated yet: no position is claimed
    assert estimator.anchor is not None
    np.testing.assert_allclose(estimator.anchor.p_B, TIP, atol=1e-6)
    for k in range(100):
        tip = TIP + [0.002 * k, 0.004 * np.sin(0.2 * k), 0]
        w = 0.05 * np.array([np.sin(0.1 * k), np.cos(0.1 * k), 0.2])
        row = estimator.update(grasp.pair(50 + k, Phase.RECONSTRUCTION, w, tip, hand=-w))
        assert row.status is Status.OK
        assert row.markers == 16
        np.testing.assert_allclose(row.p_B, tip, atol=1e-6)


def test_eight_markers_after_the_three_deepest() -> None:
    grasp, estimator = Grasp(), PaperEstimator()
    first = grasp.pair(0, Phase.ANCHORING, np.zeros(3), TIP, np.zeros(3))
    estimator.update(first)
    depth = -first.left.markers.x_S[:, 2]
    order = np.argsort(-depth)
    assert sorted(order[3:11]) == estimator.chosen["left"].tolist()


def test_frame_0_waits_for_eleven_markers_per_sensor() -> None:
    grasp, estimator = Grasp(), PaperEstimator()
    assert (
        estimator.update(grasp.pair(0, Phase.ANCHORING, np.zeros(3), TIP, np.zeros(3), lost=10)).status
        is Status.LOST
    )
    assert estimator.chosen == {}
    assert (
        estimator.update(grasp.pair(1, Phase.ANCHORING, np.zeros(3), TIP, np.zeros(3), lost=9)).status
        is not Status.LOST
    )


def test_lost_markers_drop_out_and_fewer_than_three_is_lost() -> None:
    grasp, estimator = Grasp(), PaperEstimator()
    anchor(estimator, grasp)
    row = estimator.update(grasp.pair(60, Phase.RECONSTRUCTION, np.zeros(3), TIP, np.zeros(3), lost=8))
    assert 3 <= row.markers < 16
    np.testing.assert_allclose(row.p_B, TIP, atol=1e-6)
    row = estimator.update(grasp.pair(61, Phase.RECONSTRUCTION, np.zeros(3), TIP, np.zeros(3), lost=20))
    assert row.status is Status.LOST
    assert row.p_B is None


def test_one_axis_leaves_the_anchor_refused() -> None:
    grasp, estimator = Grasp(), PaperEstimator()
    for k in range(40):
        w = np.array([0, 0.1 * np.sin(0.2 * k), 0])
        row = estimator.update(grasp.pair(k, Phase.ANCHORING, w, TIP, w))
        assert row.p_B is None
    row = estimator.update(grasp.pair(40, Phase.RECONSTRUCTION, np.zeros(3), TIP, np.zeros(3)))
    assert row.status is Status.UNOBSERVABLE
    assert row.p_B is None
    assert [event.kind for event in estimator.events] == ["anchor-refused"]


def test_no_anchoring_frames_and_open_grasp_are_errors() -> None:
    with pytest.raises(GeometryError, match="without any anchoring frame"):
        PaperEstimator().update(Grasp().pair(0, Phase.RECONSTRUCTION, np.zeros(3), TIP, np.zeros(3)))
    open_grasp = Grasp()
    open_grasp.x_T["left"] = open_grasp.x_T["left"] - [0.002, 0, 0]  # markers 2 mm out of the gel: untouched
    with pytest.raises(PerceptionError, match="left gel shows no indentation"):
        PaperEstimator().update(open_grasp.pair(0, Phase.ANCHORING, np.zeros(3), TIP, np.zeros(3)))


def test_ee_only_shares_the_anchor_and_follows_the_hand() -> None:
    grasp, estimator = Grasp(), EeOnlyEstimator(PaperEstimator())
    anchor(estimator, grasp)
    assert estimator.anchor is not None
    hand = np.array([0, 0, 0.3])
    row = estimator.update(grasp.pair(60, Phase.RECONSTRUCTION, np.zeros(3), TIP, hand))
    R = rotation_exp(hand)
    last_hand = rotation_exp(0.5 * rotations(50)[-1])
    origin = TIP + [0, 0, 0.2]
    expected = R @ last_hand.T @ (TIP - origin) + origin
    np.testing.assert_allclose(row.p_B, expected, atol=1e-6)
