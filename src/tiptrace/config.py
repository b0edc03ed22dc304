"""Files that a user writes: the rig and the tool. Unknown keys are refused with the valid ones listed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from tiptrace.errors import ConfigError, GeometryError
from tiptrace.geometry.transforms import rotation_from_quaternion, transform
from tiptrace.types import SIDES, FloatArray, Side

Vector3 = tuple[float, float, float]
M = TypeVar("M", bound=BaseModel)
_MAX_YAML_BYTES, _MAX_YAML_NODES = 200_000, 50_000
_REACH_M = 3.0  # no arm that holds a GelSight Mini reaches further: longer vectors are millimetres


def _in_metres(v: Vector3) -> Vector3:
    if max(abs(c) for c in v) > _REACH_M:
        raise ValueError(f"{v} looks like millimetres: give metres")
    return v


def _spread(v: Vector3) -> Vector3:
    if min(v) < 1e-6:
        raise ValueError(f"{v}: a standard deviation is at least 1e-6 m")
    return v


Metres3 = Annotated[Vector3, AfterValidator(_in_metres)]


def _unit(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    try:
        rotation_from_quaternion(q)
    except GeometryError as error:
        raise ValueError(str(error)) from None
    return q


UnitQuaternion = Annotated[tuple[float, float, float, float], AfterValidator(_unit)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Transform(_Model):
    """A rigid transform as a user writes it."""

    translation_m: Metres3
    quaternion_xyzw: UnitQuaternion

    def matrix(self) -> FloatArray:
        """Homogeneous (4, 4)."""
        return transform(rotation_from_quaternion(self.quaternion_xyzw), self.translation_m)


class TransformStd(_Model):
    """Standard deviations of a transform."""

    rotation_deg: float = Field(ge=0)
    translation_m: float = Field(ge=0, le=0.1)


class Camera(_Model):
    """How a live camera is opened (optional)."""

    source: str | None = None
    serial: str | None = None
    fourcc: Annotated[str, Field(pattern=r"^[ -~]{4}$")] | None = None
    size_px: tuple[int, int] | None = None
    crop_px: tuple[int, int, int, int] | None = None
    flip: Literal["none", "horizontal", "vertical", "both"] | None = None


class Sensor(_Model):
    """One finger."""

    image_size_px: tuple[Annotated[int, Field(gt=15, le=4096)], Annotated[int, Field(gt=15, le=4096)]] = (
        320,
        240,
    )
    mm_per_px: tuple[Annotated[float, Field(gt=0, lt=1)], Annotated[float, Field(gt=0, lt=1)]]
    T_E_S: Transform
    gel_model: str = "gelsight-mini-virtual"
    marker_threshold: tuple[float, float] = (0.0, 70.0)
    latency_s: float | None = Field(default=None, gt=-1, lt=1)
    latency_std_s: float | None = Field(default=None, gt=0, lt=1)
    T_E_S_std: TransformStd | None = None
    marker_pitch_mm: float | None = Field(default=None, gt=0)
    max_strain_mm: float | None = Field(default=None, gt=0)
    gel_id: str | None = None
    calibrated: str | None = None
    camera: Camera | None = None

    @property
    def metres_per_px(self) -> FloatArray:
        """(s_x, s_y) in m/px."""
        return np.asarray(self.mm_per_px) * 1e-3


class Sensors(_Model):
    """The two fingers."""

    left: Sensor
    right: Sensor


class Frames(_Model):
    """What /ee_pose means."""

    base: str = "base"
    end_effector: str = "tool0"
    tcp_offset_m: Metres3 = (0.0, 0.0, 0.0)


# z shift of the pads of a 2F-85 with its opening: the fingertips move on an arc as the linkage opens.
_SHIFT_TABLES: dict[str, tuple[tuple[float, float], ...]] = {
    "robotiq-2f85": ((0.0, 0.0), (0.085, 0.0)),
}


class Gripper(_Model):
    """How the fingers move with the opening (gel surface to gel surface, undeformed)."""

    opening_m: float = Field(ge=0, lt=0.3)
    closing_axis_E: Vector3
    shift_z_E_m: tuple[tuple[float, float], ...] | Literal["robotiq-2f85"] = ((0.0, 0.0),)

    @model_validator(mode="after")
    def _axis_is_unit(self) -> Self:
        norm = float(np.linalg.norm(self.closing_axis_E))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"closing_axis_E must have length 1, has {norm:.4g}")
        return self

    def shift_z_m(self, opening_m: float) -> float:
        """Pad shift along z_E at an opening, from the table (linear in between)."""
        table = _SHIFT_TABLES[self.shift_z_E_m] if isinstance(self.shift_z_E_m, str) else self.shift_z_E_m
        openings, shifts = np.asarray(sorted(table)).T
        return float(np.interp(opening_m, openings, shifts))


class Rig(_Model):
    """``rig.yaml``: what the user believes about the rig (format tiptrace-rig/1)."""

    format: Literal["tiptrace-rig/1"] = "tiptrace-rig/1"
    frames: Frames = Frames()
    gripper: Gripper | None = None
    sensors: Sensors

    @model_validator(mode="after")
    def _fingers_face_each_other(self) -> Self:
        T_left, T_right = (self.sensor(side).T_E_S.matrix() for side in SIDES)
        if float(T_left[:3, 2] @ T_right[:3, 2]) > -0.95:
            raise ValueError(
                "the two gels do not face each other: +z_S must point out of each gel towards the tool; "
                "check T_E_S (quaternion order is x, y, z, w; T_E_S maps sensor to end-effector coordinates)"
            )
        across_E = T_left[:3, 3] - T_right[:3, 3]
        if float(across_E @ T_left[:3, 2]) >= 0 or float(across_E @ T_right[:3, 2]) <= 0:
            raise ValueError(
                "the gels point away from each other: T_E_S looks inverted (it must map sensor to end-effector "
                "coordinates), or left and right are exchanged"
            )
        if self.gripper is not None and float(across_E @ np.asarray(self.gripper.closing_axis_E)) <= 0:
            raise ValueError(
                "left and right look exchanged: the left finger is the one on the positive side of closing_axis_E"
            )
        return self

    def sensor(self, side: Side) -> Sensor:
        """The finger's settings."""
        return self.sensors.left if side == "left" else self.sensors.right

    def T_E_S(self, side: Side, opening_m: float | None = None) -> FloatArray:
        """Sensor pose in F_E, (4, 4), at a gripper opening.

        Each finger moves by half the change of the opening along the closing axis, both along z_E by the table.
        """
        T_E_S = self.sensor(side).T_E_S.matrix()
        if self.gripper is None or opening_m is None:
            return T_E_S
        sign = 1.0 if side == "left" else -1.0
        change = opening_m - self.gripper.opening_m
        T_E_S[:3, 3] += sign * 0.5 * change * np.asarray(self.gripper.closing_axis_E)
        T_E_S[2, 3] += self.gripper.shift_z_m(opening_m) - self.gripper.shift_z_m(self.gripper.opening_m)
        return T_E_S


class Tool(_Model):
    """``tool.yaml``: what is known of the tool (format tiptrace-tool/1)."""

    format: Literal["tiptrace-tool/1"] = "tiptrace-tool/1"
    thickness_m: float | None = Field(default=None, gt=0, lt=0.2)
    tip_E_m: Metres3 | None = None
    tip_sigma_m: Annotated[Vector3, AfterValidator(_in_metres), AfterValidator(_spread)] | None = None
    tip_radius_m: float | None = Field(default=None, ge=0, lt=0.05)


def read_yaml(text: str | bytes, source: str) -> Any:
    """Content of YAML text from anybody: plain data only, of a size that settings have.

    Anchors and merge keys are fine, but a few lines of them can mean billions of values, or a value within
    itself: what the text means is counted before any of it is made.

    Raises:
        ConfigError: not YAML, or too large.
    """
    if len(text) > _MAX_YAML_BYTES:
        raise ConfigError(
            f"{source}: {len(text)} bytes are no settings file (limit {_MAX_YAML_BYTES}); is it the right file?"
        )
    try:
        loader = yaml.SafeLoader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _count_nodes(node, {}, source)
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except RecursionError:
        raise ConfigError(f"{source}: not valid YAML (nested too deeply)") from None
    except (yaml.YAMLError, ValueError, ArithmeticError, LookupError, TypeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{source}: not valid YAML ({reason})") from None


def _count_nodes(node: yaml.Node, counted: dict[int, int], source: str) -> int:
    """Values that a node stands for, aliases written out."""
    key = id(node)
    if key not in counted:
        counted[key] = _MAX_YAML_NODES  # met again within itself: endless
        children = node.value if isinstance(node, yaml.CollectionNode) else []
        total = 1
        for child in children:
            for part in child if isinstance(child, tuple) else (child,):
                total += _count_nodes(part, counted, source)
        counted[key] = total
    if counted[key] >= _MAX_YAML_NODES:
        raise ConfigError(f"{source}: its aliases mean more than {_MAX_YAML_NODES} values; write them out")
    return counted[key]


def parse_yaml(model: type[M], text: str | bytes, source: str) -> M:
    """Validate YAML text against a model; ``source`` names the file in error messages.

    Raises:
        ConfigError: not YAML, an unknown key (the valid ones are listed), or a value out of range.
    """
    data = read_yaml(text, source)
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: expected a mapping of keys to values, got {type(data).__name__}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explain(model, error)}") from None


def load_yaml(model: type[M], path: Path) -> M:
    """Read and validate a YAML file.

    Raises:
        ConfigError: see :func:`parse_yaml`; also a file that cannot be read.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_YAML_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    return parse_yaml(model, text, str(path))


def dump_yaml(model: BaseModel) -> str:
    """YAML text of a settings model, without what was not set."""
    return yaml.safe_dump(model.model_dump(mode="json", exclude_none=True), sort_keys=False)


def _explain(model: type[BaseModel], error: ValidationError) -> str:
    """One clear sentence per problem, the first few of them."""
    problems = []
    for item in error.errors(include_url=False, include_input=False)[:8]:
        where = ".".join(str(part) for part in item["loc"]) or "file"
        if item["type"] == "extra_forbidden":
            valid = ", ".join(_keys_at(model, item["loc"][:-1]))
            problems.append(f"unknown key '{where}'; valid keys here: {valid}")
        else:
            problems.append(f"{where}: {item['msg'].removeprefix('Value error, ')}")
    return "; ".join(problems)


def _keys_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Field names of the nested model at an error location."""
    current: Any = model
    for part in loc:
        annotation = current.model_fields[str(part)].annotation
        options = [annotation, *getattr(annotation, "__args__", ())]
        current = next(o for o in options if isinstance(o, type) and issubclass(o, BaseModel))
    return list(current.model_fields)
