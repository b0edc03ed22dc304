"""Gel calibration on 24 real ball presses: leave one out, and with the largest or the smallest contacts held out.

    python benchmarks/real_presses.py [--data ../shared/data] [--pictures docs/images/real-presses]

The presses' annotated circles are off by up to 25 px, and the ball is not documented; contacts are found in the
images. Two vendors' networks for gels of the same make put the slope per pixel at the contact's centre where a
ball of 1.5 mm would have it (--ball), not one of 4 mm.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from tiptrace.calibration.gel import pixel_noise, shading_of
from tiptrace.calibration.gel_circles import find_circles
from tiptrace.calibration.gel_data import Circle, PressFolder, read_press_folder
from tiptrace.calibration.gel_evaluation import PressScore, score_press
from tiptrace.calibration.gel_network import train_network
from tiptrace.calibration.gel_onnx import mlp_to_onnx
from tiptrace.calibration.gel_pictures import draw_press
from tiptrace.perception.gel_model import Convention, GelModel

MM_PER_PX = 0.0295
CONVENTION = Convention(background="ratio", coordinates="zero")


def write_folder(source: Path, target: Path, ball_mm: float) -> None:
    """The presses as ``tiptrace calibrate gel`` reads them, without their circles."""
    shutil.copy(source / "background.png", target / "reference.png")
    with (source / "touches.csv").open() as file:
        names = [row["file"] for row in csv.DictReader(file)]
    for name in names:
        shutil.copy(source / name, target / name)
    rows = "".join(f"{name},{ball_mm},{MM_PER_PX}\n" for name in names)
    (target / "presses.csv").write_text("image,ball_diameter_mm,mm_per_px\n" + rows)


def hold_out(data: PressFolder, circles: list[Circle], test: list[int], seed: int) -> list[PressScore]:
    """Scores of some presses by a network trained on the others."""
    train = [i for i in range(len(circles)) if i not in test]
    shading = shading_of(data, circles, train, one_place=True)
    rng = np.random.default_rng(seed)
    network = train_network(shading, data.background, pixel_noise(data), CONVENTION, rng)
    gel = GelModel(mlp_to_onnx(network.weights, network.biases, CONVENTION))
    return [score_press(gel, data.presses[i], circles[i], data) for i in test]


def show(label: str, scores: list[PressScore]) -> None:
    normal = np.array([s.normal_error_deg for s in scores])
    radius = 100 * np.array([s.radius_error for s in scores])
    depth = 1e6 * np.array([s.depth_rms_m for s in scores])
    print(
        f"{label:<28} {len(scores):>3} {np.median(normal):>8.2f} {normal.max():>8.2f} "
        f"{np.median(radius):>+9.1f} {np.median(np.abs(radius)):>8.1f} {np.median(depth):>8.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--ball", type=float, default=1.5, help="ball diameter, mm")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        write_folder(args.data / "gelsight_mini_ball_presses", Path(scratch), args.ball)
        data = read_press_folder(Path(scratch))
    start = time.perf_counter()
    circles = find_circles(data)
    print(f"contacts of {len(circles)} presses found in {time.perf_counter() - start:.1f} s")
    by_size = np.argsort([c.radius for c in circles])
    print(
        f"{'held out':<28} {'n':>3} {'normal°':>8} {'worst°':>8} {'radius %':>9} {'|…| %':>8} {'depth µm':>8}"
    )
    each = [hold_out(data, circles, [i], seed=i)[0] for i in range(len(circles))]
    show("one at a time", each)
    show("the 6 largest contacts", hold_out(data, circles, by_size[-6:].tolist(), 0))
    show("the 6 smallest contacts", hold_out(data, circles, by_size[:6].tolist(), 0))
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
        for i in (*by_size[:2], *by_size[11:13], *by_size[-2:]):
            path = args.pictures / f"{Path(data.presses[i].name).stem}.png"
            draw_press(each[i], data.presses[i], data, path)


if __name__ == "__main__":
    main()
