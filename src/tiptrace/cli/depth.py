"""``tiptrace depth``: depth map of one tactile image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def depth(
    image: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Tactile image.")],
    reference: Annotated[
        Path, typer.Option(exists=True, dir_okay=False, help="Image of the same gel, untouched.")
    ],
    gel: Annotated[str, typer.Option(help="Gel model: a packaged name or an ONNX file.")],
    mm_per_px: Annotated[
        float | None, typer.Option(help="Scale of the image; default: the gel model's.", min=1e-4, max=1.0)
    ] = None,
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
    """Depth of a tactile image against the untouched gel, metric; gels with and without dots.

    Needs a gel model from 'calibrate gel' or 'import-gel'. Without one, 'track --patch' shows the contact in plane.

    Examples:

      tiptrace depth press.png --reference ref.png --gel gel.onnx --out depth

      tiptrace depth press.png --reference ref.png --gel vendor.onnx --mm-per-px 0.0625
    """
    import numpy as np

    from tiptrace.cli.files import check_writable
    from tiptrace.errors import PerceptionError
    from tiptrace.evaluation.atomic import write_atomic
    from tiptrace.perception.gel_model import load_gel_model
    from tiptrace.perception.still import depth_of_image, read_image

    check_writable(out / "depth.npy")
    picture, untouched = read_image(image), read_image(reference)
    model = load_gel_model(gel)
    scale = model.mm_per_px if mm_per_px is None else (mm_per_px, mm_per_px)
    if scale is None:
        raise PerceptionError(f"gel model '{gel}' does not say its scale; give --mm-per-px")
    result = depth_of_image(
        picture,
        untouched,
        model,
        (scale[0] * 1e-3, scale[1] * 1e-3),
        method,
        marker_threshold,
    )
    out.mkdir(parents=True, exist_ok=True)
    np.save(out / "depth.npy", result.depth_m)
    write_atomic(out / "depth.png", _draw(picture, result.depth_m, scale))
    deepest = float(result.depth_m.max()) * 1e3
    note = "" if result.zero_visible else "; no untouched gel visible, zero taken from the border"
    note += _outside(result.depth_m, model.metadata)
    typer.echo(f"{out / 'depth.npy'}: deepest {deepest:.3f} mm{note}   picture: {out / 'depth.png'}")


def _outside(depth_m: NDArray[np.float32], metadata: dict[str, str]) -> str:
    """A note if the contact lies where the gel model was not calibrated."""
    import numpy as np

    if metadata.get("tiptrace.one_place") != "yes":
        return ""
    u0, v0, u1, v1 = (float(x) for x in metadata["tiptrace.valid_px"].split(","))
    v, u = np.unravel_index(int(np.argmax(depth_m)), depth_m.shape)
    if u0 <= u <= u1 and v0 <= v <= v1:
        return ""
    return f"; the gel model was calibrated around u {u0:.0f}–{u1:.0f}, v {v0:.0f}–{v1:.0f} px only, this is elsewhere"


def _draw(image: object, depth_m: object, mm_per_px: tuple[float, float]) -> bytes:
    """Image and depth map side by side, axes and colours in mm, as PNG."""
    import io

    import numpy as np

    from tiptrace.evaluation import style

    picture, map_mm = np.asarray(image), np.asarray(depth_m) * 1e3
    height, width = picture.shape[0] * mm_per_px[1], picture.shape[1] * mm_per_px[0]
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
