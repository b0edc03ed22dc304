"""Gel calibration and health on rendered presses, where the truth is known.

    python benchmarks/gel_calibration.py [--sessions 3]

A session: 30 presses of 3 to 8 mm balls all over one gel, calibrated as ``tiptrace calibrate gel`` does. "held out" are
the command's own figures against the ball; "truth" is another session's presses against the renderer's surface.
Health: scores of ``tiptrace calibrate check`` for a fresh image and for single damages of growing strength.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np

from tiptrace.calibration.gel import train_gel
from tiptrace.calibration.gel_evaluation import angles_deg, measured_slopes
from tiptrace.calibration.gel_health import check_gel
from tiptrace.perception.background import untouched_background
from tiptrace.perception.gel_model import GelModel, load_gel_model
from tiptrace.perception.still import depth_of_image
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import GEL_GRID, PadContact, deform, untouched
from tiptrace.sim.presses import PressPlan, render_press, write_press_folder
from tiptrace.sim.render import TactileRenderer

S = (62.5e-6, 62.5e-6)
PLACES = ((100.0, 90.0, 5e-3, 0.8e-3), (220.0, 150.0, 7e-3, 1.2e-3), (60.0, 190.0, 4e-3, 1.0e-3))


def truth(gel: GelModel) -> tuple[float, float]:
    """Median normal error in contacts, degrees, and rms depth error over whole maps, m; a gel without dots."""
    renderer = TactileRenderer(seed=77)
    reference = renderer.reference()
    background = untouched_background(reference)
    nothing = np.zeros(reference.shape[:2], dtype=np.bool_)
    v, u = np.indices(nothing.shape)
    angles, depth = [], []
    for cu, cv, diameter, deep in PLACES:
        press = render_press(renderer, (cu, cv), diameter, deep)
        inside = np.hypot(u - cu, v - cv) < press.contact_radius_px
        slopes = measured_slopes(gel, press.image, background, nothing)
        angles.append(np.median(angles_deg(slopes[inside], press.slope[inside])))
        depth.append(depth_of_image(press.image, reference, gel, S).depth_m + press.height_m)
    return float(np.median(angles)), float(np.sqrt(np.mean(np.square(depth))))


def calibrations(sessions: int) -> GelModel:
    """Table of sessions; returns the last model of a gel with dots."""
    print(
        f"{'gel':<14} {'session':>7} {'normal°':>8} {'depth µm':>9} {'radius %':>9} {'truth °':>8} {'µm':>5} {'s':>5}"
    )
    for name, layout in (("without dots", None), ("with dots", DotLayout())):
        for session in range(sessions):
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch)
                plan = PressPlan(layout=layout, columns=6, rows=5, seed=100 + session)
                write_press_folder(folder, plan)
                report = train_gel(folder, folder / "gel.onnx", mm_per_px=(0.0625, 0.0625))
                gel = load_gel_model(folder / "gel.onnx")
            degrees, depth_m = truth(gel)
            print(
                f"{name:<14} {session:>7} {report.normal_error_deg:>8.2f} {1e6 * report.depth_rms_m:>9.0f} "
                f"{100 * report.radius_error:>9.1f} {degrees:>8.2f} {1e6 * depth_m:>5.0f} {report.seconds:>5.0f}",
                flush=True,
            )
    return gel


def health(gel: GelModel) -> None:
    renderer = TactileRenderer(layout=DotLayout(), seed=9)
    reference, fresh = renderer.reference(), renderer.render(untouched(), 4)
    X, Y = GEL_GRID.mesh()
    none = np.zeros((0, 2))

    def dent(depth_m: float) -> np.ndarray:
        overlap = depth_m - 0.02 * np.maximum(np.hypot(X, Y) - 2e-3, 0)
        return renderer.render(deform(PadContact(overlap, none, none)), 6)

    def scratch(share: float) -> np.ndarray:
        line = cv2.line(np.zeros(fresh.shape[:2], np.float32), (60, 60), (130, 160), 1.0, 2, cv2.LINE_AA)
        tint = cv2.GaussianBlur(line, (0, 0), 0.8)[..., None] * [1, 0.3, -0.6]
        return np.clip(fresh * (1 + share * tint), 0, 255).astype(np.uint8)

    def dimmed(gain: np.ndarray | float) -> np.ndarray:
        return np.clip(fresh * gain, 0, 255).astype(np.uint8)

    cases = {
        "fresh": fresh,
        "all lamps −5 %": dimmed(0.95),
        "all lamps −20 %": dimmed(0.8),
        "one side −15 %": dimmed(np.linspace(0.85, 1, 320)[None, :, None]),
        "scratch 15 %": scratch(0.15),
        "scratch 30 %": scratch(0.3),
        "scratch 60 %": scratch(0.6),
        "dent 0.03 mm": dent(0.03e-3),
        "dent 0.1 mm": dent(0.1e-3),
        "a press (no damage)": render_press(renderer, (150.0, 110.0), 6e-3, 0.8e-3).image,
    }
    print(f"\n{'':<20} {'flat µm':>8} {'curl/mm':>8} {'contact':>8} {'light %':>8}  not good")
    for name, image in cases.items():
        (h,) = check_gel([image], reference, gel, S)
        told = ", ".join(f"{k}: {v}" for k, v in h.verdicts().items() if v != "good") or "–"
        print(
            f"{name:<20} {h.flatness_um:>8.1f} {h.curl_per_mm:>8.3f} {h.curl_in_contact:>8.3f} "
            f"{100 * h.illumination_change:>8.1f}  {told}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=3)
    args = parser.parse_args()
    health(calibrations(args.sessions))


if __name__ == "__main__":
    main()
