"""A network for gels that are not calibrated, made on presses of many gels of one make.

It errs on each gel by how much that differs from the others: 4 % of the depth on virtual gels, against 1 % of a gel's
own network. Contacts and shading are found for each gel alone, since a mean shading would shift them; the network
learns from all shadings evenly, so that it knows where colours of different gels agree.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tiptrace.calibration.gel import coverage, metadata, pixel_noise
from tiptrace.calibration.gel_circles import PressSamples, contact_samples, find_circles, locate
from tiptrace.calibration.gel_data import MIN_PRESSES, Circle, Press, PressFolder, read_press_folder
from tiptrace.calibration.gel_evaluation import PressScore, score_press
from tiptrace.calibration.gel_network import Progress, train_network
from tiptrace.calibration.gel_onnx import mlp_to_onnx
from tiptrace.calibration.gel_shading import Shading, fit_change, fit_shading
from tiptrace.errors import CalibrationError
from tiptrace.perception.gel_model import Convention, GelModel
from tiptrace.types import FloatArray

_HELD_OUT = 5  # every fifth press of each gel
_PIXELS = 600  # of each press
_TAUGHT = 1.235  # slopes up to here; steeper than the presses show, or walls read too flat


@dataclass(frozen=True, slots=True)
class FamilyReport:
    """How good the network of a make is, on presses that it was not trained on.

    Attributes:
        gels: How many.
        trained_on: Presses.
        held_out: Scores of the others.
        max_slope: Steepest slope in the training presses.
        seconds: Time taken.
    """

    gels: int
    trained_on: int
    held_out: tuple[PressScore, ...]
    max_slope: float
    seconds: float


def train_family(
    folder: Path,
    out: Path,
    gels: int,
    *,
    mm_per_px: tuple[float, float],
    seed: int = 0,
    progress: Progress | None = None,
) -> FamilyReport:
    """Train the network of a make and write it as ONNX.

    Args:
        folder: Presses as for :func:`tiptrace.calibration.gel.train_gel`, all relit to the first gel's reference;
            press i is of gel i modulo ``gels``.
        out: ONNX file to write.
        gels: Number of gels.
        mm_per_px: Scale (x, y) of the images.
        seed: Decides samples and initial weights.
        progress: Called with a label and the share done.

    Raises:
        CalibrationError: too few gels, or presses of each.
        MissingExtraError: scikit-learn or onnx is not installed.
    """
    start = time.perf_counter()
    tell = progress or (lambda _label, _share: None)
    data = read_press_folder(folder, mm_per_px)
    if gels < 3 or len(data.presses) < gels * (MIN_PRESSES + 1):
        raise CalibrationError(
            f"{folder}: {len(data.presses)} presses of {gels} gels; a make needs 3 gels or more and "
            f"{MIN_PRESSES + 1} presses of each"
        )
    circles: list[Circle] = []
    held_out: list[tuple[Press, Circle]] = []
    samples: list[list[FloatArray]] = []
    for g in range(gels):
        tell("finding the contacts", g / gels)
        own = data.presses[g::gels]
        training = replace(
            data, presses=tuple(p for i, p in enumerate(own) if i % _HELD_OUT != _HELD_OUT - 1)
        )
        found = find_circles(training)
        samples.append(_stacked(training, found))
        circles += found
        shading = fit_shading(*samples[-1])
        held_out += [(p, locate(p, data, shading)) for p in own[_HELD_OUT - 1 :: _HELD_OUT]]
    shadings = _shadings(samples)
    convention, rng = Convention(background="ratio"), np.random.default_rng(seed)
    network = train_network(
        shadings, data.background, pixel_noise(data), convention, rng, tell, steepest=_TAUGHT
    )
    described = metadata(data, coverage(circles), shadings[0].max_slope, one_place=False) | {
        "gels": str(gels)
    }
    out.write_bytes(mlp_to_onnx(network.weights, network.biases, convention, metadata=described))
    gel = GelModel(out.read_bytes(), str(out))
    return FamilyReport(
        gels=gels,
        trained_on=len(circles),
        held_out=tuple(score_press(gel, p, c, data) for p, c in held_out),
        max_slope=shadings[0].max_slope,
        seconds=time.perf_counter() - start,
    )


def _stacked(data: PressFolder, circles: list[Circle]) -> list[FloatArray]:
    """Slopes, places, colours, background of all presses of a gel."""
    parts = [contact_samples(p, c, data, most=_PIXELS) for p, c in zip(data.presses, circles, strict=True)]
    return [np.concatenate([getattr(part, name) for part in parts]) for name in PressSamples.__slots__]


def _shadings(samples: list[list[FloatArray]]) -> list[Shading]:
    """Shading of each gel: that of all presses, and what its own presses add."""
    pooled = fit_shading(*(np.concatenate(columns) for columns in zip(*samples, strict=True)))
    return [replace(pooled, coefficients=pooled.coefficients + fit_change(pooled, *own)) for own in samples]
