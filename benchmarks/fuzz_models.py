"""Mutants of gel models and of torch weights."""

from __future__ import annotations

import io
import pickle
import sys
import zipfile
from collections import OrderedDict
from types import ModuleType
from typing import Any

import numpy as np
from fuzz_bytes import Rng, any_bytes


def external_data(data: bytes, rng: Rng) -> bytes:
    """Weights said to lie in another file."""
    import onnx

    model = onnx.load_from_string(data)
    tensor = model.graph.initializer[int(rng.integers(len(model.graph.initializer)))]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    place = ("/etc/passwd", "../secret.bin", "/dev/zero", "weights.bin")[int(rng.integers(4))]
    for key, value in (("location", place), ("offset", "0"), ("length", "640")):
        tensor.external_data.add(key=key, value=value)
    return bytes(model.SerializeToString())


def operator_bomb(data: bytes, rng: Rng) -> bytes:
    """Operators that make much out of little, never end, or are somebody's own."""
    import onnx
    from onnx import helper, numpy_helper

    model = onnx.load_from_string(data)
    graph = model.graph
    kind = int(rng.integers(4))
    if kind == 0:
        graph.initializer.append(numpy_helper.from_array(np.array([200_000, 20_000], np.int64), "shape"))
        graph.node.append(helper.make_node("ConstantOfShape", ["shape"], ["big"]))
        graph.node.append(helper.make_node("ReduceSum", ["big"], ["sum"]))
        graph.node[-3].output[0] = "before"
        graph.node.append(helper.make_node("Add", ["before", "sum"], ["output"]))
    elif kind == 1:
        body = helper.make_graph(
            [helper.make_node("Identity", ["go"], ["go_on"])],
            "body",
            [
                helper.make_tensor_value_info("i", onnx.TensorProto.INT64, []),
                helper.make_tensor_value_info("go", onnx.TensorProto.BOOL, []),
            ],
            [helper.make_tensor_value_info("go_on", onnx.TensorProto.BOOL, [])],
        )
        graph.initializer.append(numpy_helper.from_array(np.array(2**62, np.int64), "trips"))
        graph.initializer.append(numpy_helper.from_array(np.array(True), "true"))
        graph.node.insert(0, helper.make_node("Loop", ["trips", "true"], [], body=body))
    elif kind == 2:
        graph.node[0].op_type, graph.node[0].domain = "SystemCall", "com.example"
    else:
        graph.initializer.append(numpy_helper.from_array(np.zeros((20_000, 1, 2), np.float32), "wide"))
        graph.node[-1].output[0] = "before"
        graph.node.append(helper.make_node("Add", ["before", "wide"], ["output"]))
    return bytes(model.SerializeToString())


def model_metadata(data: bytes, rng: Rng) -> bytes:
    import onnx

    model = onnx.load_from_string(data)
    pair = model.metadata_props[int(rng.integers(len(model.metadata_props)))]
    pair.value = ("", "nan", "0", "inf", "abc", "-1", "1,2,3", "x" * 10000)[int(rng.integers(8))]
    return bytes(model.SerializeToString())


def model_dimensions(data: bytes, rng: Rng) -> bytes:
    import onnx

    model = onnx.load_from_string(data)
    tensor = model.graph.initializer[int(rng.integers(len(model.graph.initializer)))]
    tensor.dims[int(rng.integers(len(tensor.dims)))] = int(rng.choice([-1, 0, 1, 2**31, 2**62]))
    return bytes(model.SerializeToString())


MODELS = (any_bytes, any_bytes, external_data, operator_bomb, model_metadata, model_dimensions)


def any_model(data: bytes, rng: Rng) -> bytes:
    return MODELS[int(rng.integers(len(MODELS)))](data, rng)


def weights_file() -> bytes:
    """A torch file of a 5-8-2 network, as ``torch.save`` would write it."""
    return _torch_zip(
        {"fc1.weight": (8, 5), "fc1.bias": (8,), "fc2.weight": (2, 8), "fc2.bias": (2,)},
    )


def _torch_zip(shapes: dict[str, tuple[int, ...]], strides: bool = True, claim: int = 1) -> bytes:
    stand_ins = {name: ModuleType(name) for name in ("torch", "torch._utils")}

    class FloatStorage:
        pass

    def _rebuild_tensor_v2(*_: Any) -> None: ...

    FloatStorage.__module__, FloatStorage.__qualname__ = "torch", "FloatStorage"
    _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    stand_ins["torch"].FloatStorage = FloatStorage  # type: ignore[attr-defined]
    stand_ins["torch._utils"]._rebuild_tensor_v2 = _rebuild_tensor_v2  # type: ignore[attr-defined]

    class Tensor:
        def __init__(self, key: int, shape: tuple[int, ...]) -> None:
            self.key, self.shape = key, shape

        def __reduce__(self) -> Any:
            step = tuple(int(np.prod(self.shape[k + 1 :])) if strides else 0 for k in range(len(self.shape)))
            shape = (self.shape[0] * claim, *self.shape[1:])
            return _rebuild_tensor_v2, (Storage(self.key, self.shape), 0, shape, step, False, OrderedDict())

    class Storage:
        def __init__(self, key: int, shape: tuple[int, ...]) -> None:
            self.key, self.count = key, int(np.prod(shape))

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj: Any) -> Any:
            return (
                ("storage", FloatStorage, str(obj.key), "cpu", obj.count)
                if isinstance(obj, Storage)
                else None
            )

    kept = {name: sys.modules.get(name) for name in stand_ins}
    sys.modules.update(stand_ins)
    try:
        table = io.BytesIO()
        Pickler(table, protocol=2).dump({name: Tensor(k, s) for k, (name, s) in enumerate(shapes.items())})
    finally:
        for name, module in kept.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("archive/data.pkl", table.getvalue())
        for k, shape in enumerate(shapes.values()):
            values = np.random.default_rng(k).normal(size=shape).astype(np.float32)
            archive.writestr(f"archive/data/{k}", values.tobytes())
    return out.getvalue()


def any_weights(data: bytes, rng: Rng) -> bytes:
    kind = int(rng.integers(5))
    if kind == 0:  # strides of zero make gigabytes out of one number
        return _torch_zip({"fc1.weight": (8, 5), "fc1.bias": (8,)}, strides=False, claim=10**8)
    if kind in (1, 2):
        return _rewrite_zip(data, rng, bomb=kind == 1)
    return any_bytes(data, rng)


def _rewrite_zip(data: bytes, rng: Rng, bomb: bool) -> bytes:
    """A zip bomb in place of a tensor, or a pickle that asks for a command, or is changed."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            content = old.read(name)
            if bomb and name.endswith("data/0"):
                with new.open(name, "w", force_zip64=True) as entry:
                    for _ in range(1200):
                        entry.write(bytes(2**20))
                continue
            if not bomb and name.endswith(".pkl"):
                content = any_bytes(content, rng) if rng.integers(2) else b"cos\nsystem\n(S'touch pwned'\ntR."
            new.writestr(name, content)
    return out.getvalue()
