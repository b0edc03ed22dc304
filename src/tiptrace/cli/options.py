"""Options that several commands share: one name, one meaning, one help text."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

RigFile = Annotated[Path | None, typer.Option(help="rig.yaml, in place of the attached one.")]
MapFile = Annotated[
    Path | None, typer.Option("--map", help="map.yaml of another bag; `tiptrace inspect` proposes one.")
]
ReferenceLeft = Annotated[Path | None, typer.Option(help="Image of the untouched left gel.")]
ReferenceRight = Annotated[Path | None, typer.Option(help="Image of the untouched right gel.")]
ReferenceFrames = Annotated[str | None, typer.Option(help="Frames that show the untouched gel, e.g. 0:20.")]
Depth = Annotated[
    Literal["network", "none"], typer.Option(help="network, or none: without a calibrated gel.")
]
