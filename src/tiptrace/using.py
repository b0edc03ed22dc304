"""What a user gives in place of the usual means: the tip from a file or from another trial, no gel network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from tiptrace.config import Tool, load_yaml
from tiptrace.errors import ConfigError, GeometryError
from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.priors import require_tip, tip_prior
from tiptrace.estimation.stage_one import Anchoring
from tiptrace.grasp_file import Grasp, read_grasp
from tiptrace.outputs import CSV
from tiptrace.pipeline import open_tracer, trace
from tiptrace.streams.sources import open_recording
from tiptrace.tracer import TracerOptions
from tiptrace.types import Stream

_THICKNESS_M = 0.5e-3  # tools that differ by more are two
_FAR_SIGMAS, _FAR_M = 5.0, 5e-3


@dataclass(frozen=True, slots=True)
class Using:
    """How a recording is reconstructed without the usual means.

    Attributes:
        tip: tool.yaml that tells the tip; Stage I is not used.
        anchor_from: Results folder or recording of another trial with the same grasp; Stage I is not used.
        regrasp: The tool was gripped anew since: only its tip is taken over, less certain.
        regrasp_sigma_m: By how much less, per axis.
        relative: No anchor at all: displacements from the first contact.
        depth: ``none`` does without a gel network.
        smooth: Offline: smooth the in-grasp motion with all data of the trial.
    """

    tip: Path | None = None
    anchor_from: Path | None = None
    regrasp: bool = False
    regrasp_sigma_m: float = 2e-3
    relative: bool = False
    depth: str = "network"
    smooth: bool = False

    def __post_init__(self) -> None:
        given = [self.tip is not None, self.anchor_from is not None, self.relative]
        if sum(given) > 1:
            raise ConfigError("--tip, --anchor-from and --relative exclude each other: give one of them")
        if self.regrasp and self.anchor_from is None:
            raise ConfigError(
                "--regrasp belongs to --anchor-from: it tells that the tool was gripped anew since"
            )
        if self.depth not in ("network", "none"):
            raise ConfigError(f"--depth {self.depth}: valid are network and none")
        if not 0.0 < self.regrasp_sigma_m < 0.1:
            raise ConfigError(f"a regrasp by {self.regrasp_sigma_m} m is none: give 0 to 0.1 m")

    def as_text(self) -> dict[str, str]:
        """What differs from the default, for jobs on other machines."""
        default = Using()
        names = self.__slots__
        return {n: str(getattr(self, n)) for n in names if getattr(self, n) != getattr(default, n)}

    @classmethod
    def from_text(cls, text: Mapping[str, str]) -> Using:
        """What :meth:`as_text` wrote."""
        return cls(
            tip=Path(text["tip"]) if "tip" in text else None,
            anchor_from=Path(text["anchor_from"]) if "anchor_from" in text else None,
            regrasp=text.get("regrasp") == "True",
            regrasp_sigma_m=float(text.get("regrasp_sigma_m", 2e-3)),
            relative=text.get("relative") == "True",
            depth=text.get("depth", "network"),
            smooth=text.get("smooth") == "True",
        )

    @property
    def sensed_depth(self) -> Literal["network", "none"]:
        """For the sensing chain."""
        return cast(Literal["network", "none"], self.depth)

    def check(self, method: str, beside: tuple[str, ...] = ()) -> None:
        """Refuse what does not go with a method, before any work is done.

        Raises:
            ConfigError: it does not.
        """
        if method != "full" and (self.smooth or self.relative or self.anchor_from or self.tip):
            options = {"smooth": self.smooth, "relative": self.relative, "anchor-from": self.anchor_from}
            names = [f"--{n}" for n, v in {**options, "tip": self.tip}.items() if v]
            if method == "nominal-tip" and names == ["--tip"]:
                return
            raise ConfigError(f"{', '.join(names)}: only method full can do that, not '{method}'")
        if self.depth == "none" and "paper" in (method, *beside):
            raise ConfigError("method 'paper' measures depth: --depth none goes with the other methods")

    def options(self, stream: Stream) -> TracerOptions:
        """For the tracer.

        Raises:
            ConfigError: a file without a tip, or another tool's anchor.
            TipTraceError: a file or recording that cannot be read, or that has no anchor.
        """
        depth = self.sensed_depth
        if self.tip is not None:
            tool = load_yaml(Tool, self.tip)
            try:
                require_tip(tool)
            except GeometryError:
                raise ConfigError(
                    f"{self.tip}: states no tip; --tip needs tip_E_m and tip_sigma_m (`tiptrace calibrate tip` "
                    "measures them)"
                ) from None
            return TracerOptions(depth=depth, tool=tool, use_stage_one=False)
        if self.anchor_from is not None:
            grasp = load_grasp(self.anchor_from, depth)
            _same_tool(grasp, stream.tool, self.anchor_from)
            return TracerOptions(depth=depth, anchor_from=self._carried(grasp))
        if self.relative:
            return TracerOptions(depth=depth, use_stage_one=False, relative=True)
        return TracerOptions(depth=depth)

    def _carried(self, grasp: Grasp) -> TipPrior | Anchoring:
        if not self.regrasp:
            return grasp.anchoring
        inflated = grasp.tip.covariance + self.regrasp_sigma_m**2 * np.eye(3)
        return TipPrior(grasp.tip.c, inflated)


def load_grasp(source: Path, depth: Literal["network", "none"] = "network") -> Grasp:
    """The grasp of a results folder, or of a recording, which is traced for it with the rig that is attached to it.

    Raises:
        TipTraceError: it cannot be read, or its anchor was refused.
    """
    if source.is_dir() and (source / CSV).exists():
        return read_grasp(source)
    if not source.exists():
        raise ConfigError(f"{source}: does not exist; --anchor-from takes a results folder or a recording")
    stream = open_recording(source)
    with open_tracer(stream, "full", TracerOptions(depth=depth)) as tracer:
        trace(stream, tracer)
        estimator = tracer.estimator
    assert isinstance(estimator, FullEstimator)
    if estimator.anchoring is None or estimator.anchor is None:
        refused = next(
            (e.detail for e in estimator.events if e.kind == "anchor-refused"), "it has no Stage I"
        )
        raise ConfigError(f"{source}: has no anchor to take over: {refused}")
    return Grasp(estimator.anchoring, stream.tool)


def _same_tool(grasp: Grasp, tool: Tool | None, source: Path) -> None:
    """The other trial must have held this tool.

    Raises:
        ConfigError: by thickness or by where its tip is, it held another.
    """
    other = grasp.tool
    if tool is None:
        return
    here, there = tool.thickness_m, None if other is None else other.thickness_m
    if here is not None and there is not None and abs(there - here) > _THICKNESS_M:
        raise ConfigError(
            f"{source}: held another tool ({there * 1e3:.1f} mm thick, this one {here * 1e3:.1f} mm); its anchor does "
            "not fit"
        )
    prior = tip_prior(tool)
    if prior is None:
        return
    off = grasp.tip.c - prior.c
    allowed = _FAR_SIGMAS * np.sqrt(np.diag(prior.covariance + grasp.tip.covariance)) + _FAR_M
    if (np.abs(off) > allowed).any():
        raise ConfigError(
            f"{source}: its tip is {np.linalg.norm(off) * 1e3:.0f} mm from the one that this recording's tool.yaml "
            "states: another tool, or another grasp"
        )
