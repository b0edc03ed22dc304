"""What an ONNX file asks for, before onnxruntime sees it: a small network and nothing else.

An ONNX file may refer to weights in any other file, loop without end, and make gigabytes out of a few bytes. A gel
network needs none of that, so its operators and sizes come from a short list. The file is read field by field
(protocol buffers: onnx.proto of the ONNX project names the numbers), so the onnx package is not needed.
"""

from __future__ import annotations

from collections.abc import Iterator

from tiptrace.errors import PerceptionError

MAX_BYTES = 2_000_000
_MAX_NODES, _MAX_WIDTH = 200, 1024
OPERATORS = (
    *(
        "Gemm",
        "MatMul",
        "Add",
        "Sub",
        "Mul",
        "Div",
        "Neg",
        "Identity",
        "Constant",
        "Cast",
        "Concat",
        "Slice",
        "Split",
    ),
    *("Relu", "LeakyRelu", "Elu", "Selu", "Gelu", "Sigmoid", "Tanh", "Softplus", "HardSigmoid", "HardSwish"),
    *("Sin", "Cos", "Clip", "BatchNormalization", "Dropout"),
)
# fields of onnx.proto
_MODEL_GRAPH, _MODEL_FUNCTIONS = 7, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_SPARSE = 1, 5, 15
_NODE_OPERATOR, _NODE_ATTRIBUTE, _NODE_DOMAIN = 4, 5, 7
_ATTRIBUTE_TENSOR = 5
_ATTRIBUTE_GRAPHS = {6, 10, 11, 22, 23}  # graphs within, sparse tensors
_TENSOR_DIMS, _TENSOR_EXTERNAL, _TENSOR_LOCATION = 1, 13, 14


def check_graph(onnx_bytes: bytes, source: str) -> None:
    """Refuse a model that is more than a small network with its weights in the file.

    Raises:
        PerceptionError: no ONNX file, or one that asks for something else.
    """
    if len(onnx_bytes) > MAX_BYTES:
        raise PerceptionError(
            f"{source}: {len(onnx_bytes)} bytes are too many for a gel model (limit {MAX_BYTES})"
        )
    try:
        fault = _model_fault(onnx_bytes)
    except (IndexError, ValueError):
        raise PerceptionError(f"{source}: not a readable ONNX file (its fields are damaged)") from None
    if fault:
        raise PerceptionError(
            f"{source}: gel model refused: {fault}; make it with 'tiptrace calibrate gel' or 'tiptrace import-gel'"
        )


def _model_fault(data: bytes) -> str:
    graphs = 0
    for number, value in _fields(data):
        if number == _MODEL_FUNCTIONS:
            return "it defines functions"
        if number == _MODEL_GRAPH:
            graphs += 1
            fault = _graph_fault(_bytes(value))
            if fault:
                return fault
    return "" if graphs == 1 else f"it holds {graphs} graphs"


def _graph_fault(data: bytes) -> str:
    nodes = 0
    for number, value in _fields(data):
        fault = ""
        if number == _GRAPH_NODE:
            nodes += 1
            fault = _node_fault(_bytes(value))
        elif number == _GRAPH_INITIALIZER:
            fault = _tensor_fault(_bytes(value))
        elif number == _GRAPH_SPARSE:
            fault = "it has sparse weights"
        if fault:
            return fault
    return "" if nodes <= _MAX_NODES else f"it has {nodes} operators (limit {_MAX_NODES})"


def _node_fault(data: bytes) -> str:
    operator = domain = ""
    for number, value in _fields(data):
        if number == _NODE_OPERATOR:
            operator = _bytes(value).decode()
        elif number == _NODE_DOMAIN:
            domain = _bytes(value).decode()
        elif number == _NODE_ATTRIBUTE:
            for inner, content in _fields(_bytes(value)):
                if inner in _ATTRIBUTE_GRAPHS:
                    return "an operator holds a graph of its own"
                if inner == _ATTRIBUTE_TENSOR and (fault := _tensor_fault(_bytes(content))):
                    return fault
    if domain not in ("", "ai.onnx") or operator not in OPERATORS:
        name = f"{domain}.{operator}" if domain else operator
        return f"operator {name!r} is none that a gel model needs ({', '.join(OPERATORS)})"
    return ""


def _tensor_fault(data: bytes) -> str:
    dims: list[int] = []
    for number, value in _fields(data):
        if number in (_TENSOR_EXTERNAL, _TENSOR_LOCATION) and value not in (0, b""):
            return "its weights lie in another file"
        if number == _TENSOR_DIMS:
            dims += _varints(value) if isinstance(value, bytes) else [value]
    if len(dims) > 2 or any(dim > _MAX_WIDTH for dim in dims):
        return f"weights of shape {dims} are wider than a gel model's (limit {_MAX_WIDTH} by {_MAX_WIDTH})"
    return ""


# --- protocol buffers ----------------------------------------------------------------------------------------


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Field numbers and values of one message."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == 0:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        size = {1: 8, 5: 4}.get(kind)
        if kind == 2:
            size, at = _varint(data, at)
        if size is None or at + size > len(data):
            raise ValueError("damaged")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for k in range(10):
        value |= (data[at + k] & 0x7F) << (7 * k)
        if not data[at + k] & 0x80:
            return value, at + k + 1
    raise ValueError("damaged")


def _varints(data: bytes) -> list[int]:
    found, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        found.append(value)
    return found


def _bytes(value: int | bytes) -> bytes:
    if isinstance(value, int):
        raise ValueError("damaged")
    return value
