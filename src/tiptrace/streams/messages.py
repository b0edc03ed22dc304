"""ROS messages to samples and back; units are checked here, once, for recordings of any origin."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from tiptrace.errors import GeometryError
from tiptrace.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion, transform
from tiptrace.streams.definitions import schema_text as schema_text
from tiptrace.streams.image_bytes import decode_image
from tiptrace.streams.topics import NS
from tiptrace.types import FloatArray, Image, Phase

_REACH_M = 3.0  # no arm that holds a GelSight Mini reaches further: longer vectors are millimetres
_OPENING_MAX_M = 0.3  # rig.yaml's own limit
_FLOAT64 = 8  # sensor_msgs/msg/PointField
_POINT_DTYPES = {7: "f4", 8: "f8"}


class MessageError(ValueError):
    """A message whose content cannot be meant; the text goes after '<file>: <topic>: '."""


# --- messages to values ------------------------------------------------------------------------------------


def image_from_compressed(message: Any) -> Image:
    """``CompressedImage`` → (height, width, 3) BGR.

    Raises:
        MessageError: no png or jpeg that can be decoded.
    """
    image = decode_image(message.data)
    if image is None:
        raise MessageError(f"the {message.format or 'compressed'} data cannot be decoded as png or jpeg")
    return image


_CONVERSIONS: dict[str, tuple[int, int | None]] = {  # encoding → channels, conversion to BGR
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, cv2.COLOR_GRAY2BGR),
}


def image_from_raw(message: Any) -> Image:
    """``Image`` → (height, width, 3) BGR; row padding is removed.

    Raises:
        MessageError: an encoding that is not 8-bit colour or grey, or too few bytes.
    """
    if message.encoding not in _CONVERSIONS:
        valid = ", ".join(_CONVERSIONS)
        raise MessageError(f"image encoding {message.encoding!r} is not supported; supported: {valid}")
    channels, conversion = _CONVERSIONS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, dtype=np.uint8)
    if step < width * channels or len(data) < height * step or not height * width:
        raise MessageError(f"{len(data)} bytes do not make a {width}x{height} {message.encoding} image")
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    image = np.ascontiguousarray(rows).reshape(height, width, channels)
    return np.asarray(image if conversion is None else cv2.cvtColor(image, conversion), dtype=np.uint8)


def pose_from(position: Any, orientation: Any) -> FloatArray:
    """Position (m) and quaternion (xyzw) fields → (4, 4).

    Raises:
        MessageError: not finite, further than an arm reaches (millimetres), or no unit quaternion.
    """
    t = point_from(position)
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64)
    try:
        return transform(rotation_from_quaternion(q), t)
    except GeometryError:
        raise MessageError(
            f"quaternion {np.round(q, 4).tolist()} is not a unit quaternion (norm {np.linalg.norm(q):.4g}); "
            "expected x, y, z, w"
        ) from None


def point_from(point: Any) -> FloatArray:
    """Point or vector fields → (3,) m.

    Raises:
        MessageError: not finite, or further than an arm reaches (millimetres).
    """
    p = np.array([point.x, point.y, point.z], dtype=np.float64)
    if not np.all(np.isfinite(p)):
        raise MessageError("position is not finite")
    if np.max(np.abs(p)) > _REACH_M:
        raise MessageError(
            f"position {np.round(p, 3).tolist()} is beyond {_REACH_M:g} m: it looks like millimetres; "
            "publish metres"
        )
    return p


def opening_from(message: Any) -> float:
    """``Float64`` → gripper opening, m.

    Raises:
        MessageError: not finite, negative, or larger than a gripper opens (millimetres).
    """
    opening = float(message.data)
    if not 0.0 <= opening <= _OPENING_MAX_M:
        raise MessageError(f"opening {opening:g} m is not between 0 and {_OPENING_MAX_M:g}; publish metres")
    return opening


def phase_from(message: Any) -> Phase:
    """``String`` → phase.

    Raises:
        MessageError: an unknown name.
    """
    try:
        return Phase(str(message.data))
    except ValueError:
        valid = ", ".join(phase.value for phase in Phase)
        raise MessageError(f"unknown phase {message.data!r}; valid: {valid}") from None


def markers_from(message: Any) -> FloatArray:
    """``PointCloud2`` with fields x, y, z → (n, 3) m in F_S, NaN where a marker was not seen.

    Raises:
        MessageError: missing fields, integer fields, too few bytes.
    """
    fields = {field.name: field for field in message.fields}
    order = ">" if message.is_bigendian else "<"
    n, step = int(message.width) * int(message.height), int(message.point_step)
    data = bytes(message.data)
    columns = []
    for name in "xyz":
        if name not in fields or fields[name].datatype not in _POINT_DTYPES:
            raise MessageError("marker points need floating-point fields x, y, z")
        dtype = np.dtype(order + _POINT_DTYPES[fields[name].datatype])
        offset = int(fields[name].offset)
        if len(data) < n * step or offset + dtype.itemsize > step:
            raise MessageError(f"{len(data)} bytes do not hold {n} marker points")
        columns.append(np.ndarray((n,), dtype, data, offset, (step,)) if n else np.empty(0))
    x_S = np.stack(columns, axis=-1).astype(np.float64)  # (n, 3)
    if np.any(np.abs(x_S) > 0.1):
        raise MessageError("marker positions are beyond 0.1 m: they look like millimetres; publish metres")
    return x_S


IMAGE_READERS: dict[str, Callable[[Any], Image]] = {
    "sensor_msgs/msg/CompressedImage": image_from_compressed,
    "sensor_msgs/msg/Image": image_from_raw,
}
POSE_READERS: dict[str, Callable[[Any], FloatArray]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: pose_from(m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/TransformStamped": lambda m: pose_from(m.transform.translation, m.transform.rotation),
}
MARKER_READERS: dict[str, Callable[[Any], FloatArray]] = {"sensor_msgs/msg/PointCloud2": markers_from}
OPENING_READERS: dict[str, Callable[[Any], float]] = {
    "std_msgs/msg/Float64": opening_from,
    "std_msgs/msg/Float32": opening_from,
}
PHASE_READERS: dict[str, Callable[[Any], Phase]] = {"std_msgs/msg/String": phase_from}
TRUTH_READERS: dict[str, Callable[[Any], FloatArray]] = {
    "geometry_msgs/msg/PointStamped": lambda m: point_from(m.point)
}


# --- values to messages ------------------------------------------------------------------------------------


def header_message(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    """``std_msgs/Header``."""
    return {"stamp": {"sec": stamp_ns // NS, "nanosec": stamp_ns % NS}, "frame_id": frame_id}


def compressed_message(
    image: Image, stamp_ns: int, frame_id: str, suffix: str, quality: int
) -> dict[str, Any]:
    """``CompressedImage`` from (height, width, 3) BGR; suffix ``jpeg`` or ``png``."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix == "jpeg" else []
    _, data = cv2.imencode(f".{suffix}", image, flags)
    return {"header": header_message(stamp_ns, frame_id), "format": suffix, "data": data.tobytes()}


def marker_message(x_S: FloatArray, stamp_ns: int, frame_id: str) -> dict[str, Any]:
    """``PointCloud2`` of doubles from (n, 3) m; row = marker identity, NaN = not seen."""
    points = np.ascontiguousarray(x_S, dtype="<f8")
    return {
        "header": header_message(stamp_ns, frame_id),
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": 8 * k, "datatype": _FLOAT64, "count": 1} for k, name in enumerate("xyz")
        ],
        "is_bigendian": False,
        "point_step": 24,
        "row_step": 24 * len(points),
        "data": points.tobytes(),
        "is_dense": bool(np.all(np.isfinite(points))),
    }


def pose_message(T_B_E: FloatArray, stamp_ns: int, frame_id: str) -> dict[str, Any]:
    """``PoseStamped`` from (4, 4)."""
    x, y, z, w = (float(c) for c in quaternion_from_rotation(T_B_E[:3, :3]))
    return {
        "header": header_message(stamp_ns, frame_id),
        "pose": {"position": xyz_message(T_B_E[:3, 3]), "orientation": {"x": x, "y": y, "z": z, "w": w}},
    }


def xyz_message(p: FloatArray) -> dict[str, float]:
    """``Point`` from (3,)."""
    return {name: float(c) for name, c in zip("xyz", p, strict=True)}
