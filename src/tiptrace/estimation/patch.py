"""Which markers ride on the tool: contact patch, its interior, and how far each marker is to be trusted."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.types import BoolArray, FloatArray


class PatchConfig(BaseModel):
    """How the contact patch is told from its surroundings."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    contact_fraction: float = Field(default=0.5, gt=0, lt=1)  # of the deep markers' indentation
    neighbour_factor: float = Field(default=1.6, gt=1)  # × pitch: the eight neighbours of a square grid
    wanted_interior: int = 6  # per finger; below it edge markers help out
    edge_weight: float = Field(default=0.1, ge=0, le=1)  # of a contact marker on the patch's edge


def trust(x_S: FloatArray, config: PatchConfig) -> FloatArray:
    """Weight of every marker from its mean position in F_S, (n, 3) m → (n,) in [0, 1].

    1: in contact, and so are all its neighbours. ``edge_weight``: in contact at the patch's edge, used only where the
    interior alone is too small. 0: not in contact.
    """
    contact = in_contact(x_S, config)
    interior = contact & ~_has_neighbour_outside(x_S, contact, config)
    weight = np.where(interior, 1.0, 0.0)
    if interior.sum() < config.wanted_interior:
        weight[contact & ~interior] = config.edge_weight
    return weight


def in_contact(x_S: FloatArray, config: PatchConfig) -> BoolArray:
    """Markers pressed in by more than a fraction of what the deep ones are, (n, 3) → (n,)."""
    depth = -x_S[:, 2]
    seen = np.isfinite(depth)
    if not seen.any():
        return seen
    deep = float(np.percentile(depth[seen], 85))
    return np.asarray(seen & (np.where(seen, depth, 0.0) > config.contact_fraction * deep))


def _has_neighbour_outside(x_S: FloatArray, contact: BoolArray, config: PatchConfig) -> BoolArray:
    uv = x_S[:, :2]
    distance = np.linalg.norm(uv[:, None] - uv[None], axis=2)  # (n, n), NaN where lost
    distance = np.where(np.isfinite(distance), distance, np.inf)
    np.fill_diagonal(distance, np.inf)
    nearest = distance.min(axis=1)
    pitch = float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else 0.0
    return np.asarray(((distance < config.neighbour_factor * pitch) & ~contact[None]).any(axis=1))
