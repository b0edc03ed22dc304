"""Rig calibration on the virtual rig: errors of all unknowns over many seeds, and every wrong connection.

``python benchmarks/calibration_rig.py --seeds 20``
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from tiptrace.calibration.rig import RigCalibration, calibrate_rig
from tiptrace.calibration.rig_data import Segment, WiggleCollector
from tiptrace.errors import CalibrationError, ConfigError
from tiptrace.geometry.transforms import rotation_log
from tiptrace.sim.disturbances import LEVELS
from tiptrace.sim.spec import make_spec
from tiptrace.sim.wiggle import Wiggle, WiggleStream
from tiptrace.sim.wiring import FAULTS
from tiptrace.streams.synchronise import synchronise
from tiptrace.tracer import Sensing
from tiptrace.types import SIDES


def wiggle(seed: int, level: str, seconds: float, fault: str = "none") -> tuple[WiggleStream, Segment]:
    """A wiggle with markers in place of images, its T_E_S and scale wrong as at a level, the scale by 2 %."""
    shear = float(np.random.default_rng(seed).uniform(0.75, 0.95))
    d = LEVELS[level].model_copy(update={"mm_per_px": 0.02, "shown_shear": shear})  # type: ignore[index]
    spec = make_spec(mode="markers", seed=seed, level=level, disturbances=d)
    stream = WiggleStream(Wiggle(duration_s=seconds, fault=fault), spec)  # type: ignore[arg-type]
    sensing, collector = Sensing(stream), WiggleCollector(f"seed {seed}")
    for observation in synchronise(stream):
        collector.add(observation, sensing(observation))
    places = {s: stream.rig.T_E_S(s)[:3, 3] for s in SIDES}
    return stream, collector.segment(places, stream.untouched)


def errors(stream: WiggleStream, result: RigCalibration) -> tuple[np.ndarray, np.ndarray]:
    """(2, 12) errors and σ: rotation °, translation mm, scale %, gains, latency ms."""
    d, rows, sigmas = stream.spec.disturbed_by, [], []
    for side in SIDES:
        s, T = result.sensors[side], stream.true_rig.sensor(side).T_E_S.matrix()
        true_px = np.array(stream.true_rig.sensor(side).mm_per_px)
        rows.append(
            [
                *np.degrees(rotation_log(T[:3, :3].T @ s.T_E_S[:3, :3])),
                *(T[:3, :3].T @ (s.T_E_S[:3, 3] - T[:3, 3]) * 1e3),
                *((s.mm_per_px / true_px - 1) * 100),
                *(s.gain - [d.shown_shear, d.shown_shear, d.markers.shown_depth]),
                (s.latency_s - d.latency_s) * 1e3,
            ]
        )
        sigmas.append(
            [
                *np.degrees(s.rotation_std_rad),
                *(s.translation_std_m * 1e3),
                *(s.mm_per_px_std / true_px * 100),
                *s.gain_std,
                s.latency_std_s * 1e3,
            ]
        )
    return np.array(rows), np.array(sigmas)


def table(e: np.ndarray, s: np.ndarray) -> None:
    groups = {"rotation °": slice(0, 3), "translation mm": slice(3, 6), "mm per px %": slice(6, 8)}
    groups |= {"gain": slice(8, 11), "latency ms": slice(11, 12)}
    print("| | rms per axis | largest | length rms | largest length | claimed σ | within 2 σ |")
    print("|---|---|---|---|---|---|---|")
    for name, at in groups.items():
        x, length = e[..., at], np.linalg.norm(e[..., at], axis=-1)
        inside = np.mean(np.abs(x) < 2 * s[..., at])
        print(
            f"| {name} | {np.sqrt(np.mean(x**2)):.3f} | {np.abs(x).max():.3f} | {np.sqrt(np.mean(length**2)):.3f} "
            f"| {length.max():.3f} | {np.sqrt(np.mean(s[..., at] ** 2)):.3f} | {inside:.0%} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--level", default="nominal")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--fault-seeds", type=int, default=1)
    args = parser.parse_args()
    kinds: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {
        "with the markers' pitch": [],
        "by motion alone": [],
    }
    for seed in range(args.first, args.first + args.seeds):
        start = time.perf_counter()
        stream, segment = wiggle(seed, args.level, args.seconds)
        middle = time.perf_counter()
        for kind, found in kinds.items():
            found.append(errors(stream, calibrate_rig([segment], stream.rig, use_pitch="pitch" in kind)))
        done = time.perf_counter()
        print(f"seed {seed}: simulated {middle - start:.0f} s, solved {done - middle:.0f} s", flush=True)
    for kind, found in kinds.items():
        print(f"\n{args.level}, {args.seeds} seeds from {args.first}, {args.seconds:.0f} s, {kind}")
        table(*(np.array(x) for x in zip(*found, strict=True)))
    faults = [f for f in FAULTS if f != "none"]
    told = dict.fromkeys(faults, 0)
    for seed in range(args.first, args.first + args.fault_seeds):
        for fault in faults:
            try:
                stream, segment = wiggle(seed, args.level, 12.0, fault)
                calibrate_rig([segment], stream.rig)
            except (CalibrationError, ConfigError) as error:
                told[fault] += 1
                print(f"{fault}: {error}", flush=True)
    print(f"\nfaults told: {sum(told.values())} of {len(faults) * args.fault_seeds}; {told}")


if __name__ == "__main__":
    main()
