"""Fit the virtual gel's optics to real GelSight Mini images; writes src/tiptrace/sim/data/optics.json.

    python scripts/fit_optics.py [--data ../shared/data] [--out src/tiptrace/sim/data/optics.json]

Lamps come from the 24 ball presses (640 × 480, 0.0295 mm/px). Neither the ball's size nor the pressed shape is
documented, and the annotated centres are off by up to 25 px, so that shape and lamps are fitted together: a ball
of a given radius, in contact up to a_i around (u_i, v_i), and beyond it the slope K1(r/λ) of an elastic membrane.
The radius kept, 0.75 mm, is near the one that explains the images best (--scan) and gives the slopes that the
sensor maker's published network finds in the same images (steepest 0.6–0.7). The colour of the untouched gel
comes from the presses' background, and for the marker gel from a frame of the marker video without its dots.
"""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.special import k1

from tiptrace.sim.optics import HALF_HEIGHT_M, HALF_WIDTH_M, background_basis, irradiance, optics_from_dict

PRESS_M_PER_PX = 0.0295e-3
LAMPS = 2  # per channel
RADII_M = (0.5e-3, 0.65e-3, 0.75e-3, 0.9e-3, 1.2e-3, 2.0e-3)
PER_CHANNEL = 2 + 3 * LAMPS  # ambient, softness, and azimuth, elevation, strength of each lamp
SATURATED = 254.0
LEAST_SOFTNESS = 0.2  # lamps are bars behind a diffuser: they span some 25° as seen from the gel


@dataclass(frozen=True)
class Samples:
    """Pixels around all presses, n of each."""

    u: np.ndarray  # (presses, n) px
    v: np.ndarray
    colour: np.ndarray  # (presses, n, 3)
    untouched: np.ndarray  # (presses, n, 3)
    size_px: tuple[int, int]


def read_samples(folder: Path, n: int = 900, seed: int = 0) -> tuple[Samples, np.ndarray]:
    """Pixels around each press, denser near its middle, and the smoothed background."""
    rng = np.random.default_rng(seed)
    background = cv2.imread(str(folder / "background.png")).astype(np.float32)
    smooth = cv2.GaussianBlur(background, (0, 0), 12)
    parts: list[tuple[np.ndarray, ...]] = []
    with (folder / "touches.csv").open() as file:
        rows = list(csv.DictReader(file))
    height, width = background.shape[:2]
    for row in rows:
        image = cv2.imread(str(folder / row["file"])).astype(np.float32)
        near = cv2.GaussianBlur(image, (0, 0), 1)
        u0, v0 = brightest_change(image - smooth)
        r, t = 130 * rng.random(n) ** 0.8, rng.random(n) * 2 * np.pi
        u = np.clip(np.round(u0 + r * np.cos(t)), 0, width - 1).astype(int)
        v = np.clip(np.round(v0 + r * np.sin(t)), 0, height - 1).astype(int)
        parts.append((u, v, near[v, u], smooth[v, u]))
    u, v, colour, untouched = (np.stack(p) for p in zip(*parts, strict=True))
    return Samples(u, v, colour, untouched, (width, height)), background


def brightest_change(change: np.ndarray) -> tuple[float, float]:
    """Centre of the colour change, px: a start for the fit, better than the annotation."""
    weight = np.maximum(cv2.GaussianBlur(np.abs(change).sum(axis=2), (0, 0), 4) - 25, 0)
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return float((u * weight).sum() / weight.sum()), float((v * weight).sum() / weight.sum())


class Fit:
    """Joint fit of shapes and lamps; parameters: contact radius and centre of each press, λ, lamps."""

    def __init__(self, samples: Samples, radius_m: float) -> None:
        self.s = samples
        self.n = len(samples.u)
        self.R = radius_m / PRESS_M_PER_PX
        width, height = samples.size_px
        self.x_m = (samples.u - (width - 1) / 2) * PRESS_M_PER_PX
        self.y_m = (samples.v - (height - 1) / 2) * PRESS_M_PER_PX

    def start(self) -> np.ndarray:
        lamps = [(0.3, 0.1, 52, 12, 0.9, 106, 14, 0.3), (0.27, 0.1, -8, 14, 0.4, 40, 14, 0.3)]
        lamps.append((0.15, 0.1, -90, 17, 0.9, 194, 7, 0.1))
        degrees = np.array([1, 1] + [np.pi / 180, np.pi / 180, 1] * LAMPS)
        a = np.full(self.n, 0.55 * min(self.R, 25.0))
        u0, v0 = self.s.u.mean(axis=1), self.s.v.mean(axis=1)
        return np.concatenate([a, u0, v0, [38.0], (np.array(lamps) * degrees).ravel()])

    def slope(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """∂z/∂x and ∂z/∂y at the samples, (presses, n) each."""
        a, u0, v0 = (v[:, None] for v in p[: 3 * self.n].reshape(3, -1))
        a, decay = np.clip(a, 2, 0.95 * self.R), max(p[3 * self.n], 3.0)
        dx, dy = self.s.u - u0, self.s.v - v0
        r = np.hypot(dx, dy) + 1e-6
        inside = np.minimum(r, a)
        radial = inside / np.sqrt(self.R**2 - inside**2)
        radial *= np.where(r > a, k1(np.maximum(r, a) / decay) / k1(a / decay), 1)
        return radial * dx / r, radial * dy / r

    def optics(self, p: np.ndarray) -> dict[str, Any]:
        """The lamps of a parameter vector as they are written."""
        lamps = p[3 * self.n + 1 :].reshape(3, PER_CHANNEL)
        angles = lamps[:, 2:].reshape(3, LAMPS, 3)
        return {
            "azimuth_deg": (np.degrees(angles[..., 0]) % 360).round(2).tolist(),
            "elevation_deg": np.degrees(angles[..., 1]).round(2).tolist(),
            "strength": np.abs(angles[..., 2]).round(4).tolist(),
            "ambient": np.abs(lamps[:, 0]).round(4).tolist(),
            "softness": (LEAST_SOFTNESS + np.abs(lamps[:, 1])).round(4).tolist(),
            "lamp_distance_m": 0.03,
            "background": [[0.0]] * 3,
        }

    def residual(self, p: np.ndarray) -> np.ndarray:
        """Model minus image, grey levels, (presses · n · 3,)."""
        z_x, z_y = (s.astype(np.float64) for s in self.slope(p))
        optics = optics_from_dict(self.optics_exact(p))
        flat = np.zeros((1, 1))
        out = np.empty((*z_x.shape, 3))
        for c in range(3):
            E = irradiance(optics, c, z_x, z_y, self.x_m, self.y_m, np.float64)
            E /= irradiance(optics, c, flat, flat, self.x_m, self.y_m, np.float64)
            out[..., c] = np.minimum(self.s.untouched[..., c] * E, SATURATED) - self.s.colour[..., c]
        return out.ravel()

    def optics_exact(self, p: np.ndarray) -> dict[str, Any]:
        """Like :meth:`optics`, unrounded, so that the fit has a derivative."""
        lamps = p[3 * self.n + 1 :].reshape(3, PER_CHANNEL)
        angles = lamps[:, 2:].reshape(3, LAMPS, 3)
        rounded = self.optics(p)
        rounded["azimuth_deg"], rounded["elevation_deg"] = (
            np.degrees(angles[..., 0]),
            np.degrees(angles[..., 1]),
        )
        rounded["strength"], rounded["ambient"] = np.abs(angles[..., 2]), np.abs(lamps[:, 0])
        rounded["softness"] = LEAST_SOFTNESS + np.abs(lamps[:, 1])
        return rounded

    def sparsity(self) -> lil_matrix:
        """Which residual depends on which parameter."""
        n, m = self.n, self.s.u.shape[1] * 3
        S = lil_matrix((n * m, 3 * n + 1 + 3 * PER_CHANNEL), dtype=int)
        for i in range(n):
            S[i * m : (i + 1) * m, [i, n + i, 2 * n + i]] = 1
        S[:, 3 * n] = 1
        for c in range(3):
            first = 3 * n + 1 + c * PER_CHANNEL
            S[c::3, first : first + PER_CHANNEL] = 1
        return S

    def solve(self) -> tuple[np.ndarray, float]:
        """Best parameters, and the cost they leave."""
        n = self.n
        scale = np.concatenate(
            [np.full(3 * n, 3.0), [10.0], np.tile([0.1, 0.1] + [0.3, 0.1, 0.3] * LAMPS, 3)]
        )
        result = least_squares(
            self.residual, self.start(), jac_sparsity=self.sparsity(), x_scale=scale, loss="soft_l1", f_scale=5.0,
            max_nfev=60,
        )  # fmt: skip
        return result.x, float(result.cost)


def fit_background(image: np.ndarray, keep: np.ndarray | None = None) -> np.ndarray:
    """(3, k) polynomial of an untouched gel's image over the width of the view."""
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    basis = background_basis(u * HALF_WIDTH_M, v * HALF_HEIGHT_M)
    chosen = np.ones((height, width), bool) if keep is None else keep
    coefficients = np.linalg.lstsq(basis[chosen], image[chosen].astype(float), rcond=None)[0]
    return np.asarray(coefficients.T)


def marker_gel_background(video: Path, frame: int = 10) -> np.ndarray:
    """The marker gel's colour between its dots."""
    capture = cv2.VideoCapture(str(video))
    frames = [capture.read()[1] for _ in range(frame + 1)]
    image = frames[-1].astype(np.float32)
    local = cv2.GaussianBlur(image.mean(axis=2), (0, 0), 12)
    dots = (image.mean(axis=2) < 0.8 * local).astype(np.uint8)
    return fit_background(image, cv2.dilate(dots, np.ones((7, 7), np.uint8)) == 0)


def fit_and_say(samples: Samples, radius_m: float) -> tuple[Fit, np.ndarray]:
    """Fit with one tip radius and print what is left."""
    fit = Fit(samples, radius_m)
    p, cost = fit.solve()
    rms = np.sqrt((fit.residual(p).reshape(-1, 3) ** 2).mean(axis=0))
    a = np.clip(p[: fit.n], 0, 0.95 * fit.R)
    steepest = np.median(a / np.sqrt(fit.R**2 - a**2))
    print(
        f"tip radius {radius_m * 1e3:.2f} mm: cost {cost:.0f}, rms B/G/R {rms.round(2)} grey levels, contact radius "
        f"{a.min() * PRESS_M_PER_PX * 1e3:.2f}–{a.max() * PRESS_M_PER_PX * 1e3:.2f} mm, steepest slope "
        f"{steepest:.2f}, skirt {p[3 * fit.n] * PRESS_M_PER_PX * 1e3:.2f} mm",
        flush=True,
    )
    return fit, p


def main() -> None:
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=root.parent / "shared" / "data")
    parser.add_argument("--out", type=Path, default=root / "src/tiptrace/sim/data/optics.json")
    parser.add_argument("--tip-radius-mm", type=float, default=0.75)
    parser.add_argument(
        "--scan", action="store_true", help="only show how well other radii explain the images"
    )
    args = parser.parse_args()
    samples, background = read_samples(args.data / "gelsight_mini_ball_presses")
    if args.scan:
        for radius in RADII_M:
            fit_and_say(samples, radius)
        return
    radius = args.tip_radius_mm * 1e-3
    fit, p = fit_and_say(samples, radius)
    n = fit.n
    data = fit.optics(p) | {
        "background": marker_gel_background(
            args.data / "gelsight_mini_marker_video/mini_example.avi"
        ).round(3).tolist(),
        "background_presses": fit_background(background).round(3).tolist(),
        "presses": {
            "tip_radius_m": radius,
            "metres_per_px": PRESS_M_PER_PX,
            "skirt_m": round(float(p[3 * n]) * PRESS_M_PER_PX, 7),
            "contact_radius_m": (p[:n] * PRESS_M_PER_PX).round(7).tolist(),
            "center_px": np.stack([p[n : 2 * n], p[2 * n : 3 * n]], 1).round(2).tolist(),
        },
    }  # fmt: skip
    args.out.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
