"""``grasp.json``: what a trial learned of its grasp, for ``--anchor-from`` in another."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.config import Tool
from tiptrace.errors import OutputError
from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.integrity_reference import Reference
from tiptrace.estimation.motion import MotionConfig, TemplateFit
from tiptrace.estimation.slip_detector import SlipLevels
from tiptrace.estimation.stage_one import Anchoring
from tiptrace.estimation.tip_map import TipMap
from tiptrace.estimation.tip_map_config import C
from tiptrace.evaluation.atomic import write_atomic

GRASP = "grasp.json"
_FORMAT = "tiptrace-grasp/2"


@dataclass(frozen=True, slots=True)
class Grasp:
    """A grasp and the tool in it, as far as it is known."""

    anchoring: Anchoring
    tool: Tool | None

    @property
    def tip(self) -> TipPrior:
        """The tip in F_E."""
        tip_map = self.anchoring.tip_map
        return TipPrior(tip_map.c, tip_map.covariance[C, C])


def write_grasp(folder: Path, anchoring: Anchoring, tool: Tool | None) -> None:
    """Write ``grasp.json`` into a results folder.

    Raises:
        OutputError: it cannot be written.
    """
    tip_map, fit = anchoring.tip_map, anchoring.fit
    record = {
        "format": _FORMAT,
        "tip_E_m": tip_map.c.tolist(),
        "tip_std_m": np.sqrt(np.diag(tip_map.covariance)[C]).tolist(),
        "tool": None if tool is None else tool.model_dump(mode="json", exclude_none=True),
        "tip_map": {
            "theta": tip_map.theta.tolist(),
            "covariance": tip_map.covariance.tolist(),
            "learned": tip_map.learned.tolist(),
            "residual_m": tip_map.residual_m,
            "correlation": tip_map.correlation,
            "frames": tip_map.frames,
            "duration_s": tip_map.duration_s,
        },
        "template": np.where(np.isfinite(fit.template), fit.template, 0.0).tolist(),
        "seen": np.isfinite(fit.template[:, 0]).tolist(),
        "pad": [int(k) for k in fit.pad],
        "axes": fit.axes.tolist(),
        "trust": anchoring.trust.tolist(),
        "reference": {f.name: _plain(getattr(anchoring.reference, f.name)) for f in fields(Reference)},
    }
    write_atomic(folder / GRASP, json.dumps(record) + "\n")


def read_grasp(folder: Path) -> Grasp:
    """The grasp of a results folder.

    Raises:
        OutputError: there is none, or another version wrote it.
    """
    path = folder / GRASP
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise OutputError(
            f"{path}: missing; only method full with an anchor that was not refused leaves one: reconstruct that "
            "recording again, or give the recording itself"
        ) from None
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: cannot be read ({error})") from None
    try:
        if record["format"] != _FORMAT:
            raise ValueError(f"format {record['format']}, expected {_FORMAT}")
        return _grasp(record)
    except (KeyError, TypeError, ValueError) as error:
        raise OutputError(f"{path}: was not written by this version ({error!r}); reconstruct again") from None


def _grasp(record: dict[str, Any]) -> Grasp:
    found = record["tip_map"]
    tip_map = TipMap(
        theta=np.array(found["theta"], dtype=np.float64),
        covariance=np.array(found["covariance"], dtype=np.float64),
        learned=np.array(found["learned"], dtype=bool),
        residual_m=float(found["residual_m"]),
        correlation=float(found["correlation"]),
        frames=int(found["frames"]),
        duration_s=float(found["duration_s"]),
        residual=np.zeros((0, 3)),
    )
    if tip_map.theta.shape != (19,) or tip_map.covariance.shape != (19, 19):
        raise ValueError("a tip map of another size")
    M = np.array(record["template"], dtype=np.float64)
    M[~np.array(record["seen"], dtype=bool)] = np.nan
    trust = np.array(record["trust"], dtype=np.float64)
    axes = np.array(record["axes"], dtype=np.float64)
    fit = TemplateFit(M, np.array(record["pad"], dtype=np.intp), axes, trust, MotionConfig())
    reference = Reference(**{name: _array(value) for name, value in record["reference"].items()})
    tool = None if record["tool"] is None else Tool.model_validate(record["tool"])
    motions = fit.fit(M[None])
    return Grasp(Anchoring(tip_map, fit, trust, np.zeros(1), motions, None, reference, 0), tool)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "dtype": "int" if value.dtype.kind == "i" else "float"}
    if isinstance(value, SlipLevels):
        return {"slip": [value.kick_m, value.pattern_m]}
    return {"tuple": list(value)} if isinstance(value, tuple) else value


def _array(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    if "slip" in value:
        return SlipLevels(*map(float, value["slip"]))
    if "array" in value:
        return np.array(value["array"], dtype=np.intp if value["dtype"] == "int" else np.float64)
    return tuple(value["tuple"])
