"""How the virtual gel's images compare with real GelSight Mini images.

    python benchmarks/realism.py [--data ../shared/data] [--out docs/images]

Prints the tables of docs/realism.md and draws its pictures. Measures with plain thresholds and means, not with the
package's perception.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import PadContact, deform, grid_over, untouched
from tiptrace.sim.optics import fitted_data, press_optics
from tiptrace.sim.presses import ball_penetration
from tiptrace.sim.render import CameraNoise, TactileRenderer

MARKER_PITCH_PX, MARKER_DIAMETER_PX, MARKER_CONTRAST = (31.4, 32.2), 10.5, 97 - 26
NOISE_BGR = (2.2, 1.3, 1.8)
REGIONS_BGR = {  # 40 × 40 px at (v, u) of a real 320 × 240 marker gel, dots included
    "upper left": ((0, 0), (83, 72, 16)),
    "middle": ((100, 140), (156, 115, 122)),
    "lower left": ((200, 0), (67, 75, 47)),
}
MORE_REGIONS = {"upper right": (0, 280), "lower right": (200, 280), "left": (100, 0), "right": (100, 280)}
REAL_LAYOUT = DotLayout(
    offset_m=(9.2 * 0.0625e-3, -6.4 * 0.0625e-3)
)  # where the real gel's dots happen to lie
QUIET = CameraNoise((0, 0, 0), 0.0)
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 92]


@dataclass(frozen=True)
class DotMeasure:
    pitch_px: tuple[float, float]
    diameter_px: float
    dot_grey: float
    gel_grey: float


def measure_dots(image: np.ndarray) -> DotMeasure:
    """Pitch, diameter at half contrast and grey levels of dots that lie whole in the image."""
    grey = image.mean(axis=2).astype(np.float32)
    around = cv2.dilate(cv2.GaussianBlur(grey, (0, 0), 1), np.ones((25, 25)))
    around = cv2.GaussianBlur(around, (0, 0), 8)
    _, _, stats, centres = cv2.connectedComponentsWithStats((grey < 0.6 * around).astype(np.uint8))
    whole = [
        i for i, (x, y, w, h, area) in enumerate(stats)
        if 30 < area < 400 and x > 6 and y > 6 and x + w < 314 and y + h < 234
    ]  # fmt: skip
    c = centres[whole]
    gaps = c[None] - c[:, None]
    right = (np.abs(gaps[..., 1]) < 8) & (gaps[..., 0] > 20) & (gaps[..., 0] < 45)
    down = (np.abs(gaps[..., 0]) < 8) & (gaps[..., 1] > 20) & (gaps[..., 1] < 45)
    diameters, inner, outer = [], [], []
    for u, v in c:
        v0, u0 = round(v), round(u)
        window = grey[v0 - 14 : v0 + 15, u0 - 14 : u0 + 15]
        if window.shape != (29, 29):
            continue
        r = np.hypot(*np.meshgrid(np.arange(-14, 15), np.arange(-14, 15)))
        bright, dark = np.median(window[(r > 10) & (r < 13)]), np.median(window[r < 2.5])
        taken = np.clip((bright - window) / (bright - dark), 0, 1)[r < 10].sum()
        diameters.append(2 * np.sqrt(taken / np.pi))
        inner.append(dark)
        outer.append(bright)
    return DotMeasure(
        (float(np.median(gaps[right][:, 0])), float(np.median(gaps[down][:, 1]))),
        float(np.median(diameters)), float(np.median(inner)), float(np.median(outer)),
    )  # fmt: skip


def compare_regions(real: np.ndarray | None, simulated: np.ndarray) -> None:
    print(
        "\n## Region means, B G R\n\nregion | documented | real frame | simulated | worst\n---|---|---|---|---"
    )
    places = {k: at for k, (at, _) in REGIONS_BGR.items()} | MORE_REGIONS
    for name, (v, u) in places.items():
        ours = simulated[v : v + 40, u : u + 40].reshape(-1, 3).mean(axis=0)
        documented = np.array(REGIONS_BGR[name][1]) if name in REGIONS_BGR else None
        theirs = None if real is None else real[v : v + 40, u : u + 40].reshape(-1, 3).mean(axis=0)
        worst = max(np.abs(ours - t).max() for t in (documented, theirs) if t is not None)
        cells = ["–" if x is None else " ".join(f"{c:.0f}" for c in x) for x in (documented, theirs, ours)]
        print(f"{name} | {' | '.join(cells)} | {worst:.1f}")


def compare_dots(real: np.ndarray | None, simulated: np.ndarray) -> None:
    ours = measure_dots(simulated)
    theirs = None if real is None else measure_dots(real)
    print(
        "\n## Dots\n\n | documented | real frame, same measure | simulated | difference\n---|---|---|---|---"
    )
    rows = [
        ("pitch x, px", MARKER_PITCH_PX[0], lambda m: m.pitch_px[0]),
        ("pitch y, px", MARKER_PITCH_PX[1], lambda m: m.pitch_px[1]),
        ("diameter, px", MARKER_DIAMETER_PX, lambda m: m.diameter_px),
        ("dot, grey", None, lambda m: m.dot_grey),
        ("gel beside it, grey", None, lambda m: m.gel_grey),
        ("contrast (gel − dot) / gel", None, lambda m: (m.gel_grey - m.dot_grey) / m.gel_grey),
    ]
    for name, documented, value in rows:
        target = value(theirs) if theirs is not None else documented
        share = "–" if target is None else f"{100 * (value(ours) / target - 1):+.1f} %"
        real_cell = "–" if theirs is None else f"{value(theirs):.2f}"
        print(f"{name} | {documented or '–'} | {real_cell} | {value(ours):.2f} | {share}")


def compare_noise(data: Path) -> None:
    renderer = TactileRenderer(layout=REAL_LAYOUT, seed=0)
    gel = untouched()
    stack = np.stack([renderer.render(gel, k).astype(np.float32) for k in range(20)])
    ours = np.diff(stack, axis=0).std(axis=(0, 1, 2)) / np.sqrt(2)
    print("\n## Noise from frame to frame, σ in B G R\n\ndocumented | simulated | difference\n---|---|---")
    difference = " ".join(f"{100 * (o / d - 1):+.0f} %" for o, d in zip(ours, NOISE_BGR, strict=True))
    print(f"{NOISE_BGR} | {ours.round(2)} | {difference}")
    files = [data / f"gelsight_mini_sdk_model/img_{i}.png" for i in (0, 1, 2)]
    if all(f.is_file() for f in files):
        a = [cv2.imread(str(f)).astype(np.float32)[20:100, 60:260] for f in files]
        pairs = [x - y - cv2.GaussianBlur(x - y, (0, 0), 6) for x, y in ((a[0], a[1]), (a[1], a[2]))]
        print(
            f"\nOther units: still pairs of the maker's kit {np.mean([p.std((0, 1)) for p in pairs], 0) / np.sqrt(2)}"
        )
    presses = sorted((data / "gelsight_mini_ball_presses").glob("press_*.png"))
    if presses:
        far = np.stack([cv2.imread(str(f)).astype(np.float32)[320:, :200] for f in presses])
        print(f"ball presses (640 × 480, interpolated) {np.diff(far, axis=0).std((0, 1, 2)) / np.sqrt(2)}")


def compare_presses(data: Path, out: Path, numbers: tuple[int, ...] = (6, 12, 19, 0)) -> None:
    """Simulated presses beside real ones; the unknown depth of each is found by a scan."""
    folder, fitted = data / "gelsight_mini_ball_presses", fitted_data()["presses"]
    if not folder.is_dir():
        return
    scale = fitted["metres_per_px"]
    background = cv2.imread(str(folder / "background.png")).astype(np.float32)
    smooth = cv2.GaussianBlur(background, (0, 0), 12)
    renderer = TactileRenderer(
        press_optics(), noise=QUIET, image_size_px=(640, 480), metres_per_px=(scale, scale)
    )
    grid = grid_over(640 * scale, 480 * scale, 0.1e-3, 1e-3)
    flat, none, panels = renderer.render_clean(untouched(grid)), np.zeros((0, 2)), []
    print("\n## Presses at the same place\n\npress | depth, mm | change, rms B G R | difference, rms B G R | share "
          "| correlation\n---|---|---|---|---|---")  # fmt: skip
    for k in numbers:
        u, v = fitted["center_px"][k]
        s = np.s_[round(v) - 100 : round(v) + 100, round(u) - 100 : round(u) + 100]
        image = cv2.imread(str(folder / f"press_{k:02d}.png")).astype(np.float32)
        change = cv2.GaussianBlur(image - smooth, (0, 0), 1)[s]
        at = ((u - 319.5) * scale, (v - 239.5) * scale)

        def press(depth: float, at: tuple[float, float] = at) -> np.ndarray:
            overlap = ball_penetration(at, 2 * fitted["tip_radius_m"], depth, grid)
            clean = renderer.render_clean(deform(PadContact(overlap, none, none), grid))
            return np.asarray(np.minimum(clean, 255))

        depths = np.arange(0.25e-3, 0.9e-3, 0.025e-3)
        errors = [np.sqrt((((press(d) - flat)[s] - change) ** 2).mean()) for d in depths]
        depth = float(depths[int(np.argmin(errors))])
        ours = (press(depth) - flat)[s]
        rms_change, rms_off = (np.sqrt((x**2).mean(axis=(0, 1))) for x in (change, ours - change))
        correlation = np.corrcoef(ours.ravel(), change.ravel())[0, 1]
        share = np.sqrt((rms_off**2).mean() / (rms_change**2).mean())
        print(
            f"{k:02d} | {depth * 1e3:.2f} | {rms_change.round(1)} | {rms_off.round(1)} | {share:.2f} "
            f"| {correlation:.3f}"
        )
        noise = np.random.default_rng(k).normal(0, (1.1, 0.7, 1.0), ours.shape)
        panels.append(np.hstack([image[s], np.clip(smooth[s] + ours + noise, 0, 255), 128 + ours - change]))
    sheet = np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:4])])
    labels = [(i * 200 + 6, t) for i, t in enumerate(["real", "simulated", "difference + 128"] * 2)]
    sheet = np.clip(sheet, 0, 255).astype(np.uint8)
    for x, text in labels:
        cv2.putText(sheet, text, (x, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    cv2.imwrite(str(out / "realism_presses.jpg"), sheet, JPEG)


def draw_gel(out: Path) -> None:
    """Rendered marker gel: untouched, pressed by a bar, a cylinder and a ball."""
    renderer = TactileRenderer(layout=REAL_LAYOUT, seed=1)
    X, Y = (untouched().grid).mesh()
    a = np.radians(8)
    d = X * np.cos(a) + Y * np.sin(a)
    bar = 1.2e-3 - 3 * np.maximum(np.abs(d) - 4.3e-3, 0)
    on = np.minimum(np.abs(d), 3.8e-3)
    cylinder = 1.2e-3 - 4e-3 + np.sqrt(16e-6 - on**2) - 3 * (np.abs(d) - on)
    nodes = np.stack(np.meshgrid(np.linspace(-9.5e-3, 9.5e-3, 20), np.linspace(-7e-3, 7e-3, 15)), -1).reshape(
        -1, 2
    )
    images = [renderer.render(untouched())]
    for k, overlap in enumerate((bar, cylinder, ball_penetration((1e-3, 0.5e-3), 6e-3, 1.2e-3))):
        inside = untouched().grid.at(overlap, nodes, order=1) > 0
        shear = 0.06 * nodes[inside][:, ::-1] * [-1, 1] + [2e-4, -1e-4] if k < 2 else 0 * nodes[inside]
        images.append(renderer.render(deform(PadContact(overlap, nodes[inside], shear)), k + 1))
    cv2.imwrite(str(out / "virtual_gel.jpg"), np.vstack([np.hstack(images[:2]), np.hstack(images[2:])]), JPEG)


def main() -> None:
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=root.parent / "shared" / "data")
    parser.add_argument("--out", type=Path, default=root / "docs" / "images")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoCapture(str(args.data / "gelsight_mini_marker_video/mini_example.avi"))
    frames = [video.read()[1] for _ in range(11)]
    real = None if frames[-1] is None else frames[-1].astype(np.float32)
    simulated = TactileRenderer(layout=REAL_LAYOUT).render(untouched()).astype(np.float32)
    compare_regions(real, simulated)
    compare_dots(real, simulated)
    compare_noise(args.data)
    compare_presses(args.data, args.out)
    draw_gel(args.out)


if __name__ == "__main__":
    main()
