"""One root for every error that a user can cause or mend.

Only the command line turns these into a message and exit code 2; everything else raises them.
A message says what is wrong, where, and what to do.
"""


class TipTraceError(Exception):
    """Root of all errors raised on purpose."""


class RecordingError(TipTraceError):
    """A recording that cannot be read, or lacks what a trial needs."""


class ConfigError(TipTraceError):
    """A rig, tool, map or settings file that is wrong."""


class GeometryError(TipTraceError):
    """Degenerate geometry: collinear markers, poses without rotation, a transform that is none."""


class PerceptionError(TipTraceError):
    """A tactile image that cannot be used: no markers, wrong size, black, overexposed."""


class CalibrationError(TipTraceError):
    """Calibration data that do not determine what is asked of them."""


class SimulationError(TipTraceError):
    """A trial that the virtual rig cannot perform: unknown name, no equilibrium, a grasp that does not hold."""


class OutputError(TipTraceError):
    """Results that cannot be written, or read back."""


class DeviceError(TipTraceError):
    """A camera or robot that is missing, busy, silent, or not what the rig file says."""


class MissingExtraError(TipTraceError):
    """An optional library is not installed."""

    def __init__(self, library: str, extra: str) -> None:
        super().__init__(f"{library} is not installed; it comes with: pip install 'tiptrace[{extra}]'")
