"""Gel calibration on 24 real ball presses: leave one out, and with the largest or the smallest presses held out.

    python benchmarks/real_presses.py [--ball 1.5] [--picture docs/images/sensing_real_presses.png]

The presses that are held out have no part in anything: contacts and shading come from the others, then the
network, then the held-out contact is located with that shading. "Largest" and "smallest" go by the radii of the
dataset's own csv, which measure the whole coloured blob; its centres are not used. The ball is not documented:
errors are relative to the diameter assumed (--ball), see docs/sensing.md. As an independent check of the centres
the last line compares them with where a vendor's network (other gel, other authors) sees no slope.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tiptrace.calibration.gel import pixel_noise, shading_of
from tiptrace.calibration.gel_circles import ball_radius_px, find_circles, locate
from tiptrace.calibration.gel_data import Circle, Press, PressFolder, read_press_folder
from tiptrace.calibration.gel_evaluation import PressScore, score_press
from tiptrace.calibration.gel_import import import_gel
from tiptrace.calibration.gel_network import train_network
from tiptrace.calibration.gel_onnx import mlp_to_onnx
from tiptrace.perception.gel_model import Convention, GelModel, load_gel_model

MM_PER_PX = 0.0295
CONVENTION = Convention(background="ratio", coordinates="zero")
LINEAR_PX = 7.0  # around the middle, where slope grows linearly


@dataclass(frozen=True)
class Held:
    """A press measured by a network that never saw it."""

    press: Press
    score: PressScore


def read(data: Path, ball_mm: float) -> tuple[PressFolder, np.ndarray]:
    """The presses as ``tiptrace calibrate gel`` reads them, without circles; and the csv's radii (24,) px."""
    source = data / "gelsight_mini_ball_presses"
    with (source / "touches.csv").open() as file:
        rows = list(csv.DictReader(file))
    with tempfile.TemporaryDirectory() as scratch:
        target = Path(scratch)
        shutil.copy(source / "background.png", target / "reference.png")
        for row in rows:
            shutil.copy(source / row["file"], target / row["file"])
        lines = "".join(f"{row['file']},{ball_mm},{MM_PER_PX}\n" for row in rows)
        (target / "presses.csv").write_text("image,ball_diameter_mm,mm_per_px\n" + lines)
        return read_press_folder(target), np.array([float(row["radius_px"]) for row in rows])


def hold_out(folder: PressFolder, test: list[int], seed: int) -> list[Held]:
    """Some presses, measured after a calibration on the others."""
    training = replace(folder, presses=tuple(p for i, p in enumerate(folder.presses) if i not in test))
    shading = shading_of(training, find_circles(training), one_place=True)
    rng = np.random.default_rng(seed)
    network = train_network([shading], folder.background, pixel_noise(folder), CONVENTION, rng)
    gel = GelModel(mlp_to_onnx(network.weights, network.biases, CONVENTION))
    presses = [folder.presses[i] for i in test]
    return [Held(p, score_press(gel, p, locate(p, folder, shading), folder)) for p in presses]


def show(label: str, held: list[Held]) -> None:
    normal = np.array([h.score.normal_error_deg for h in held])
    radius = 100 * np.array([h.score.radius_error for h in held])
    depth = 1e6 * np.array([h.score.depth_rms_m for h in held])
    print(
        f"{label:<24} {len(held):>3} {np.median(normal):>8.2f} {normal.max():>7.2f} {np.median(radius):>+9.1f} "
        f"{np.median(np.abs(radius)):>6.1f} {np.abs(radius).max():>6.1f} {np.median(depth):>9.1f}",
        flush=True,
    )


def vendor_centre(gel: GelModel, press: Press, circle: Circle, background: np.ndarray) -> np.ndarray:
    """Where a vendor's network sees no slope: zero of the linear fit s = k (x − c) around the middle, px."""
    H, W = background.shape[:2]
    v, u = np.indices((H, W), dtype=np.float32)
    near = np.hypot(u - circle.u, v - circle.v) < LINEAR_PX
    at, unit = np.stack([u, v], -1)[near], np.stack([u / W, v / H], -1)[near]
    pressed = gel.slopes(press.image.astype(np.float32)[near], unit)
    slope = pressed - gel.slopes(background[near], unit)  # (n, 2)
    A = np.column_stack([at, np.ones(len(at))]).astype(float)
    x = np.linalg.lstsq(A, slope, rcond=None)[0]  # (3, 2)
    return np.linalg.solve(x[:2].T, -x[2])


def draw(path: Path, held: list[Held], folder: PressFolder) -> None:
    """Cuts through held-out presses: measured surface and the ball, mm."""
    from small_png import save_small

    from tiptrace.evaluation import style

    with style.figure_style():
        figure = style.new_figure(9.0, 3.4)
        axes = figure.subplots(2, len(held), sharex=True, height_ratios=(1.0, 1.1), squeeze=False)
        for (top, bottom), h in zip(axes.T, held, strict=True):
            c, press = h.score.circle, h.press
            half = 40
            u0, v0 = round(c.u) - half, round(c.v) - half
            window = np.s_[v0 : v0 + 2 * half + 1, u0 : u0 + 2 * half + 1]
            x0, x1 = ((u0 - 0.5 - c.u) * MM_PER_PX, (u0 + 2 * half + 0.5 - c.u) * MM_PER_PX)
            y0, y1 = ((v0 - 0.5 - c.v) * MM_PER_PX, (v0 + 2 * half + 0.5 - c.v) * MM_PER_PX)
            top.imshow(press.image[window][..., ::-1], extent=(x0, x1, y1, y0), aspect="auto")
            top.axhline(0.0, color="white", linewidth=0.8, linestyle=":")
            top.grid(False)
            top.set(title=press.name.removesuffix(".png").replace("_", " "))
            x = (np.arange(2 * half + 1) + u0 - c.u) * MM_PER_PX
            z = -h.score.depth_m[round(c.v), u0 : u0 + 2 * half + 1] * 1e3
            bottom.plot(x, z, color=style.VERMILLION, label="measured")
            R, edge = ball_radius_px(press, folder) * MM_PER_PX, c.radius * MM_PER_PX
            ball = R - np.sqrt(np.maximum(R**2 - x**2, 0.0))
            inside = np.abs(x) < edge
            offset = float(np.median((z - ball)[inside]))
            wide = np.abs(x) < min(0.8 * R, 1.6 * edge)
            bottom.plot(x[wide], ball[wide] + offset, "--", color=style.BLACK, linewidth=1.0, label="ball")
            for side in (-edge, edge):
                bottom.axvline(side, color=style.GREY, linewidth=0.7, linestyle=":")
            bottom.set(xlabel="x [mm]")
        axes[0, 0].set(ylabel="y [mm]")
        axes[1, 0].set(ylabel="height [mm]")
        axes[1, 0].legend(loc="upper center")
        save_small(figure, path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--ball", type=float, default=1.5, help="ball diameter that is assumed, mm")
    parser.add_argument("--groups-only", action="store_true", help="without leave-one-out")
    args = parser.parse_args()
    folder, blob_px = read(args.data, args.ball)
    by_size = np.argsort(blob_px, kind="stable")
    print(f"ball {args.ball:g} mm, {MM_PER_PX} mm/px")
    heads = ("n", "normal°", "worst", "radius %", "|…| %", "worst", "depth µm")
    print(f"{'held out':<24} " + "{:>3} {:>8} {:>7} {:>9} {:>6} {:>6} {:>9}".format(*heads))
    show("the 6 largest presses", hold_out(folder, by_size[-6:].tolist(), 0))
    show("the 6 smallest presses", hold_out(folder, by_size[:6].tolist(), 0))
    if args.groups_only:
        return
    start = time.perf_counter()
    each = [hold_out(folder, [i], seed=i)[0] for i in range(len(folder.presses))]
    show("one at a time", each)
    print(f"a calibration takes {(time.perf_counter() - start) / len(each):.1f} s")
    with tempfile.TemporaryDirectory() as scratch:
        weights = args.data / "gelsight_mini_sdk_model" / "gs_sdk_nnmodel.pth"
        import_gel(weights, Path(scratch) / "vendor.onnx", "gs-sdk")
        vendor = load_gel_model(Path(scratch) / "vendor.onnx")
    off = [
        np.hypot(*(vendor_centre(vendor, h.press, h.score.circle, folder.background) - (c.u, c.v)))
        for h in each
        for c in [h.score.circle]
    ]
    print(f"centres against a vendor's network: median {np.median(off):.2f} px, worst {np.max(off):.2f} px")
    if args.picture:
        draw(args.picture, [each[i] for i in (by_size[0], by_size[8], by_size[15], by_size[-1])], folder)


if __name__ == "__main__":
    main()
