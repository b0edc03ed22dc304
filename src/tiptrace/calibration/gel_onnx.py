"""Write a small fully connected network as an ONNX file that says its own convention."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import CalibrationError, MissingExtraError
from tiptrace.perception.gel_model import METADATA_PREFIX, Convention

Activation = Literal["Relu", "Tanh"]


def mlp_to_onnx(
    weights: Sequence[NDArray[np.floating]],
    biases: Sequence[NDArray[np.floating]],
    convention: Convention,
    *,
    activation: Activation = "Relu",
    metadata: dict[str, str] | None = None,
) -> bytes:
    """Bytes of an ONNX file with input (n, 5) and output (n, 2), float32.

    Args:
        weights: One (n_in, n_out) matrix per layer, ``x @ W + b``.
        biases: One (n_out,) vector per layer.
        convention: What goes in and comes out.
        activation: After every layer but the last.
        metadata: Further key-value pairs; keys get the prefix ``tiptrace.``.

    Raises:
        CalibrationError: layers that do not chain from 5 to 2.
        MissingExtraError: onnx is not installed.
    """
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise MissingExtraError("onnx", "calibrate") from None
    sizes = [weights[0].shape[0], *(W.shape[1] for W in weights)]
    chained = [W.shape for W in weights] == list(pairwise(sizes))
    if sizes[0] != 5 or sizes[-1] != 2 or not chained:
        raise CalibrationError(f"a gel network maps 5 numbers to 2; this one has layers {sizes}")
    nodes, initializers, x = [], [], "features"
    for i, (W, b) in enumerate(zip(weights, biases, strict=True)):
        initializers.append(numpy_helper.from_array(np.ascontiguousarray(W, dtype=np.float32), f"W{i}"))
        initializers.append(numpy_helper.from_array(np.ascontiguousarray(b, dtype=np.float32), f"b{i}"))
        last = i == len(weights) - 1
        y = "output" if last else f"linear{i}"
        nodes.append(helper.make_node("Gemm", [x, f"W{i}", f"b{i}"], [y]))
        if not last:
            nodes.append(helper.make_node(activation, [y], [f"hidden{i}"]))
            x = f"hidden{i}"
    graph = helper.make_graph(
        nodes,
        "gel",
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ["n", 5])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, ["n", 2])],
        initializers,
    )
    model = helper.make_model(graph, producer_name="tiptrace", opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    pairs = convention.metadata() | {METADATA_PREFIX + key: value for key, value in (metadata or {}).items()}
    helper.set_model_props(model, pairs)
    checker.check_model(model)
    return bytes(model.SerializeToString())
