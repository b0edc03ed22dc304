"""``tiptrace import-gel``: a vendor's weights as a gel model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def import_gel(
    weights: Annotated[
        Path,
        typer.Argument(
            exists=True, dir_okay=False, help="The vendor's weights (.pt or .pth); torch is not needed."
        ),
    ],
    convention: Annotated[
        str,
        typer.Option(help="How they were trained: gsrobotics, gsrobotics-unit, gsrobotics-rgb or gs-sdk."),
    ],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")] = Path("gel.onnx"),
) -> None:
    """Import a vendor's gel network into the form that the other commands read.

    The file's pickle is not executed: anything in it but tensors is refused.

    Example: tiptrace import-gel nnmini.pt --convention gsrobotics --out gel.onnx
    """
    from tiptrace.calibration.gel_import import import_gel as convert
    from tiptrace.cli.files import check_writable

    check_writable(out)
    report = convert(weights, out, convention)
    c = report.convention
    typer.echo(
        f"{out}: layers {'-'.join(map(str, report.layers))}; fed {c.channels.upper()}/{c.input_scale:g}, "
        f"{c.coordinates} coordinates; gives {c.output}, z pointing {c.z_axis} of the gel"
    )
