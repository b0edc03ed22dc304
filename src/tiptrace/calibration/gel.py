"""Calibrate a gel from ball presses: ``tiptrace calibrate gel``."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tiptrace.calibration.gel_circles import (
    PressSamples,
    contact_samples,
    find_circles,
    in_one_place,
    locate,
)
from tiptrace.calibration.gel_data import Circle, Press, PressFolder, check_rig, read_press_folder
from tiptrace.calibration.gel_evaluation import PressScore, measured_slopes, score_press
from tiptrace.calibration.gel_network import HIDDEN, Progress, train_network
from tiptrace.calibration.gel_onnx import mlp_to_onnx
from tiptrace.calibration.gel_pictures import draw_press
from tiptrace.calibration.gel_shading import Shading, fit_shading
from tiptrace.config import Sensor
from tiptrace.perception.gel_model import Convention, GelModel
from tiptrace.types import FloatArray

_HELD_OUT = 5  # every fifth press
_PIXELS = 100_000  # for the final shading model


@dataclass(frozen=True, slots=True)
class GelTrainingReport:
    """How good a calibrated gel is, on presses that it was not trained on.

    Attributes:
        model: ONNX file that was written.
        trained_on: Images used.
        held_out: Scores of the others.
        normal_error_deg: Median over the held-out presses of their median normal error.
        depth_rms_m: Rms over the held-out presses of the depth error inside the contact.
        radius_error: Median over the held-out presses of |ball radius found / true − 1|.
        flatness_m: Rms slope of the untouched reference times one millimetre: what 1 mm of it would rise.
        max_slope: Steepest slope in the training presses; steeper ones are extrapolated.
        mm_per_px: Scale used.
        scale_is_assumed: True if nobody gave the scale.
        view_mm: Width and height of gel that the image shows at this scale.
        marker_pitch_mm: What the scale makes of the markers' pitch; None without dots.
        valid_px: (u_min, v_min, u_max, v_max) that the contacts of the training presses cover.
        one_place: True if the presses cover too little of the gel to teach its dependence on place; the model
            is then valid in ``valid_px`` only.
        circles: Contact of each press, found or refined.
        seconds: Time taken.
    """

    model: Path
    trained_on: tuple[str, ...]
    held_out: tuple[PressScore, ...]
    normal_error_deg: float
    depth_rms_m: float
    radius_error: float
    flatness_m: float
    max_slope: float
    mm_per_px: tuple[float, float]
    scale_is_assumed: bool
    view_mm: tuple[float, float]
    marker_pitch_mm: float | None
    valid_px: tuple[float, float, float, float]
    one_place: bool
    circles: dict[str, Circle]
    seconds: float


def train_gel(
    folder: Path,
    out: Path,
    *,
    seed: int = 0,
    mm_per_px: tuple[float, float] | None = None,
    sensor: Sensor | None = None,
    pictures: Path | None = None,
    progress: Progress | None = None,
) -> GelTrainingReport:
    """Train a gel network on a folder of ball presses and write it as ONNX.

    Args:
        folder: Holds ``reference.png``, ``presses.csv`` and the images (see :func:`read_press_folder`).
        out: ONNX file to write.
        seed: Decides held-out presses, samples and initial weights.
        mm_per_px: Scale (x, y) of the images; None: the sensor's, else the csv's, else 20 mm over the width.
        sensor: What the rig says of it: size and scale of the images, pitch of the markers.
        pictures: Folder for a picture of each held-out press; None: none are drawn.
        progress: Called with a label and the share done.

    Raises:
        CalibrationError: a folder that does not determine the gel, or a gel that is not the rig's.
        MissingExtraError: scikit-learn or onnx is not installed.
    """
    start = time.perf_counter()
    tell = progress or (lambda _label, _share: None)
    if mm_per_px is None and sensor is not None:
        mm_per_px = sensor.mm_per_px
    data = read_press_folder(folder, mm_per_px)
    if sensor is not None:
        check_rig(data, sensor)
    tell("finding the contacts", 0.0)
    rng = np.random.default_rng(seed)
    test, train = _split(len(data.presses), rng)
    training = replace(data, presses=tuple(data.presses[i] for i in train))
    found = find_circles(training)
    one_place = in_one_place(found, data)
    shading = shading_of(training, found, one_place=one_place)
    held_out = [locate(data.presses[i], data, shading) for i in test]
    convention = Convention(background="ratio", coordinates="zero" if one_place else "unit")
    network = train_network([shading], data.background, pixel_noise(data), convention, rng, tell)
    valid = coverage(found)
    described = metadata(data, valid, shading.max_slope, one_place=one_place)
    out.write_bytes(mlp_to_onnx(network.weights, network.biases, convention, metadata=described))
    gel = GelModel(out.read_bytes(), str(out))
    tested = [data.presses[i] for i in test]
    scores = tuple(score_press(gel, p, c, data) for p, c in zip(tested, held_out, strict=True))
    if pictures is not None:
        _draw(scores, tested, data, pictures)
    flat = measured_slopes(gel, data.reference, data.background, data.presses[0].dots)
    pitch = data.marker_pitch_px
    return GelTrainingReport(
        model=out,
        trained_on=tuple(data.presses[i].name for i in train),
        held_out=scores,
        normal_error_deg=float(np.median([s.normal_error_deg for s in scores])),
        depth_rms_m=float(np.sqrt(np.mean([s.depth_rms_m**2 for s in scores]))),
        radius_error=float(np.median([abs(s.radius_error) for s in scores])),
        flatness_m=float(np.sqrt(np.mean(flat**2))) * 1e-3,
        max_slope=shading.max_slope,
        mm_per_px=data.mm_per_px,
        scale_is_assumed=data.scale_is_assumed,
        view_mm=(data.reference.shape[1] * data.mm_per_px[0], data.reference.shape[0] * data.mm_per_px[1]),
        marker_pitch_mm=None if pitch is None else pitch * float(np.mean(data.mm_per_px)),
        valid_px=valid,
        one_place=one_place,
        circles={data.presses[i].name: c for i, c in zip(train + test, found + held_out, strict=True)},
        seconds=time.perf_counter() - start,
    )


def _split(n: int, rng: np.random.Generator) -> tuple[list[int], list[int]]:
    """Indices of the held-out presses and of the others."""
    shuffled = rng.permutation(n).tolist()
    held_out = max(n // _HELD_OUT, 1)
    return sorted(shuffled[:held_out]), sorted(shuffled[held_out:])


def _draw(scores: tuple[PressScore, ...], presses: list[Press], data: PressFolder, where: Path) -> None:
    where.mkdir(parents=True, exist_ok=True)
    for press, score in zip(presses, scores, strict=True):
        draw_press(score, press, data, where / f"{Path(score.name).stem}.png")


def shading_of(data: PressFolder, circles: list[Circle], *, one_place: bool) -> Shading:
    """Shading model from all presses of a folder."""
    most = max(_PIXELS // len(circles), 200)
    parts = [contact_samples(p, c, data, most=most) for p, c in zip(data.presses, circles, strict=True)]
    stacked = [np.concatenate([getattr(p, name) for p in parts]) for name in PressSamples.__slots__]
    return fit_shading(*stacked, place_degree=0 if one_place else 1)


def pixel_noise(data: PressFolder) -> FloatArray:
    """(3,) noise of a pixel after the chain's smoothing: half of what the reference shows against its mean."""
    residual = data.reference.astype(np.float64) - data.background
    return np.asarray(0.5 * 1.4826 * np.median(np.abs(residual), axis=(0, 1)) + 0.2)


def coverage(circles: list[Circle]) -> tuple[float, float, float, float]:
    """Rectangle (u_min, v_min, u_max, v_max) that the contacts cover, px."""
    c = np.array([(c.u, c.v, c.radius) for c in circles])
    low, high = np.min(c[:, :2] - c[:, 2:], axis=0), np.max(c[:, :2] + c[:, 2:], axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def metadata(
    data: PressFolder, valid: tuple[float, ...], max_slope: float, *, one_place: bool
) -> dict[str, str]:
    """What a network's file says of where it comes from and where it holds.

    Args:
        data: The presses.
        valid: Rectangle (u_min, v_min, u_max, v_max) that they cover, px.
        max_slope: Steepest slope in them.
        one_place: Whether the network takes no account of the place.
    """
    H, W = data.reference.shape[:2]
    return {
        "mm_per_px": ",".join(f"{s:.6g}" for s in data.mm_per_px),
        "image_size_px": f"{W},{H}",
        "valid_px": ",".join(f"{x:.1f}" for x in valid),
        "max_slope": f"{max_slope:.3f}",
        "hidden": "-".join(map(str, HIDDEN)),
        "presses": str(len(data.presses)),
        "one_place": "yes" if one_place else "no",
    }
