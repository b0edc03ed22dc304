"""``tiptrace depth``: depth map of one tactile image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def depth(
    image: Annotated[Path, typer.Argument(help="Tactile image.")],
    reference: Annotated[Path, typer.Option(help="Image of the same gel, untouched.")],
    gel: Annotated[str, typer.Option(help="Gel model: a packaged name or an ONNX file.")],
    mm_per_px: Annotated[float, typer.Option(help="Scale of the image.", min=1e-4, max=1.0)],
    out: Annotated[
        Path, typer.Option(help="Folder for depth.npy (m, positive = pressed in) and depth.png.")
    ] = Path("depth"),
    method: Annotated[
        Literal["full", "paper"], typer.Option(help="full: dots masked by shape; paper: by grey level.")
    ] = "full",
    marker_threshold: Annotated[
        tuple[float, float], typer.Option(help="Grey levels that count as marker (paper).")
    ] = (0.0, 70.0),
) -> None:
    """Depth of a tactile image against the untouched gel, metric.

    Example: tiptrace depth press.png --reference ref.png --gel gel.onnx --mm-per-px 0.0625 --out depth
    """
    import numpy as np

    from tiptrace.evaluation.atomic import write_atomic
    from tiptrace.perception.gel_model import load_gel_model
    from tiptrace.perception.still import depth_of_image, read_image

    picture, untouched = read_image(image), read_image(reference)
    result = depth_of_image(
        picture,
        untouched,
        load_gel_model(gel),
        (mm_per_px * 1e-3, mm_per_px * 1e-3),
        method,
        marker_threshold,
    )
    out.mkdir(parents=True, exist_ok=True)
    np.save(out / "depth.npy", result.depth_m)
    write_atomic(out / "depth.png", _draw(picture, result.depth_m, mm_per_px))
    deepest = float(result.depth_m.max()) * 1e3
    note = "" if result.zero_visible else "; no untouched gel visible, zero taken from the border"
    typer.echo(f"{out / 'depth.npy'}: deepest {deepest:.3f} mm{note}   picture: {out / 'depth.png'}")


def _draw(image: object, depth_m: object, mm_per_px: float) -> bytes:
    """Image and depth map side by side, axes and colours in mm, as PNG."""
    import io

    import numpy as np

    from tiptrace.evaluation import style

    picture, map_mm = np.asarray(image), np.asarray(depth_m) * 1e3
    height, width = picture.shape[0] * mm_per_px, picture.shape[1] * mm_per_px
    extent = (-width / 2, width / 2, height / 2, -height / 2)
    figure = style.new_figure(7.2, 3.0)
    left, right = figure.subplots(1, 2)
    left.imshow(picture[..., ::-1], extent=extent)
    left.set(title="Tactile image", xlabel="x_S [mm]", ylabel="y_S [mm]")
    shown = right.imshow(map_mm, extent=extent, cmap="cividis")
    right.set(title="Indentation", xlabel="x_S [mm]")
    figure.colorbar(shown, ax=right, label="depth [mm]")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return buffer.getvalue()
