"""A user's folder of ball presses: ``reference.png``, ``presses.csv`` and the images that it names."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.config import Sensor
from tiptrace.errors import CalibrationError, PerceptionError
from tiptrace.perception.background import check_untouched, has_dots, untouched_background
from tiptrace.perception.markers import check_image, check_pitch, detect_markers, dot_mask
from tiptrace.types import BoolArray, Image

MIN_PRESSES = 6
GELSIGHT_MINI_WIDTH_MM = 20.0  # seen by the full image at the usual 1/7 crop
_CIRCLE = ("center_u_px", "center_v_px", "contact_radius_px")

Float32Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Circle:
    """Where a ball touches: centre (u, v) and radius, px."""

    u: float
    v: float
    radius: float


@dataclass(frozen=True, slots=True)
class Press:
    """One press.

    Attributes:
        name: Image file.
        image: (H, W, 3) uint8 BGR.
        dots: (H, W) pixels that are marker.
        ball_diameter_mm: Of the ball.
        circle: Contact as the user gives it; None if it has to be found.
    """

    name: str
    image: Image
    dots: BoolArray
    ball_diameter_mm: float
    circle: Circle | None


@dataclass(frozen=True, slots=True)
class PressFolder:
    """All presses of one gel.

    Attributes:
        reference: (H, W, 3) uint8 BGR, the untouched gel.
        background: (H, W, 3) float32, the reference smoothed, without its dots and its noise.
        presses: At least six.
        mm_per_px: Scale (x, y).
        scale_is_assumed: True if nobody gave the scale.
        marker_pitch_px: Median distance to the nearest marker; None without dots.
    """

    reference: Image
    background: Float32Map
    presses: tuple[Press, ...]
    mm_per_px: tuple[float, float]
    scale_is_assumed: bool
    marker_pitch_px: float | None


def read_press_folder(folder: Path, mm_per_px: tuple[float, float] | None = None) -> PressFolder:
    """Read and check a folder.

    ``presses.csv`` has the columns ``image, ball_diameter_mm`` and optionally ``center_u_px, center_v_px,
    contact_radius_px`` and ``mm_per_px``.

    Args:
        folder: Where the files are.
        mm_per_px: Scale (x, y); None: the csv's, else 20 mm over the image's width.

    Raises:
        CalibrationError: a file or column is missing, an image cannot be read or has another size, the reference
            is touched, too few presses.
    """
    reference = _read_image(folder / "reference.png")
    rows = _read_rows(folder / "presses.csv")
    dotted = has_dots(reference)
    presses = tuple(_press(folder, row, line, reference, dotted) for line, row in enumerate(rows, start=2))
    if len(presses) < MIN_PRESSES:
        raise CalibrationError(
            f"{folder}: {len(presses)} presses, need at least {MIN_PRESSES} (20 to 40 spread over the gel are good)"
        )
    given = mm_per_px or _given_scale(rows, folder / "presses.csv")
    scale = GELSIGHT_MINI_WIDTH_MM / reference.shape[1]
    try:
        check_untouched(reference)
    except PerceptionError as error:
        raise CalibrationError(f"{folder / 'reference.png'}: {error}") from None
    return PressFolder(
        reference=reference,
        background=untouched_background(reference),
        presses=presses,
        mm_per_px=given or (scale, scale),
        scale_is_assumed=given is None,
        marker_pitch_px=_pitch(reference) if dotted else None,
    )


def check_rig(folder: PressFolder, sensor: Sensor) -> None:
    """Refuse presses of another gel, or another crop, than the rig says.

    Raises:
        CalibrationError: other image size, or another pitch of the markers.
    """
    try:
        check_image(folder.reference, sensor.image_size_px)
        if folder.marker_pitch_px is not None:
            check_pitch(detect_markers(folder.reference), sensor.marker_pitch_mm, folder.mm_per_px)
    except PerceptionError as error:
        raise CalibrationError(f"reference.png: {error}") from None


def _pitch(reference: Image) -> float:
    uv = detect_markers(reference).uv_px
    distance = np.linalg.norm(uv[:, None] - uv[None], axis=2) + np.diag(np.full(len(uv), np.inf))
    return float(np.median(distance.min(axis=1)))


def _read_image(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        reason = "is not a readable image" if path.is_file() else "is missing"
        raise CalibrationError(
            f"{path} {reason}; a calibration folder holds reference.png, presses.csv, images"
        )
    try:
        check_image(np.asarray(image, dtype=np.uint8))
    except PerceptionError as error:
        raise CalibrationError(f"{path}: {error}") from None
    return np.asarray(image, dtype=np.uint8)


def _read_rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [
                {k.strip(): (v or "").strip() for k, v in row.items() if k} for row in csv.DictReader(file)
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(
            f"{path}: cannot be read ({error}); it lists the presses as image, ball_diameter_mm"
        ) from None
    for column in ("image", "ball_diameter_mm"):
        if rows and column not in rows[0]:
            raise CalibrationError(f"{path}: column '{column}' is missing; it has {', '.join(rows[0])}")
    return rows


def _given_scale(rows: list[dict[str, str]], path: Path) -> tuple[float, float] | None:
    """Scale (x, y) of the csv's optional column."""
    texts = {row["mm_per_px"] for row in rows if row.get("mm_per_px")}
    if not texts:
        return None
    if len(texts) > 1:
        raise CalibrationError(f"{path}: mm_per_px differs between rows; give one scale")
    text = texts.pop()
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if not 1e-4 <= scale <= 1.0:
        raise CalibrationError(f"{path}: mm_per_px is '{text}'; a GelSight Mini has 0.06 at 320 px width")
    return scale, scale


def _press(folder: Path, row: dict[str, str], line: int, reference: Image, dotted: bool) -> Press:
    where = f"{folder / 'presses.csv'}, line {line}"
    image = _read_image(folder / row["image"])
    if image.shape != reference.shape:
        raise CalibrationError(
            f"{folder / row['image']} is {image.shape[1]}×{image.shape[0]} px, reference.png is "
            f"{reference.shape[1]}×{reference.shape[0]}: take all images with the same crop"
        )
    try:
        diameter = float(row["ball_diameter_mm"])
        values = [float(row[c]) for c in _CIRCLE if row.get(c)]
    except ValueError as error:
        raise CalibrationError(f"{where}: {error}") from None
    if not 0.5 <= diameter <= 50.0:
        raise CalibrationError(f"{where}: ball_diameter_mm is {diameter:g}; balls of 2 to 12 mm are usual")
    if len(values) not in (0, 3):
        raise CalibrationError(f"{where}: give all of {', '.join(_CIRCLE)} or none")
    dots = dot_mask(image, 2) if dotted else np.zeros(image.shape[:2], dtype=np.bool_)
    return Press(row["image"], image, dots, diameter, Circle(*values) if values else None)
