"""Import a vendor's gel network from a torch file, without torch and without running its pickle.

A torch file is a zip archive: ``data.pkl`` describes tensors, ``data/<key>`` holds their raw numbers. The
pickle is read with an allow-list of the few names that a table of tensors needs; any other name is refused
before anything is called.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
import zlib
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiptrace.calibration.gel_onnx import mlp_to_onnx
from tiptrace.errors import CalibrationError
from tiptrace.perception.gel_model import Convention

CONVENTIONS: dict[str, Convention] = {
    # gelsightinc/gsrobotics: its code feeds both coordinates as integers, which are always 0;
    # what is pressed in comes out positive
    "gsrobotics": Convention(channels="bgr", coordinates="zero", output="normals", z_axis="in"),
    "gsrobotics-unit": Convention(channels="bgr", coordinates="unit", output="normals", z_axis="in"),
    "gsrobotics-rgb": Convention(channels="rgb", coordinates="zero", output="normals", z_axis="in"),
    # joehjhuang/gs_sdk: angles of the slope, linspace coordinates
    "gs-sdk": Convention(channels="bgr", coordinates="unit", output="angles"),
}

_MAX_MEMBER_BYTES = 16_000_000
_STORAGE_TYPES = {
    "FloatStorage": np.dtype("<f4"),
    "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
}


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What was imported.

    Attributes:
        layers: Sizes, input to output.
        convention: How it will be fed.
    """

    layers: tuple[int, ...]
    convention: Convention


def import_gel(weights: Path, out: Path, convention: Convention | str) -> ImportReport:
    """Turn a vendor's weights (``.pt``, ``.pth``) into a gel model.

    Args:
        weights: Torch zip file holding a state dict with ``fc1.weight``, ``fc1.bias``, …
        out: ONNX file to write.
        convention: How the network was trained, or one of the names in ``CONVENTIONS``.

    Raises:
        CalibrationError: not a torch file of that kind, a pickle that asks for anything but tensors, an
            unknown convention.
    """
    if isinstance(convention, str):
        if convention not in CONVENTIONS:
            raise CalibrationError(f"unknown convention '{convention}'; known: {', '.join(CONVENTIONS)}")
        convention = CONVENTIONS[convention]
    tensors = read_torch_tensors(weights)
    names = sorted({name.rsplit(".", 1)[0] for name in tensors if name.endswith(".weight")}, key=_layer_order)
    if not names or any(f"{name}.bias" not in tensors for name in names):
        raise CalibrationError(
            f"{weights}: holds no chain of layers with weight and bias; found {sorted(tensors)[:6]}"
        )
    matrices = [tensors[f"{name}.weight"].T for name in names]  # (n_in, n_out)
    biases = [tensors[f"{name}.bias"] for name in names]
    out.write_bytes(mlp_to_onnx(matrices, biases, convention, metadata={"source": weights.name}))
    return ImportReport(layers=(matrices[0].shape[0], *(m.shape[1] for m in matrices)), convention=convention)


def read_torch_tensors(path: Path) -> dict[str, NDArray[Any]]:
    """Tensors of a torch zip file by name; a nested ``state_dict`` is taken where there is one.

    Raises:
        CalibrationError: not such a file, or a pickle that names anything outside the allow-list.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickled = next((n for n in archive.namelist() if n.endswith("/data.pkl")), None)
            if pickled is None:
                raise CalibrationError(f"{path}: a zip file, but not one that torch wrote (no data.pkl)")
            content = _TensorReader(archive, pickled.removesuffix("data.pkl"), path).load()
    except (OSError, zipfile.BadZipFile) as error:
        raise CalibrationError(f"{path}: not a torch zip file of weights ({error})") from None
    except (
        pickle.UnpicklingError,
        EOFError,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
        ArithmeticError,
        MemoryError,
        RuntimeError,
        zlib.error,
    ) as error:
        raise CalibrationError(f"{path}: its table of tensors cannot be read ({error})") from None
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: holds a {type(content).__name__}, expected a table of tensors")
    return {str(k): v for k, v in content.items() if isinstance(v, np.ndarray)}


class _TensorReader(pickle.Unpickler):
    """An unpickler that knows tensors and nothing else."""

    def __init__(self, archive: zipfile.ZipFile, root: str, path: Path) -> None:
        self._archive, self._root, self._path = archive, root, path
        super().__init__(io.BytesIO(self._member("data.pkl")))

    def _member(self, name: str) -> bytes:
        """A file of the archive, if it is no larger than weights are: packed, a gigabyte may be a few kilobytes."""
        size = self._archive.getinfo(self._root + name).file_size
        if size > _MAX_MEMBER_BYTES:
            raise CalibrationError(f"{self._path}: {name} holds {size} bytes, too many for a gel network")
        return self._archive.read(self._root + name)

    def find_class(self, module: str, name: str) -> Any:
        """Allow-list: every other name is refused."""
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _rebuild_tensor
        if module == "torch" and name in _STORAGE_TYPES:
            return _STORAGE_TYPES[name]
        raise CalibrationError(
            f"{self._path}: its pickle asks for '{module}.{name}', which weights have no need of; refused"
        )

    def persistent_load(self, pid: Any) -> NDArray[Any]:
        """One storage: ('storage', dtype, key, device, count)."""
        _, dtype, key, _, count = pid
        data = self._member(f"data/{int(key)}")
        return np.frombuffer(data, dtype=dtype, count=int(count))


def _rebuild_tensor(
    storage: NDArray[Any], offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_unused: Any
) -> NDArray[Any]:
    """A tensor as a copy, checked against its storage."""
    if math.prod(size) > len(storage):
        raise ValueError("a tensor has more numbers than its storage")
    last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True))
    if offset < 0 or min((*size, 1)) < 0 or min((*stride, 0)) < 0 or last >= len(storage):
        raise ValueError("a tensor reaches outside its storage")
    view = np.lib.stride_tricks.as_strided(
        storage[offset:], shape=size, strides=tuple(s * storage.itemsize for s in stride)
    )
    return view.copy()


def _layer_order(name: str) -> tuple[int, str]:
    """fc2 before fc10."""
    digits = "".join(c for c in name if c.isdigit())
    return (int(digits) if digits else 0, name)
