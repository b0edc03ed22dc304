"""Settings of ``--method full``, part by part."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.integrity_reference import IntegrityConfig
from tiptrace.estimation.motion import MotionConfig
from tiptrace.estimation.patch import PatchConfig
from tiptrace.estimation.phases import PhaseConfig
from tiptrace.estimation.reanchor import ReanchorConfig
from tiptrace.estimation.stage_one import StageOneConfig
from tiptrace.estimation.tip_map_config import TipMapConfig


class FullConfig(BaseModel):
    """Settings of the full estimator; the defaults were chosen on simulated trials with seeds below 1000.

    ``use_stage_one = False`` takes the tip from the tool's file (``--tip``); with ``relative = True`` too the tip is
    not asked for, and positions are displacements from the first contact.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    patch: PatchConfig = PatchConfig()
    motion: MotionConfig = MotionConfig()
    tip_map: TipMapConfig = TipMapConfig()
    stage_one: StageOneConfig = StageOneConfig()
    integrity: IntegrityConfig = IntegrityConfig()
    phases: PhaseConfig = PhaseConfig()
    reanchor: ReanchorConfig = ReanchorConfig()
    use_stage_one: bool = True
    relative: bool = False
    use_tip_prior: bool = True
    refuse_sigma_m: float = Field(default=2e-3, gt=0)
    slip_sigma_m: float = Field(default=1.5e-3, gt=0)
    pose_half_width_s: float = Field(default=0.05, gt=0)
    pose_memory_s: float = Field(default=1.0, gt=0.2)
    tip_noise_m: float = Field(default=1e-4, gt=0)  # hand pose and model at the tip, per frame
    unknown_tip_m: tuple[float, float] = (0.06, 0.03)  # beyond the pads along z_E, and σ, for displacements
