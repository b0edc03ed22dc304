"""The calibrated gel: a small network from colour and place to slope, an ONNX file (paper, Sec. II-B)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.errors import PerceptionError
from tiptrace.perception.gel_graph import MAX_BYTES, check_graph
from tiptrace.types import FloatArray, IntArray

Float32Array = NDArray[np.float32]

METADATA_PREFIX = "tiptrace."
MAX_SLOPE = 4.0  # 76°: no gel stays in contact with anything steeper
_STEEPEST = np.float32(1.33)  # rad
_OUTPUTS = ("normals", "slopes", "angles")


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
            values[f.name] = text if options else _positive(text, f"{source}: gel model's {f.name}")
        return cls(**values)


class GelModel:
    """A gel network ready to run on one thread; safe to share between threads (it keeps no state)."""

    def __init__(self, onnx_bytes: bytes, source: str = "gel model") -> None:
        """Load from the bytes of an ONNX file.

        Raises:
            PerceptionError: no ONNX file, not (n, 5) → (n, 2), or without its convention.
        """
        import onnxruntime as ort

        check_graph(onnx_bytes, source)
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
        x, comma, y = text.partition(",")
        where = f"{self.source}: gel model's mm_per_px"
        return _positive(x, where), _positive(y if comma else x, where)

    def raw(self, features: Float32Array) -> Float32Array:
        """The network itself: (n, 5) → (n, 2).

        Raises:
            PerceptionError: its layers do not fit together.
        """
        try:
            result: Float32Array = self._session.run([self._output], {self._input: features})[0]
        except Exception as error:  # noqa: BLE001  (onnxruntime raises many types, some of them bare)
            raise PerceptionError(
                f"{self.source}: gel model cannot be run ({(str(error).splitlines() or [''])[0]})"
            ) from None
        if result.shape != (len(features), 2) or result.dtype != np.float32:
            raise PerceptionError(
                f"{self.source}: gel model gives {result.dtype} {result.shape} for {len(features)} pixels, "
                f"expected float32 ({len(features)}, 2)"
            )
        return result

    def slopes(
        self,
        colours: Float32Array,
        unit_uv: Float32Array,
        gain: FloatArray | None = None,
        offset: float = 0.0,
        which: IntArray | None = None,
    ) -> Float32Array:
        """Slopes (∂z/∂x, ∂z/∂y), (k, 2) m/m, of the gel surface (z out of the gel).

        Args:
            colours: (n, 3) in BGR order: grey levels 0 … 255 for ``background: none``, else ratio minus 1.
            unit_uv: (n, 2) u/W, v/H.
            gain: (3,) divides the colours; None: 1.
            offset: Is then added.
            which: (k,) rows wanted; None: all, k = n.
        """
        c = self.convention
        scale = np.ones(3) if gain is None else 1.0 / gain
        if c.background == "none":
            scale, offset = scale / c.input_scale, offset / c.input_scale
        features = _features(
            np.ascontiguousarray(colours, dtype=np.float32),
            np.ascontiguousarray(unit_uv, dtype=np.float32),
            np.arange(len(colours)) if which is None else which,
            scale.astype(np.float32),
            np.float32(offset),
            c.channels == "rgb",
            c.coordinates == "unit",
        )
        out = np.ascontiguousarray(self.raw(features))
        _to_slopes(out, _OUTPUTS.index(c.output), np.float32(-1.0 if c.z_axis == "in" else 1.0))
        return out


@compiled
def _features(
    colours: Float32Array,
    unit_uv: Float32Array,
    which: IntArray,
    scale: Float32Array,
    offset: np.float32,
    reverse: bool,
    placed: bool,
) -> Float32Array:
    """Network inputs (k, 5): colours of some rows scaled and ordered, and their place where it counts."""
    features = np.zeros((len(which), 5), dtype=np.float32)
    for row in range(len(which)):
        i = which[row]
        for c in range(3):
            features[row, 2 - c if reverse else c] = colours[i, c] * scale[c] + offset
        if placed:
            features[row, 3] = unit_uv[i, 0]
            features[row, 4] = unit_uv[i, 1]
    return features


@compiled
def _to_slopes(out: Float32Array, kind: int, sign: np.float32) -> None:
    """Network outputs (n, 2) of a kind (index in the list of outputs) to bounded slopes, in place."""
    most, least_n_z2 = np.float32(MAX_SLOPE), np.float32(0.05)
    for i in range(len(out)):
        a, b = out[i, 0], out[i, 1]
        if kind == 0:
            n_z2 = np.float32(1.0) - a * a - b * b
            scale = np.float32(-1.0) / np.sqrt(max(n_z2, least_n_z2))
            a, b = a * scale, b * scale
        elif kind == 2:
            a, b = np.tan(min(max(a, -_STEEPEST), _STEEPEST)), np.tan(min(max(b, -_STEEPEST), _STEEPEST))
        out[i, 0] = min(max(sign * a, -most), most) if np.isfinite(a) else np.float32(0.0)
        out[i, 1] = min(max(sign * b, -most), most) if np.isfinite(b) else np.float32(0.0)


def _positive(text: str, where: str) -> float:
    """A number from a model's metadata.

    Raises:
        PerceptionError: it is none, or not positive and finite.
    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < np.inf:
        raise PerceptionError(f"{where} is {text[:40]!r}, expected a positive number")
    return value


def _read(path: Path) -> bytes:
    """Bytes of a model file, no more of them than one has.

    Raises:
        PerceptionError: cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES + 1)
    except OSError as error:
        raise PerceptionError(f"{path}: cannot be read ({error.strerror})") from None


def load_gel_model(name_or_path_or_bytes: str | Path | bytes) -> GelModel:
    """Load a gel model by packaged name (``gelsight-mini-virtual``), path, or the bytes of an attachment.

    Raises:
        PerceptionError: no such model, or not a gel model.
    """
    if isinstance(name_or_path_or_bytes, bytes):
        return GelModel(name_or_path_or_bytes, "attached gel model")
    try:
        path, found = Path(name_or_path_or_bytes), Path(name_or_path_or_bytes).is_file()
    except (ValueError, OSError):  # a zero byte, a name too long
        path, found = Path(), False
    if found:
        return GelModel(_read(path), str(path))
    folder = files("tiptrace") / "models"
    known = [f.name for f in folder.iterdir()] if folder.is_dir() else []
    if f"{name_or_path_or_bytes}.onnx" in known:
        packaged = folder / f"{name_or_path_or_bytes}.onnx"
        return GelModel(packaged.read_bytes(), str(name_or_path_or_bytes))
    names = ", ".join(sorted(n.removesuffix(".onnx") for n in known if n.endswith(".onnx")))
    raise PerceptionError(
        f"gel model '{str(name_or_path_or_bytes)[:200]}' is neither a file nor a packaged model ({names or 'none'})"
    )
