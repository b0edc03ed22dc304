"""Settings of the sensing chain; the defaults are what the tables in ``docs/sensing.md`` were made with."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SensingConfig(BaseModel):
    """How markers are tracked and lifted.

    Attributes:
        method: ``paper`` is Sec. II-B to the letter; ``full`` tracks without drift and fills better.
        depth: ``network`` needs a calibrated gel; ``none`` measures in the gel's plane only.
        indentation_m: With ``depth: none``: how deep the tool sits in each gel, (thickness − opening) / 2.
        depth_step: In ``full``, every how many pixels depth is computed (2 = half resolution).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Literal["paper", "full"] = "full"
    depth: Literal["network", "none"] = "network"
    indentation_m: float = Field(default=0.6e-3, gt=0, lt=5e-3)
    depth_step: int = Field(default=2, ge=1, le=4)
