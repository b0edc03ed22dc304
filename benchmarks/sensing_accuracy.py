"""Markers of rendered gels against their truth: in plane, depth, its change and slow tilt; drift over minutes.

    python benchmarks/sensing_accuracy.py [--gel gelsight-mini-virtual] [--frames 20] [--drift-minutes 5]

A rectangular tool is pressed into virtual gels and moved as in a grasp (sensor noise on). Markers count that lie
inside the contact patch throughout. Rows: the gel that a network is calibrated on, gels of the same make, lamps that
drift and flicker, gels beyond the make's range; columns: rms over frames and markers.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import cv2
import numpy as np

from tiptrace.config import Sensor, Transform
from tiptrace.perception.finger import Finger
from tiptrace.perception.gel_model import GelModel, load_gel_model
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.settings import SensingConfig
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import GEL_GRID, WALL_SLOPE, GelDeformation, PadContact, deform
from tiptrace.sim.optics import Optics, gel_optics, nominal_optics, unseen_optics
from tiptrace.sim.render import LIVING_LAMPS, CameraNoise, TactileRenderer

S_M = 62.5e-6
SENSOR = Sensor(
    mm_per_px=(0.0625, 0.0625), T_E_S=Transform(translation_m=(0, 0, 0.14), quaternion_xyzw=(0, 0, 0, 1))
)
PATCH_SLOPE, PATCH_DEPTH_M = (
    0.12,
    0.25e-3,
)  # around a marker inside the patch: nowhere steeper, nowhere shallower


def grasp(t: float, seed: int) -> GelDeformation:
    """The gel under a tool at time t in [0, 1] of a motion drawn from a seed."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, 8)
    depth, half, angle_0 = rng.uniform(0.8e-3, 1.3e-3), rng.uniform(3e-3, 5e-3), rng.uniform(-0.15, 0.15)
    offset, end = rng.uniform(-1e-3, 1e-3), float(rng.choice([9e-3, 3e-3]))
    wave = np.sin(3 * np.pi * t + phase)
    since = wave - np.sin(phase)
    X, Y = GEL_GRID.mesh()
    angle = angle_0 + 0.04 * since[0]
    x = (X - offset - 0.2e-3 * wave[4]) * np.cos(angle) + Y * np.sin(angle)
    y = -(X - offset - 0.2e-3 * wave[4]) * np.sin(angle) + Y * np.cos(angle)
    plane = depth + 0.12e-3 * wave[1] + 0.015 * (wave[2] * X + wave[3] * Y)
    outside = np.hypot(np.maximum(np.abs(x) - half, 0), np.maximum(y - end, 0))
    touching = (outside == 0) & (plane > 0)
    nodes = np.column_stack([X[touching], Y[touching]])[::3]
    shear = np.tile(0.4e-3 * since[5:7], (len(nodes), 1))
    return deform(PadContact(plane - WALL_SLOPE * outside, nodes, shear))


@dataclass(frozen=True)
class Errors:
    """Per frame and marker inside the patch: (f, n, 2) px, (f, n) m, their sigma and true depth, (f, 2) tilt."""

    in_plane_px: np.ndarray
    depth_m: np.ndarray
    sigma_m: np.ndarray
    true_m: np.ndarray
    tilt: np.ndarray


def measure(
    gel: GelModel | None,
    optics: Optics,
    noise: CameraNoise | None,
    seed: int,
    frames: int,
    config: SensingConfig,
) -> Errors:
    renderer = TactileRenderer(optics, DotLayout(), noise, seed=seed)
    finger = Finger(SENSOR, gel, renderer.reference(), config)
    uv, depth, sigma, uv_true, depth_true, inside = [], [], [], [], [], []
    for k in range(frames):
        gel_now = grasp(k / frames, seed)
        markers = finger.sense(renderer.render(gel_now, k, time_s=0.4 * k))
        truth = renderer.dot_truth(gel_now).uv_px
        if k == 0:
            own = np.linalg.norm(markers.uv_px[:, None] - truth, axis=2).argmin(axis=1)
        z = renderer.heights(gel_now)
        uv.append(markers.uv_px)
        depth.append(-markers.x_S[:, 2])
        sigma.append(np.nan * markers.x_S[:, 2] if markers.depth_sigma_m is None else markers.depth_sigma_m)
        uv_true.append(truth[own])
        depth_true.append(-sample_map(z.astype(np.float32), truth[own]))
        inside.append(in_patch(renderer.slopes(gel_now), z, truth[own]))
    always = np.all(inside, axis=0)
    error = (np.array(depth) - np.array(depth_true))[:, always]
    places = np.array(uv_true)[:, always]
    tilt = np.array([tilt_of(e, p) for e, p in zip(error, places, strict=True)])
    return Errors(
        (np.array(uv)[:, always] - places),
        error,
        np.array(sigma)[:, always],
        np.array(depth_true)[:, always],
        tilt,
    )


def in_patch(slopes: tuple[np.ndarray, np.ndarray], z: np.ndarray, uv: np.ndarray) -> np.ndarray:
    window = np.ones((13, 13), np.uint8)
    steep = cv2.dilate(np.hypot(*slopes).astype(np.float32), window)
    shallow = cv2.dilate(z.astype(np.float32), window)
    u, v = np.clip(np.round(uv).astype(int), 0, [z.shape[1] - 1, z.shape[0] - 1]).T
    return (steep[v, u] < PATCH_SLOPE) & (shallow[v, u] < -PATCH_DEPTH_M)


def tilt_of(error: np.ndarray, uv: np.ndarray) -> np.ndarray:
    seen = np.isfinite(error)
    if seen.sum() < 6:
        return np.full(2, np.nan)
    A = np.column_stack([uv[seen] * S_M, np.ones(seen.sum())])
    return np.linalg.lstsq(A, error[seen], rcond=None)[0][:2]


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(x)))) if np.isfinite(x).any() else float("nan")


def row(label: str, runs: list[Errors]) -> None:
    change = np.concatenate([(e.depth_m - e.depth_m[0])[1:].ravel() for e in runs])
    tilt_change = np.concatenate([e.tilt - np.nanmean(e.tilt, axis=0) for e in runs])
    ratio = np.concatenate([(e.depth_m / e.sigma_m).ravel() for e in runs])
    print(
        f"{label:<44} {rms(np.concatenate([e.in_plane_px.ravel() for e in runs])):>7.3f} {1e6 * rms(change):>7.0f} "
        f"{1e6 * rms(np.concatenate([e.depth_m.ravel() for e in runs])):>7.0f} "
        f"{1e3 * rms(tilt_change[:, 0]):>6.1f} {1e3 * rms(tilt_change[:, 1]):>6.1f} {rms(ratio):>6.2f}",
        flush=True,
    )


def by_gel(model: GelModel, seeds: range, frames: int, gels: list[int]) -> None:
    """Where the absolute error comes from: each gel and press, depth error = scale × true depth + rest."""
    print(
        f"\n{'gel':>4} {'press':>6} {'depth mm':>9} {'abs µm':>7} {'scale %':>8} {'rest µm':>8} {'Δ µm':>6}"
    )
    for gel in gels:
        for s in seeds:
            e = measure(model, gel_optics(gel), None, s, frames, SensingConfig())
            seen = np.isfinite(e.depth_m)
            scale = float(np.sum(e.depth_m[seen] * e.true_m[seen]) / np.sum(e.true_m[seen] ** 2))
            rest, change = e.depth_m - scale * e.true_m, (e.depth_m - e.depth_m[0])[1:]
            print(
                f"{gel:>4} {s:>6} {1e3 * e.true_m.mean():>9.2f} {1e6 * rms(e.depth_m):>7.0f} {100 * scale:>+8.1f} "
                f"{1e6 * rms(rest):>8.0f} {1e6 * rms(change):>6.0f}",
                flush=True,
            )


def drift(gel: GelModel, minutes: float, every: int = 25) -> None:
    """A static gel under slowly brightening lamps: how far the markers seem to go."""
    noise = CameraNoise(flicker=0.002, drift_per_minute=0.01)
    renderer = TactileRenderer(nominal_optics(), DotLayout(), noise, seed=50)
    finger = Finger(SENSOR, gel, renderer.reference(), SensingConfig())
    still, frames = grasp(0.0, 2), int(minutes * 60 * 25)
    x = [finger.sense(renderer.render(still, k, time_s=k / 25)).x_S for k in range(0, frames, every)]
    block = max(len(x) // 10, 1)
    first, last = (np.nanmean(part, axis=0) for part in (x[:block], x[-block:]))
    gone = 1e6 * np.linalg.norm(last - first, axis=1)
    noise_um = 1e6 * np.nanstd(np.array(x), axis=0)
    print(
        f"\ndrift over {minutes:g} min of a still gel, lamps +1 %/min and flickering by 0.2 % ({len(x)} frames):"
    )
    print(
        f"  mean position, first to last tenth: median {np.nanmedian(gone):.1f} µm, worst {np.nanmax(gone):.1f} µm"
    )
    print(
        f"  single frames: x {np.nanmedian(noise_um[:, 0]):.1f}, y {np.nanmedian(noise_um[:, 1]):.1f}, "
        f"z {np.nanmedian(noise_um[:, 2]):.1f} µm"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gel", default="gelsight-mini-virtual", help="network under test")
    parser.add_argument("--calibrated", help="network calibrated on the nominal gel itself (own row)")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--drift-minutes", type=float, default=5.0)
    parser.add_argument("--by-gel", type=int, nargs="*", help="only these gels, one line for each press")
    args = parser.parse_args()
    gel, full = load_gel_model(args.gel), SensingConfig()
    seeds = range(1, 1 + args.seeds)
    if args.by_gel:
        by_gel(gel, seeds, args.frames, args.by_gel)
        return

    def runs(
        model: GelModel | None, optics: list[Optics], config: SensingConfig, noise: CameraNoise | None = None
    ) -> list[Errors]:
        return [measure(model, o, noise, s, args.frames, config) for o in optics for s in seeds]

    others = [gel_optics(s) for s in (11, 12, 13)]
    head = f"{'':<44} {'px':>7} {'Δ µm':>7} {'abs µm':>7} {'tilt x':>6} {'y mrad':>6} {'z/σ':>6}"
    print(f"network {args.gel}\n{head}")
    if args.calibrated:
        own = load_gel_model(args.calibrated)
        row("calibrated on this very gel", runs(own, [nominal_optics()], full))
        row("  … lamps drift and flicker", runs(own, [nominal_optics()], full, LIVING_LAMPS))
    row("other gels of the make", runs(gel, others, full))
    row("  … lamps drift and flicker", runs(gel, others, full, LIVING_LAMPS))
    row("  … at full resolution", runs(gel, others, SensingConfig(depth_step=1)))
    row("  … the paper's chain", runs(gel, others, SensingConfig(method="paper")))
    none = SensingConfig(depth="none", indentation_m=1.0e-3)
    row("  … no network, indentation 1.0 mm", runs(None, others, none))
    row("gels beyond the make's range", runs(gel, [unseen_optics(s) for s in (14, 15)], full))
    if args.drift_minutes > 0:
        drift(gel, args.drift_minutes)


if __name__ == "__main__":
    main()
