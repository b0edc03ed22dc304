"""Figures inside a page that stands alone, and the pages' templates."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tiptrace.evaluation.style import FORMATS, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = "figures"
_PX_PER_INCH = 138  # a full-width figure fills the page


@dataclass(frozen=True, slots=True)
class EmbeddedFigure:
    """A figure as a page holds it."""

    name: str
    title: str
    caption: str
    data_uri: str
    width_px: int


def embed_figure(
    folder: Path,
    name: str,
    title: str,
    caption: str,
    figure: Figure,
    bitmap: bool = False,
    formats: tuple[str, ...] = FORMATS,
) -> EmbeddedFigure:
    """Save a figure in the formats asked for and embed it, as SVG unless a bitmap is asked for."""
    kind, mime = ("png", "image/png") if bitmap and "png" in formats else ("svg", "image/svg+xml")
    save_figure(figure, folder / name, tuple(dict.fromkeys((*formats, kind))))
    encoded = base64.b64encode((folder / f"{name}.{kind}").read_bytes()).decode()
    width_px = round(_PX_PER_INCH * figure.get_figwidth())
    return EmbeddedFigure(name, title, caption, f"data:{mime};base64,{encoded}", width_px)


def render(template: str, **values: object) -> str:
    """Fill a template of this package; everything is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("tiptrace.evaluation")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.get_template(template).render(**values)
