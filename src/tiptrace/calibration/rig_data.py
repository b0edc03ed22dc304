"""What a calibration wiggle gives: markers of both fingers over time, and the hand's pose at any instant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tiptrace.errors import CalibrationError
from tiptrace.estimation.pose_track import HandStates, smooth_at
from tiptrace.geometry.transforms import rotation_log
from tiptrace.types import SIDES, BoolArray, FloatArray, IntArray, Observation, PoseSample, SensedPair, Side

_HALF_WIDTHS_S = (0.05, 0.15)  # poses are smoothed over this before they are interpolated; see _half_width
_SLOWLY = 0.35  # phase of the wiggle that one half width spans: a quadratic follows that to 0.02 %
_MOST_FRAMES = 500  # more are thinned out evenly
_FEWEST_FRAMES, _FEWEST_CORE = 50, 6
_CORE = 0.75  # share of the deep markers' indentation from which a marker rides on the rod
_CORE_STEADY = 1.5  # its motion over the median one's
_FLAT_M = 1e-5  # less change of depth than this in the whole recording: it was not measured


@dataclass(frozen=True, slots=True)
class PadTrack:
    """Markers of one finger that ride on the rod.

    Attributes:
        stamps_ns: (T,) capture times.
        w: (T, N, 3) measured in F_S with the scale that the rig states, m; NaN where lost.
        has_depth: Whether depth was measured.
        shift_E: (3,) how far the pads stand from where T_E_S holds, by the gripper's opening, m.
        rest: (M, 2) mean places of all markers in F_S, m, for the pitch.
        untouched: Whether ``rest`` is of the untouched gel.
    """

    stamps_ns: FloatArray
    w: FloatArray
    has_depth: bool
    shift_E: FloatArray
    rest: FloatArray
    untouched: bool


@dataclass(frozen=True, slots=True)
class HandTrack:
    """The hand's poses.

    Attributes:
        stamps_ns: (K,).
        T_B_E: (K, 4, 4).
        sigma_m: Noise of a pose's position per axis, after smoothing.
        sigma_rad: Noise of its orientation per axis, after smoothing.
        half_s: Half width of the smoothing.
    """

    stamps_ns: FloatArray
    T_B_E: FloatArray
    sigma_m: float
    sigma_rad: float
    half_s: float

    @classmethod
    def of(cls, poses: list[PoseSample]) -> HandTrack:
        """From the samples, in order; measures their noise against their own smoothing.

        Raises:
            CalibrationError: too few poses.
        """
        stamps = np.array([p.stamp_ns for p in poses], dtype=np.float64)
        T = np.array([p.T_B_E for p in poses])
        kept = np.concatenate([[True], np.diff(stamps) > 0]) if len(stamps) else np.zeros(0, dtype=bool)
        stamps, T = stamps[kept], T[kept]
        if len(stamps) < 20:
            raise CalibrationError(
                f"the recording has {len(stamps)} end-effector poses, too few to calibrate"
            )
        half_s = _half_width(stamps, T)
        smooth = smooth_at(stamps, T, stamps, half_s).T_B_E
        own, left = _shares(float(np.median(np.diff(stamps))) * 1e-9, half_s)
        moved = (T[:, :3, 3] - smooth[:, :3, 3])[5:-5]
        turned = rotation_log(np.swapaxes(smooth[:, :3, :3], 1, 2) @ T[:, :3, :3])[5:-5]
        scale = np.sqrt(left / max(1.0 - 2.0 * own + left, 1e-6))
        return cls(stamps, T, max(_spread(moved) * scale, 1e-7), max(_spread(turned) * scale, 1e-7), half_s)

    def at(self, stamps_ns: FloatArray) -> HandStates:
        """Smoothed hand at instants (T,), ns."""
        return smooth_at(self.stamps_ns, self.T_B_E, stamps_ns, self.half_s)


def _half_width(stamps_ns: FloatArray, T_B_E: FloatArray) -> float:
    """Half width of the smoothing, s: as wide as the wiggle is slow.

    What is left of the noise after smoothing depends a little on where between two samples it is read. All exposures
    lie alike between samples, so that a latency found by the best fit is drawn to where the noise is least: by up to
    7 ms with 0.05 s, by about 1 ms with 0.15 s.
    """
    least, most = _HALF_WIDTHS_S
    states = smooth_at(stamps_ns, T_B_E, stamps_ns[:: max(1, len(stamps_ns) // 500)], least)
    turned = rotation_log(states.T_B_E[0, :3, :3].T @ states.T_B_E[:, :3, :3])
    spread = np.sqrt(np.mean(np.var(turned, axis=0)))
    rate = np.sqrt(np.mean(np.var(states.rate_E, axis=0)))
    return float(np.clip(_SLOWLY * spread / max(rate, 1e-9), least, most))


def _shares(spacing_s: float, half_s: float) -> tuple[float, float]:
    """Weight of a sample in its own smoothed value, and the smoothed value's variance over the sample's."""
    half = max(half_s, 2.5 * spacing_s)
    n = int(np.ceil(half / spacing_s))
    x = np.arange(-n, n + 1) * spacing_s / half
    weight = np.clip(1.0 - x * x, 1e-6, None)
    V = np.stack([np.ones_like(x), x, x * x], axis=1)
    row = np.linalg.solve((V * weight[:, None]).T @ V, (V * weight[:, None]).T)[0]
    return float(row[n]), float(row @ row)


def _spread(x: FloatArray) -> float:
    """Standard deviation per axis, deaf to outliers."""
    return float(1.48 * np.median(np.abs(x - np.median(x, axis=0))))


@dataclass(frozen=True, slots=True)
class Segment:
    """One wiggle: both fingers and the hand."""

    pads: dict[Side, PadTrack]
    hand: HandTrack


@dataclass(slots=True)
class WiggleCollector:
    """Takes in a recording, pair by pair."""

    name: str
    _stamps: dict[Side, list[int]] = field(default_factory=lambda: {"left": [], "right": []})
    _x_S: dict[Side, list[FloatArray]] = field(default_factory=lambda: {"left": [], "right": []})
    _T_E_S: dict[Side, list[FloatArray]] = field(default_factory=lambda: {"left": [], "right": []})
    _poses: list[PoseSample] = field(default_factory=list)

    def add(self, observation: Observation, sensed: SensedPair) -> None:
        """One pair with its markers."""
        self._poses.extend(observation.poses)
        for side in SIDES:
            finger = sensed.finger(side)
            self._stamps[side].append(observation.finger(side).sample.stamp_ns)
            self._x_S[side].append(np.where(finger.markers.tracked[:, None], finger.markers.x_S, np.nan))
            self._T_E_S[side].append(finger.T_E_S[:3, 3])

    def segment(
        self, places_E: dict[Side, FloatArray], untouched: dict[Side, FloatArray] | None = None
    ) -> Segment:
        """The whole recording.

        Args:
            places_E: (3,) translation of T_E_S of each side as the rig states it.
            untouched: (M, 2) dots of the untouched gel in F_S, m, where there is an image of it.

        Raises:
            CalibrationError: too short, too few markers on the rod.
        """
        n = len(self._stamps["left"])
        if n < _FEWEST_FRAMES:
            raise CalibrationError(
                f"{self.name}: {n} image pairs with a pose; a calibration wiggle needs at least {_FEWEST_FRAMES}"
            )
        pads: dict[Side, PadTrack] = {
            side: self._pad(side, places_E[side], (untouched or {}).get(side)) for side in SIDES
        }
        return Segment(pads, HandTrack.of(self._poses))

    def _pad(self, side: Side, place_E: FloatArray, untouched: FloatArray | None) -> PadTrack:
        step = -(-len(self._stamps[side]) // _MOST_FRAMES)
        stamps = np.array(self._stamps[side][::step], dtype=np.float64)
        w = np.stack(self._x_S[side][::step])  # (T, N, 3)
        core = core_markers(w)
        if len(core) < _FEWEST_CORE:
            raise CalibrationError(
                f"{self.name}: only {len(core)} markers of the {side} finger ride on the rod (at least "
                f"{_FEWEST_CORE} are needed): hold a wider rod, press deeper, or check that the gel is touched"
            )
        depth = w[:, core, 2]
        has_depth = bool(np.nanmedian(np.nanstd(depth, axis=0)) > _FLAT_M)
        rest = np.nanmean(w[:, core, :2], axis=0) if untouched is None else untouched
        shift = np.mean(self._T_E_S[side], axis=0) - place_E
        return PadTrack(stamps, w[:, core], has_depth, shift, rest, untouched is not None)


def core_markers(w: FloatArray) -> IntArray:
    """Indices of the markers that surely ride on the rod, (T, N, 3) → (k,): seen, deep, moving like the others."""
    seen: BoolArray = np.isfinite(w[..., 0]).mean(axis=0) > 0.9
    depth = np.full(w.shape[1], np.nan)
    depth[seen] = np.abs(np.nanmean(w[:, seen, 2], axis=0))  # a sign may be wrong
    if not seen.any():
        return np.zeros(0, dtype=np.intp)
    deep = seen & (np.where(seen, depth, 0.0) >= _CORE * np.percentile(depth[seen], 85))
    if not deep.any():
        return np.zeros(0, dtype=np.intp)
    motion = np.sqrt(np.nanvar(w[:, deep, :2], axis=0).sum(axis=1))
    usual = float(np.median(motion))
    steady = (motion < _CORE_STEADY * usual) & (motion > usual / _CORE_STEADY)
    return np.asarray(np.flatnonzero(deep)[steady], dtype=np.intp)
