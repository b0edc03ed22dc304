"""The calibrated gel: a small network from colour and place to slope, an ONNX file (paper, Sec. II-B)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import PerceptionError

Float32Array = NDArray[np.float32]

METADATA_PREFIX = "tiptrace."
MAX_SLOPE = 4.0  # 76°: no gel stays in contact with anything steeper


@dataclass(frozen=True, slots=True)
class Convention:
    """What goes into a gel network and what comes out. It travels in the ONNX file's metadata.

    Attributes:
        channels: Order of the three colours.
        coordinates: ``unit``: u/W and v/H; ``zero``: both 0, whatever the pixel.
        background: ``none``: colours are grey levels over ``input_scale``; ``ratio``: grey levels over those
            of the untouched gel, minus 1 (lamps may change and dark corners count as much as the bright middle).
        input_scale: Grey level that becomes 1 (``background: none`` only).
        output: ``normals``: (n_x, n_y) of the unit surface normal, slopes are −n_x/n_z and −n_y/n_z;
            ``slopes``: (∂z/∂x, ∂z/∂y); ``angles``: their arctangents.
        z_axis: Where the network's own z points: ``out`` of the gel as in F_S, or ``in`` (height is positive
            where something is pressed in; one vendor's network has it so).
    """

    channels: Literal["bgr", "rgb"] = "bgr"
    coordinates: Literal["unit", "zero"] = "unit"
    background: Literal["none", "ratio"] = "none"
    input_scale: float = 255.0
    output: Literal["normals", "slopes", "angles"] = "normals"
    z_axis: Literal["out", "in"] = "out"

    def colours(self, image: Float32Array, background: Float32Array) -> Float32Array:
        """What :meth:`GelModel.slopes` wants of an image (..., 3): itself, or its ratio to the background − 1."""
        if self.background == "none":
            return image
        return np.asarray(image / np.maximum(background, np.float32(1)) - np.float32(1), dtype=np.float32)

    def metadata(self) -> dict[str, str]:
        """Key-value pairs for the ONNX file."""
        return {METADATA_PREFIX + f.name: str(getattr(self, f.name)) for f in fields(self)}

    @classmethod
    def from_metadata(cls, metadata: dict[str, str], source: str) -> Convention:
        """Read back what :meth:`metadata` wrote.

        Raises:
            PerceptionError: a key is missing or has an unknown value.
        """
        values: dict[str, Any] = {}
        hints = get_type_hints(cls)
        for f in fields(cls):
            text = metadata.get(METADATA_PREFIX + f.name)
            if text is None:
                raise PerceptionError(
                    f"{source}: gel model does not say its convention ('{METADATA_PREFIX}{f.name}' is "
                    "missing); make it with 'tiptrace calibrate gel' or 'tiptrace import-gel'"
                )
            options = get_args(hints[f.name])
            if options and text not in options:
                raise PerceptionError(
                    f"{source}: gel model has {f.name} = '{text}'; known: {', '.join(options)}"
                )
            values[f.name] = text if options else float(text)
        return cls(**values)


class GelModel:
    """A gel network ready to run on one thread; safe to share between threads (it keeps no state)."""

    def __init__(self, onnx_bytes: bytes, source: str = "gel model") -> None:
        """Load from the bytes of an ONNX file.

        Raises:
            PerceptionError: no ONNX file, not (n, 5) → (n, 2), or without its convention.
        """
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.enable_mem_pattern = True
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(onnx_bytes, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  (onnxruntime raises many types, some of them bare)
            raise PerceptionError(
                f"{source}: not a readable ONNX file ({str(error).splitlines()[0]})"
            ) from None
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shapes = ([i.shape[1:] for i in inputs], [o.shape[1:] for o in outputs])
        if shapes != ([[5]], [[2]]):
            raise PerceptionError(
                f"{source}: a gel model maps (n, 5) to (n, 2), this one {shapes[0]} to {shapes[1]}"
            )
        self._input, self._output = inputs[0].name, outputs[0].name
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)
        self.convention = Convention.from_metadata(self.metadata, source)
        self.source = source

    @property
    def mm_per_px(self) -> tuple[float, float] | None:
        """Scale (x, y) of the images that it was calibrated on; None if not recorded."""
        text = self.metadata.get(METADATA_PREFIX + "mm_per_px")
        if text is None:
            return None
        x, y = (float(part) for part in text.split(","))
        return x, y

    def raw(self, features: Float32Array) -> Float32Array:
        """The network itself: (n, 5) → (n, 2)."""
        result: Float32Array = self._session.run([self._output], {self._input: features})[0]
        return result

    def slopes(self, colours: Float32Array, unit_uv: Float32Array) -> Float32Array:
        """Slopes (∂z/∂x, ∂z/∂y), (n, 2) m/m, of the gel surface (z out of the gel).

        Args:
            colours: (n, 3) in BGR order: grey levels 0 … 255 for ``background: none``, else ratio minus 1.
            unit_uv: (n, 2) u/W, v/H.
        """
        c = self.convention
        features = np.zeros((len(colours), 5), dtype=np.float32)
        features[:, :3] = colours if c.channels == "bgr" else colours[:, ::-1]
        if c.background == "none":
            features[:, :3] *= np.float32(1.0 / c.input_scale)
        if c.coordinates == "unit":
            features[:, 3:] = unit_uv
        return self._to_slopes(self.raw(features))

    def _to_slopes(self, out: Float32Array) -> Float32Array:
        if self.convention.output == "slopes":
            slopes = out
        elif self.convention.output == "angles":
            slopes = np.tan(np.clip(out, -1.33, 1.33))
        else:
            n_z2 = np.float32(1.0) - out[:, 0] * out[:, 0] - out[:, 1] * out[:, 1]
            slopes = np.asarray(-out / np.sqrt(np.maximum(n_z2, 0.05))[:, None], dtype=np.float32)  # (n, 2)
        if self.convention.z_axis == "in":
            slopes = -slopes
        if not np.isfinite(slopes.sum()):
            slopes = np.nan_to_num(slopes, nan=0.0)
        bounded: Float32Array = np.clip(slopes, -MAX_SLOPE, MAX_SLOPE)
        return bounded


def load_gel_model(name_or_path_or_bytes: str | Path | bytes) -> GelModel:
    """Load a gel model by packaged name (``gelsight-mini-virtual``), path, or the bytes of an attachment.

    Raises:
        PerceptionError: no such model, or not a gel model.
    """
    if isinstance(name_or_path_or_bytes, bytes):
        return GelModel(name_or_path_or_bytes, "attached gel model")
    path = Path(name_or_path_or_bytes)
    if path.is_file():
        return GelModel(path.read_bytes(), str(path))
    folder = files("tiptrace") / "models"
    packaged = folder / f"{name_or_path_or_bytes}.onnx"
    if packaged.is_file():
        return GelModel(packaged.read_bytes(), str(name_or_path_or_bytes))
    known = [f.name for f in folder.iterdir()] if folder.is_dir() else []
    names = ", ".join(sorted(n.removesuffix(".onnx") for n in known if n.endswith(".onnx")))
    raise PerceptionError(
        f"gel model '{name_or_path_or_bytes}' is neither a file nor a packaged model ({names or 'none'})"
    )
