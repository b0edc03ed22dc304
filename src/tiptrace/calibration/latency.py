"""Camera-to-robot latency from a motion with the tip at rest (``docs/calibration.md``, Latency).

While the tip rests, the motion in the grasp follows the hand's at once. The latency is the delay at which a linear
map from the one to the other fits best: Stage I's own solve, with the map and the latency let free. Poses are smoothed
before they are interpolated: linear interpolation of noisy poses is best half way between samples and draws the delay
there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tiptrace.config import Rig, Sensors
from tiptrace.errors import CalibrationError, GeometryError
from tiptrace.estimation.motion import MotionConfig
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.patch import PatchConfig
from tiptrace.estimation.phases import PhaseConfig, PhaseDetector
from tiptrace.estimation.stage_one import Anchoring, StageOne, StageOneConfig
from tiptrace.estimation.tip_map_config import TipMapConfig
from tiptrace.types import Phase, SensedPair

_PRIOR_S = (0.05, 0.15)  # mean and σ: says next to nothing
_MAP = TipMapConfig(map_sigma=0.3, map_off_diagonal_sigma=0.15, latency_gate_s=1.0)
_HALF_WIDTH_S = 0.05
_FEWEST = 50
_VAGUE_S = 0.010
_RESTLESS_M = 5e-4
_MODEL_S = 5e-4  # what friction and creep of the grasp leave


@dataclass(frozen=True, slots=True)
class LatencyCalibration:
    """Result.

    Attributes:
        latency_s: Capture stamp minus exposure, of both cameras alike.
        std_s: Its standard deviation.
        frames: Pairs with the tip at rest.
        residual_m: Root mean square of what the map leaves.
        halves_s: The same from the first and the second half of the motion.
    """

    latency_s: float
    std_s: float
    frames: int
    residual_m: float
    halves_s: tuple[float, float]


def calibrate_latency(pairs: Iterable[SensedPair]) -> LatencyCalibration:
    """Latency from the pairs in which the tip rests: the phase ``anchoring``, or as found from the hand's motion.

    Raises:
        CalibrationError: too few pairs, a hand that does not move enough, or a tip that does not rest.
    """
    resting = _resting(pairs)
    if len(resting) < _FEWEST:
        raise CalibrationError(
            f"{len(resting)} pairs with the tip at rest, at least {_FEWEST} are needed: rest the tip in a pit and turn "
            "the hand about it for a few seconds (`tiptrace plan-anchor` proposes how)"
        )
    whole = _solve(resting)
    middle = len(resting) // 2
    halves = tuple(_solve(part).tip_map.latency_s for part in (resting[:middle], resting[middle:]))
    std_s = float(np.hypot(np.sqrt(whole.tip_map.covariance[15, 15]), _MODEL_S))
    std_s = max(std_s, 0.35 * abs(halves[1] - halves[0]))  # halves that differ are worth that much
    if whole.tip_map.residual_m > _RESTLESS_M:
        raise CalibrationError(
            f"the tip does not rest: it moves by {whole.tip_map.residual_m * 1e3:.1f} mm rms against the hand; "
            "use a pit, and enough contact force"
        )
    if std_s > _VAGUE_S:
        raise CalibrationError(
            f"the latency is known only to {std_s * 1e3:.0f} ms: move the hand faster or for longer while the tip rests"
        )
    return LatencyCalibration(
        whole.tip_map.latency_s, std_s, len(resting), whole.tip_map.residual_m, (halves[0], halves[1])
    )


def rig_with_latency(rig: Rig, result: LatencyCalibration) -> Rig:
    """The rig with the latency of both sensors; everything else stays."""
    update = {"latency_s": result.latency_s, "latency_std_s": result.std_s}
    left, right = (rig.sensor(side).model_copy(update=update) for side in ("left", "right"))
    return rig.model_copy(update={"sensors": Sensors(left=left, right=right)})


def _resting(pairs: Iterable[SensedPair]) -> list[SensedPair]:
    detector, found, marked = PhaseDetector(PhaseConfig()), [], False
    for pair in pairs:
        marked |= pair.phase is not None
        phase = pair.phase or (Phase.END if marked else detector.update(pair.stamp_ns, pair.left.T_B_E))
        if phase is Phase.ANCHORING:
            found.append(pair)
    end = detector.end_ns
    return found if end is None else [p for p in found if p.stamp_ns <= end]


def _solve(pairs: list[SensedPair]) -> Anchoring:
    stage = StageOne(StageOneConfig(), PatchConfig(), MotionConfig(), _MAP, _HALF_WIDTH_S)
    for pair in pairs:
        stage.add_poses(pair.poses)
        stage.add(pair.stamp_ns, PadMarkers.of(pair))
    try:
        return stage.solve(_PRIOR_S, None)
    except (GeometryError, np.linalg.LinAlgError) as error:
        raise CalibrationError(f"the latency cannot be found: {error}") from None
