"""The import arrows of the design: who may see whom."""

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[1] / "src" / "tiptrace"
BASE = {"types", "errors", "config"}
MAY_IMPORT = {
    "types": {"config"},  # for annotations only
    "errors": set(),
    "compiled": set(),
    "config": {"types", "errors", "geometry"},
    "snapshot": {"types"},
    "geometry": {"types", "errors"},
    "perception": BASE | {"compiled", "geometry", "models"},
    "estimation": BASE | {"compiled", "geometry"},
    "calibration": BASE | {"geometry", "perception", "estimation"},
    "sim": BASE | {"geometry"},
    "evaluation": BASE | {"geometry"},
    "streams": BASE | {"geometry", "sim", "drivers"},
    "drivers": BASE | {"compiled", "geometry"},
    "outputs": BASE | {"geometry", "evaluation"},
    "tracer": BASE | {"geometry", "perception", "estimation"},
    "pipeline": BASE | {"geometry", "streams", "tracer"},
    "trial_runs": BASE
    | {"estimation", "evaluation", "pipeline", "reconstruction", "sim", "streams", "tracer"},
    "batch_plan": BASE,
    "frames": BASE | {"evaluation", "pipeline"},
    "grasp_file": BASE | {"estimation", "evaluation"},
    "using": BASE | {"estimation", "grasp_file", "outputs", "pipeline", "streams", "tracer"},
    "batch": BASE
    | {"batch_plan", "evaluation", "frames", "grasp_file", "outputs", "reconstruction", "streams"}
    | {"trial_runs", "using"},
    "export": BASE
    | {
        "batch_plan",
        "estimation",
        "evaluation",
        "frames",
        "geometry",
        "outputs",
        "pipeline",
        "streams",
        "tracer",
    },
    "live": BASE
    | {
        "snapshot",
        "geometry",
        "drivers",
        "streams",
        "perception",
        "estimation",
        "tracer",
        "pipeline",
        "calibration",
    },
    "ros": BASE | {"drivers", "geometry", "live", "pipeline", "streams"},
    "trial_plan": BASE | {"evaluation", "sim", "trial_runs"},
    "reconstruction": BASE
    | {"estimation", "evaluation", "geometry", "outputs", "pipeline", "streams", "tracer"}
    | {"frames", "grasp_file", "trial_watch", "using"},
    "trial_watch": BASE | {"estimation", "evaluation", "frames", "pipeline", "tracer"},
}


def imported_parts(file: Path) -> set[str]:
    parts = set()
    for node in ast.walk(ast.parse(file.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module] if node.module != "tiptrace" else [f"tiptrace.{a.name}" for a in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        parts |= {name.split(".")[1] for name in names if name.startswith("tiptrace.")}
    return parts


def part_of(file: Path) -> str:
    return file.relative_to(SRC).parts[0].removesuffix(".py")


@pytest.mark.parametrize("part", sorted(MAY_IMPORT))
def test_import_arrows(part: str) -> None:
    allowed = MAY_IMPORT[part] | {part, "__version__"}
    for file in SRC.rglob("*.py"):
        if part_of(file) == part:
            assert imported_parts(file) <= allowed, file


def test_every_part_has_its_arrows_declared() -> None:
    parts = {part_of(file) for file in SRC.rglob("*.py")} - {"__init__", "__main__", "cli", "viewers"}
    assert parts <= set(MAY_IMPORT), "declare the arrows of the new part"
