"""A simulated trial as a stream, like a recording or live hardware."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from tiptrace.config import Rig, Tool
from tiptrace.sim.simulation import Frame, Simulation
from tiptrace.sim.spec import TrialSpec
from tiptrace.types import Image, Sample, Side


class SimulatedStream:
    """A trial of the virtual rig; implements ``types.Stream``. Every iteration simulates it anew.

    Args:
        spec: What to simulate.
        on_frame: Called with every frame's truth as it is simulated.
    """

    def __init__(self, spec: TrialSpec, on_frame: Callable[[Frame], None] | None = None) -> None:
        """Settle the grasp and press down, so that an impossible trial is refused here.

        Raises:
            SimulationError: an unknown name, or a trial that cannot start.
        """
        self.spec = spec
        self._on_frame = on_frame
        self._simulation = Simulation(spec)
        self._used = False
        self.rig: Rig = self._simulation.rig
        self.tool: Tool | None = self._simulation.tool
        self.frame_count = self._simulation.frame_count
        self.gel_models: dict[str, bytes] = {}
        self._references: dict[Side, Image] | None = None

    @property
    def references(self) -> dict[Side, Image]:
        """Images of the untouched gels; none in mode ``markers``."""
        if self._references is None:
            self._references = self._simulation.references
        return self._references

    @property
    def trial_metadata(self) -> dict[str, Any]:
        """Content of ``trial.yaml``."""
        return self._simulation.metadata()

    def frames(self) -> Iterator[Frame]:
        """Truth and samples, exposure by exposure."""
        if self._used:
            self._simulation = Simulation(self.spec)
        self._used = True
        for frame in self._simulation.frames():
            if self._on_frame is not None:
                self._on_frame(frame)
            yield frame

    def __iter__(self) -> Iterator[Sample]:
        """Deliver the samples."""
        for frame in self.frames():
            yield from frame.samples
