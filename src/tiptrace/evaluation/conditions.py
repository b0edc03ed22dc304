"""Conditions of a trial and the paper's four condition sets (Table I)."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Self


@dataclass(frozen=True, slots=True, order=True)
class Condition:
    """What was varied between trials."""

    trajectory: str
    tool: str
    wrist: str
    grasp: str

    @classmethod
    def parse(cls, name: str) -> Self:
        """From its name, for example ``T3-O1-W1-G1``.

        Raises:
            ValueError: not four parts.
        """
        parts = name.split("-")
        if len(parts) != 4:
            raise ValueError(f"'{name}' is not a condition like T3-O1-W1-G1")
        return cls(*parts)

    def __str__(self) -> str:
        return "-".join((self.trajectory, self.tool, self.wrist, self.grasp))


def _conditions(*names: str) -> tuple[Condition, ...]:
    return tuple(Condition.parse(name) for name in names)


# A condition that several sets share counts in each of them.
CONDITION_SETS = MappingProxyType(
    {
        "A": _conditions(*(f"T{k}-O1-W1-G1" for k in range(1, 6))),
        "B": _conditions(*(f"T3-O{k}-W1-G1" for k in range(1, 5))),
        "C": _conditions(*(f"T3-O2-W{k}-G1" for k in range(1, 4))),
        "D": _conditions(*(f"T3-O1-W1-G{k}" for k in range(1, 4))),
    }
)
VARIED = MappingProxyType({"A": "trajectory", "B": "tool", "C": "wrist", "D": "grasp"})


def distinct_conditions() -> tuple[Condition, ...]:
    """The twelve conditions, each once, in the order of the sets."""
    return tuple(dict.fromkeys(c for conditions in CONDITION_SETS.values() for c in conditions))


def sets_of(condition: Condition) -> tuple[str, ...]:
    """Names of the sets that hold a condition."""
    return tuple(name for name, conditions in CONDITION_SETS.items() if condition in conditions)
