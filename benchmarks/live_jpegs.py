"""How many damaged jpegs pass for good ones, and how many good ones are refused.

    python benchmarks/live_jpegs.py trial.mcap --damaged 3000

Good: every image of the recording as a camera would send it (two sizes, three qualities, restart markers, other
chroma), in the order of capture, and, with --video, the frames of a real camera. Damaged: the first kind of files with
bytes overwritten, one bit flipped, 512 bytes lost, zeroed or sent twice, cut off, cut off and ended by a marker; a file
whose pixels come out the same is not counted. Each is shown after its sound predecessor, and, in a second turn, in
bursts of 12 damaged ones in a row.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from tiptrace.drivers.picture import Novelty, PictureError, decode_jpeg, inspect_jpeg
from tiptrace.streams.recording import Recording
from tiptrace.types import SIDES, Image, ImageSample

KINDS = {
    "640×480, quality 90": (2, [cv2.IMWRITE_JPEG_QUALITY, 90]),
    "320×240, quality 95": (1, [cv2.IMWRITE_JPEG_QUALITY, 95]),
    "640×480, quality 70, restarts": (2, [cv2.IMWRITE_JPEG_QUALITY, 70, cv2.IMWRITE_JPEG_RST_INTERVAL, 40]),
    "640×480, quality 85, 4:2:2, own codes": (
        2,
        [
            *(cv2.IMWRITE_JPEG_QUALITY, 85, cv2.IMWRITE_JPEG_OPTIMIZE, 1),
            *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
        ],
    ),
}
BURST = 12
Damage = Callable[[bytes, int, np.random.Generator], bytes]


def overwritten(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    return data[:at] + rng.integers(0, 256, 60).astype(np.uint8).tobytes() + data[at + 60 :]


def flipped(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]


def lost(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    return data[:at] + data[at + 512 :]


def zeroed(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    return data[:at] + bytes(512) + data[at + 512 :]


def doubled(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    return data[: at + 512] + data[at:]


def cut(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    return data[:at]


def ended(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    return data[:at] + b"\xff\xd9"


DAMAGES: dict[str, Damage] = {
    "60 bytes overwritten": overwritten,
    "one bit flipped": flipped,
    "512 bytes lost": lost,
    "512 bytes zeroed": zeroed,
    "512 bytes twice": doubled,
    "cut off": cut,
    "cut off and ended": ended,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--damaged", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--video", type=Path, help="a camera's video, for more good images")
    arguments = parser.parse_args()
    _quiet_libjpeg()
    images = {side: list(_images(arguments.recording, side)) for side in SIDES}
    for name, (scale, options) in KINDS.items():
        refused = [_refused([_jpeg(image, scale, options) for image in images[side]]) for side in SIDES]
        print(
            f"  good, {name:42s} refused {sum(refused)} of {sum(len(images[side]) for side in SIDES)}",
            flush=True,
        )
    if arguments.video is not None:
        frames = [_jpeg(image, 1, [cv2.IMWRITE_JPEG_QUALITY, 90]) for image in _video(arguments.video)]
        print(f"  good, {arguments.video.name:42s} refused {_refused(frames)} of {len(frames)}", flush=True)
    scale, options = next(iter(KINDS.values()))
    files = [_jpeg(image, scale, options) for image in images["left"]]
    rng = np.random.default_rng(arguments.seed)
    for name, damage in DAMAGES.items():
        count = arguments.damaged // len(DAMAGES)
        tell(name, [alone(files, damage, rng) for _ in range(count)])
    bursts = arguments.damaged // BURST // 3
    tell(f"60 bytes, {BURST} in a row", [one for _ in range(bursts) for one in burst(files, rng)])


def tell(name: str, outcomes: list[float | None]) -> None:
    """Print a row; outcomes are None for the same pixels, 0 for refused, else how far off the worst 16 × 16 px are."""
    changed = [outcome for outcome in outcomes if outcome is not None]
    passed = sorted(outcome for outcome in changed if outcome > 0.0)
    worst = f", {passed[-1]:.0f} at most" if passed else ""
    visible = sum(outcome > 10.0 for outcome in passed)
    print(
        f"  damaged, {name:39s} passed {len(passed)} of {len(changed)} ({visible} are off by over 10 levels{worst})",
        flush=True,
    )


def alone(files: list[bytes], damage: Damage, rng: np.random.Generator) -> float | None:
    """A damaged file after its sound predecessor."""
    k = int(rng.integers(1, len(files)))
    novelty = Novelty()
    passes(novelty, files[k - 1])
    damaged = damage(files[k], _place(files[k], rng), rng)
    return _outcome(novelty, damaged, files[k])


def burst(files: list[bytes], rng: np.random.Generator) -> Iterator[float | None]:
    """Damaged files one after the other, as long as a bad contact lasts."""
    k = int(rng.integers(1, len(files) - BURST))
    novelty = Novelty()
    passes(novelty, files[k - 1])
    for data in files[k : k + BURST]:
        yield _outcome(novelty, overwritten(data, _place(data, rng), rng), data)


def passes(novelty: Novelty, data: bytes) -> bool:
    """What a camera's thread does with a file."""
    try:
        facts = inspect_jpeg(data)
        return not novelty.torn(_shrunk(decode_jpeg(data)), facts)
    except PictureError:
        novelty.broken()
        return False


def _outcome(novelty: Novelty, damaged: bytes, sound: bytes) -> float | None:
    raw = np.frombuffer(damaged, dtype=np.uint8)
    picture, truth = cv2.imdecode(raw, cv2.IMREAD_COLOR), decode_jpeg(sound)
    if picture is not None and np.array_equal(picture, truth):
        return None
    if not passes(novelty, damaged):
        return 0.0
    wrong = np.abs(decode_jpeg(damaged).astype(np.float32) - truth).max(axis=2)
    h, w = wrong.shape
    return max(float(cv2.resize(wrong, (w // 16, h // 16), interpolation=cv2.INTER_AREA).max()), 1e-6)


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Anywhere but in the first bytes, heads included."""
    return int(rng.integers(2, len(data) - 600))


def _refused(files: list[bytes]) -> int:
    novelty = Novelty()
    return sum(not passes(novelty, data) for data in files)


def _shrunk(image: Image) -> Image:
    return np.asarray(cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _jpeg(image: Image, scale: int, options: list[int]) -> bytes:
    if scale != 1:
        size = (scale * image.shape[1], scale * image.shape[0])
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    data: bytes = cv2.imencode(".jpg", image, options)[1].tobytes()
    return data


def _images(path: Path, side: str) -> Iterator[Image]:
    for sample in Recording(path):
        if isinstance(sample, ImageSample) and sample.side == side:
            yield sample.image


def _video(path: Path) -> Iterator[Image]:
    capture = cv2.VideoCapture(str(path))
    while True:
        ok, image = capture.read()
        if not ok:
            return
        yield np.asarray(image, dtype=np.uint8)


def _quiet_libjpeg() -> None:
    """It warns of damaged files on the terminal; here thousands are decoded only to see whether a pixel changed."""
    sys.stderr.flush()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


if __name__ == "__main__":
    main()
