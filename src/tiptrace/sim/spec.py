"""What a simulated trial is made of. Unknown keys are refused; the same spec gives the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tiptrace.errors import SimulationError
from tiptrace.sim.disturbances import LEVELS, Disturbances, LevelName

AnchorMotionName = Literal["recommended", "two-axis", "one-axis", "pads"]
Mode = Literal["images", "markers"]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Dwell(_Model):
    """A stop on the way.

    Attributes:
        at_m: Hand travel at which it stops.
        duration_s: For how long.
        anchoring: Whether the hand turns about the nominal tip there (two-axis: nothing but friction holds the
            tip in mid-groove).
    """

    at_m: Positive
    duration_s: Positive
    anchoring: bool = False


class Lift(_Model):
    """The hand lifts and comes down again: the tip may lose contact.

    Attributes:
        start_s: When.
        duration_s: How long it is away.
        height_m: How far it lifts.
    """

    start_s: NotNegative
    duration_s: Positive
    height_m: Positive


class FrictionDrop(_Model):
    """Pad friction falls for a while (a wet or dusty gel): the grasp may slip."""

    start_s: NotNegative
    duration_s: Positive
    factor: Annotated[float, Field(ge=0, le=1)]


class Push(_Model):
    """A force on the tip for a while, base axes, N."""

    start_s: NotNegative
    duration_s: Positive
    force_n: tuple[float, float, float]


class TrialSpec(_Model):
    """One trial of the virtual rig.

    Attributes:
        trajectory: T1–T5 (ignored with ``curve``).
        curve: csv of a user's own centreline, rows x, y in mm.
        tool: O1–O4.
        tool_length_m: Other length than 86 mm.
        thickness_m: Other thickness than 8.6 mm; the gripper's opening follows.
        wrist: W1–W3.
        grasp: G1–G3.
        level: clean, nominal, hard or unseen.
        mode: ``images`` renders them, ``markers`` gives 3-D markers directly.
        seed: Everything random derives from it.
        anchor_motion: What the hand does in Stage I.
        anchor_guard: Keep the contact force within a band in Stage I, as a force-guarded robot does.
        anchoring_s: Duration of Stage I; 0 leaves it out.
        fps: Image pairs per second.
        pose_hz: Rate of the robot's poses.
        travel_m: Hand travel in Stage II, along +x.
        speed_mps: Its speed.
        ramp_s: Acceleration and deceleration time.
        preload_n: Contact force of the travel while the tool still stands as in Stage I; friction then leans it
            back, which takes some of it.
        anchor_force_n: Contact force in Stage I; at its end the hand rises to what the travel needs.
        indentation_m: Of the tool into each pad.
        marker_grid: Rows and columns of dots.
        marker_pitch_m: Their pitch.
        dwells: Stops on the way.
        lifts: Excursions of the hand upwards.
        friction_drops: Intervals of low pad friction.
        pushes: Forces on the tip.
        disturbances: Replaces the level's own.
    """

    trajectory: str = "T3"
    curve: Path | None = None
    tool: str = "O1"
    tool_length_m: Positive | None = None
    thickness_m: Positive | None = None
    wrist: str = "W1"
    grasp: str = "G1"
    level: LevelName = "nominal"
    mode: Mode = "images"
    seed: Annotated[int, Field(ge=0)] = 0
    anchor_motion: AnchorMotionName = "recommended"
    anchor_guard: bool = True
    anchoring_s: NotNegative = 4.0
    fps: Annotated[float, Field(ge=2, le=1000)] = 25.0
    pose_hz: Annotated[float, Field(ge=10, le=1000)] = 125.0
    travel_m: NotNegative = 0.2
    speed_mps: Annotated[float, Field(gt=0, le=0.25)] = 0.02
    ramp_s: NotNegative = 0.4
    preload_n: Annotated[float, Field(ge=0, le=15)] = 3.6
    anchor_force_n: Annotated[float, Field(gt=0, le=15)] = 4.5
    indentation_m: Annotated[float, Field(gt=0, lt=3e-3)] = 1.2e-3
    marker_grid: tuple[Annotated[int, Field(ge=2, le=40)], Annotated[int, Field(ge=2, le=40)]] = (7, 9)
    marker_pitch_m: Annotated[float, Field(gt=2e-4, lt=1e-2)] = 2.0e-3
    dwells: tuple[Dwell, ...] = ()
    lifts: tuple[Lift, ...] = ()
    friction_drops: tuple[FrictionDrop, ...] = ()
    pushes: tuple[Push, ...] = ()
    disturbances: Disturbances | None = None

    @property
    def disturbed_by(self) -> Disturbances:
        """The disturbances in force: the spec's own, else the level's."""
        return self.disturbances if self.disturbances is not None else LEVELS[self.level]

    @property
    def name(self) -> str:
        """For example ``T3-O1-W1-G1``."""
        trajectory = self.curve.stem if self.curve is not None else self.trajectory
        return f"{trajectory}-{self.tool}-{self.wrist}-{self.grasp}"


def make_spec(**values: Any) -> TrialSpec:
    """A spec from plain values.

    Raises:
        SimulationError: an unknown key or name (the valid ones are listed), or a value out of range.
    """
    try:
        return TrialSpec(**values)
    except ValidationError as error:
        raise SimulationError("; ".join(_explain(e) for e in error.errors())) from None


def _explain(error: Any) -> str:
    where = ".".join(str(part) for part in error["loc"]) or "trial"
    if error["type"] == "extra_forbidden":
        return f"unknown setting '{where}'; valid settings: {', '.join(TrialSpec.model_fields)}"
    if error["type"] == "literal_error":
        return f"unknown {where} '{error['input']}'; valid: {error['ctx']['expected']}"
    return f"{where} = {error['input']!r}: {error['msg']}"
