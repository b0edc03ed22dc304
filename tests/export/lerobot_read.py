"""Reads a dataset with the ``lerobot`` package itself; run by its interpreter: ROOT OUT.npz."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import (  # type: ignore[import-not-found,unused-ignore]
    CODEBASE_VERSION,
    LeRobotDataset,
)


def main(root: str, out: str) -> None:
    dataset = LeRobotDataset("local/tip", root=root)
    items = [dataset[k] for k in range(len(dataset))]
    arrays = {}
    for name in items[0]:
        if name == "task":
            continue
        keep = items[::10] if "images" in name else items
        arrays[name] = np.stack([np.asarray(item[name]) for item in keep])
    stats = {n: {k: np.asarray(v).tolist() for k, v in s.items()} for n, s in dataset.meta.stats.items()}
    about = {
        "version": CODEBASE_VERSION,
        "tasks": sorted({item["task"] for item in items}),
        "episodes": dataset.num_episodes,
        "fps": dataset.fps,
        "stats": stats,
    }
    Path(out).with_suffix(".json").write_text(json.dumps(about))
    np.savez(out, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
