"""Small synthetic trials: textured images, a screw motion, phases. No sensing is simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap_ros2.writer import Writer

from tiptrace.config import Rig, Tool
from tiptrace.geometry.transforms import rotation_exp, transform
from tiptrace.streams import messages
from tiptrace.types import (
    FloatArray,
    Image,
    ImageSample,
    OpeningSample,
    Phase,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
    TruthSample,
)

NS = 1_000_000_000
T0 = 1_700_000_000 * NS  # a time as clocks have it
PERIOD_NS = 40_000_000
SIZE = (64, 48)


def make_rig(**changes: Any) -> Rig:
    half = 0.5**0.5
    left = {
        "image_size_px": list(SIZE),
        "mm_per_px": [0.3, 0.3],
        "T_E_S": {"translation_m": [0.0031, 0.0, 0.14], "quaternion_xyzw": [0.0, -half, 0.0, half]},
    }
    right = left | {
        "T_E_S": {"translation_m": [-0.0031, 0.0, 0.14], "quaternion_xyzw": [half, 0.0, half, 0.0]}
    }
    return Rig.model_validate({"sensors": {"left": left, "right": right}} | changes)


def texture(seed: int, size: tuple[int, int] = SIZE) -> Image:
    """A smooth colourful image, as jpeg likes it."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def hand_pose(stamp_ns: int) -> FloatArray:
    """Constant-velocity screw: 0.3 rad/s about a tilted axis through a point 0.2 m away, 10 mm/s along it."""
    t = (stamp_ns - T0) / NS
    axis = np.array([0.6, 0.0, 0.8])
    centre = np.array([0.5, 0.1, 0.2])
    R = rotation_exp(0.3 * t * axis)
    offset = np.array([0.0, 0.2, 0.0])
    return transform(R @ rotation_exp([3.0, 0.2, 0.1]), centre + R @ offset + 0.01 * t * axis)


@dataclass
class ListStream:
    """A stream from memory."""

    samples: Sequence[Sample]
    rig: Rig = field(default_factory=make_rig)
    tool: Tool | None = None
    references: dict[Side, Image] = field(default_factory=dict)
    gel_models: dict[str, bytes] = field(default_factory=dict)

    def __iter__(self) -> Iterator[Sample]:
        return iter(self.samples)


def trial_samples(seconds: float = 2.0, *, right_lag_ns: int = 3_000_000, pose_hz: int = 100) -> list[Sample]:
    """Images at 25 Hz, poses, phases, openings and truth, ordered by stamp."""
    samples: list[Sample] = []
    frames = round(seconds * NS / PERIOD_NS)
    for k in range(frames):
        stamp = T0 + k * PERIOD_NS
        samples.append(ImageSample("left", stamp, texture(2 * k)))
        samples.append(ImageSample("right", stamp + right_lag_ns, texture(2 * k + 1)))
        samples.append(TruthSample(stamp, np.array([0.4 + 0.001 * k, 0.0, 0.01])))
    for k in range(-1, round(seconds * pose_hz) + 2):
        stamp = T0 + k * NS // pose_hz
        samples.append(PoseSample(stamp, hand_pose(stamp)))
    samples += [OpeningSample(T0 + k * NS // 10, 0.006 + 1e-5 * k) for k in range(round(seconds * 10))]
    marks = ((-0.02, Phase.ANCHORING), (0.5 * seconds - 0.01, Phase.RECONSTRUCTION), (seconds, Phase.END))
    samples += [PhaseSample(T0 + round(s * NS), phase) for s, phase in marks]
    return sorted(samples, key=lambda sample: sample.stamp_ns)


Edit = Callable[[str, str, dict[str, Any]], Any]


def write_raw(path: Path, rows: Sequence[tuple[str, str, int, dict[str, Any]]], **attachments: bytes) -> Path:
    """An MCAP with any content: rows of topic, type, log time, message; attachments by name (dots as __)."""
    with path.open("wb") as file, Writer(file, chunk_size=8192) as writer:
        for name, data in attachments.items():
            writer.add_attachment(0, 0, name.replace("__", "."), "application/octet-stream", data)
        schemas = {kind: writer.register_msgdef(kind, messages.schema_text(kind)) for _, kind, _, _ in rows}
        for topic, kind, log_time, message in rows:
            writer.write_message(topic, schemas[kind], message, log_time)
    return path
