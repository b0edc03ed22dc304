"""How fast recordings are written, opened and read: python benchmarks/recording_speed.py [--pairs N]."""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.geometry.transforms import rotation_exp, transform
from tiptrace.streams.recording import Recording
from tiptrace.streams.synchronise import synchronise
from tiptrace.streams.writer import write_recording
from tiptrace.types import SIDES, Image, ImageSample, PoseSample, Sample, Side

NS = 1_000_000_000
REPEATS = 5
HALF = 0.5**0.5


class Synthetic:
    """Textured, noisy 320×240 images at 25 Hz on both sides and poses at 125 Hz."""

    def __init__(self, pairs: int) -> None:
        self.tool: Tool | None = None
        self.references: dict[Side, Image] = {}
        self.gel_models: dict[str, bytes] = {}
        rng = np.random.default_rng(0)
        small = rng.integers(40, 160, (12, 16, 3), dtype=np.uint8)
        smooth = cv2.resize(small, (320, 240), interpolation=cv2.INTER_CUBIC).astype(float)
        self._images = [
            np.clip(smooth + rng.normal(0, 2, smooth.shape), 0, 255).astype(np.uint8) for _ in range(8)
        ]
        self._pairs = pairs
        sensor = {"image_size_px": [320, 240], "mm_per_px": [0.0625, 0.0625]}
        poses = {
            "left": {"translation_m": [0.0031, 0, 0.14], "quaternion_xyzw": [0, -HALF, 0, HALF]},
            "right": {"translation_m": [-0.0031, 0, 0.14], "quaternion_xyzw": [HALF, 0, HALF, 0]},
        }
        self.rig = Rig.model_validate({"sensors": {side: sensor | {"T_E_S": poses[side]} for side in SIDES}})

    def __iter__(self) -> Iterator[Sample]:
        for k in range(-1, self._pairs + 1):
            stamp = NS + k * NS // 25
            for i in range(5):
                pose = transform(rotation_exp([0.01 * (k + i / 5), 0, 0]), [0.4, 0.0, 0.2])
                yield PoseSample(stamp + i * NS // 125, pose)
            if 0 <= k < self._pairs:
                for n, side in enumerate(SIDES):
                    yield ImageSample(side, stamp + n * 2_000_000, self._images[(k + n) % 8])


def timed(action: Callable[[], object]) -> list[float]:
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return times


def show(what: str, times: list[float], pairs: int) -> None:
    rate = [pairs / t for t in times]
    print(
        f"{what:42s} {statistics.median(rate):8.0f} pairs/s  {1e3 * statistics.median(times) / pairs:6.2f} ms/pair  "
        f"(of {REPEATS}: {min(rate):.0f} … {max(rate):.0f} pairs/s)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=361)
    pairs = parser.parse_args().pairs
    stream = Synthetic(pairs)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trial.mcap"
        show("write jpeg, quality 95", timed(lambda: write_recording(path, stream)), pairs)
        size = path.stat().st_size
        print(f"  {size / 1e6:.1f} MB, {size / pairs / 2e3:.1f} kB per image, 5 poses per pair")
        show("open: survey and checks", timed(lambda: Recording(path)), pairs)
        recording = Recording(path)
        show("read samples, jpeg decode included", timed(lambda: sum(1 for _ in recording)), pairs)
        show("read and synchronise", timed(lambda: sum(1 for _ in synchronise(recording))), pairs)
        images = [cv2.imencode(".jpg", im, [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for im in stream._images]
        decode = timed(lambda: [cv2.imdecode(images[k % 8], cv2.IMREAD_COLOR) for k in range(2 * pairs)])
        show("  of which jpeg decode alone", decode, pairs)


if __name__ == "__main__":
    main()
