"""One look for all figures: Okabe-Ito colours, readable in print, light background; bitmap and vector."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE, GREY = "#F0E442", "#0072B2", "#D55E00", "#CC79A7", "#7A7A7A"

TRUTH = BLACK
FORMATS = ("png", "svg")

# Known methods keep their colour from figure to figure; dashes tell them apart without colour.
_METHODS: dict[str, tuple[str, str]] = {
    "paper": (BLUE, "-"),
    "full": (VERMILLION, "-"),
    "ee-only": (ORANGE, "--"),
    "ee-oracle": (GREEN, "-."),
    "nominal-tip": (PURPLE, ":"),
    "local-anchoring": (SKY, "--"),
}
_OTHERS = (PURPLE, GREEN, SKY, GREY)

_RC: Any = {  # Matplotlib knows its keys as literals; the type checker need not
    "figure.dpi": 100,
    "savefig.dpi": 180,
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.facecolor": "white",
    "svg.hashsalt": "tiptrace",
}


def method_style(name: str, index: int = 0) -> tuple[str, str]:
    """Colour and dash pattern of a method."""
    return _METHODS.get(name, (_OTHERS[index % len(_OTHERS)], "-"))


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw with the house style and without a display."""
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcParams.update(_RC)
        yield


def new_figure(width_in: float = 7.2, height_in: float = 3.0) -> Figure:
    """A figure that belongs to no window and no global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def save_figure(figure: Figure, stem: Path, formats: tuple[str, ...] = FORMATS) -> None:
    """Write ``stem.png``, ``stem.svg`` …; the files carry no date, so that equal data give equal files."""
    for suffix in formats:
        metadata = {"Date": None} if suffix == "svg" else {"CreationDate": None} if suffix == "pdf" else None
        figure.savefig(stem.with_suffix(f".{suffix}"), format=suffix, metadata=metadata)
