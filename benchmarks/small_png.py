"""Pictures for the documentation: PNG with a palette, half the size of full colour."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_small(figure: Figure, path: Path, dpi: int = 100, colours: int = 256) -> None:
    """Write a figure as a PNG of at most so many colours."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    path.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(buffer) as image:
        rgb = image.convert("RGB")
        palette = rgb.quantize(colours, method=Image.Quantize.MEDIANCUT)
        small = rgb.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
    small.save(path, optimize=True)
