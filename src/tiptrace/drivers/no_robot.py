"""``--robot none``: cameras only, to record the gels by themselves."""

from __future__ import annotations

from tiptrace.drivers.base import Closing, DeviceHealth, DeviceStatus, PoseFrames, RobotSample, RobotTap, Wake


class NoRobot(Closing):
    """Delivers nothing."""

    name = "none"

    @property
    def frames(self) -> PoseFrames:
        """None."""
        return PoseFrames()

    def start(self, wake: Wake, tap: RobotTap | None = None) -> None:
        """Nothing to do."""

    def take(self) -> list[RobotSample]:
        """Nothing."""
        return []

    def health(self) -> DeviceHealth:
        """Always well."""
        return DeviceHealth(self.name, DeviceStatus.OK)
