"""Settings of a monitor: length of its windows and schedule of its fits."""

from __future__ import annotations

from dataclasses import dataclass

from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale

LOOKBACK, CONFIRM, LONGEST = 300.0, 60.0, 1000.0  # in units of the plant's time scale
GROWING_WINDOWS = 8.0  # longest windows over which one straight line describes a fault that grows
REVISE = 2.0  # factor by which the time since an onset grows between two fits


@dataclass(frozen=True)
class MonitorSettings:
    """lookback: how long before an alarm an onset is searched for, s. confirm: time from alarm to isolation, s.
    longest: length of the longest window, s. incipient: whether faults may grow slowly. together: largest number of
    simultaneous faults.
    """

    lookback: float
    confirm: float
    longest: float
    incipient: bool = True
    together: int = 2

    def __post_init__(self) -> None:
        if not (self.lookback > 0 and self.confirm >= 0 and self.longest >= self.lookback):
            raise ValueError(
                "expected lookback > 0, confirm >= 0 and longest >= lookback, "
                f"got {self.lookback:g} s, {self.confirm:g} s, {self.longest:g} s; change them"
            )

    @property
    def growth_times(self) -> tuple[float, float] | None:
        """Shortest and longest time in which a growing fault passes through its range, s; None if all are sudden.

        Faster growth looks sudden, and a straight line does not describe slower growth.
        """
        return (self.lookback, GROWING_WINDOWS * self.longest) if self.incipient else None


def usual_settings(plant: PlantDescription) -> MonitorSettings:
    """Default settings for a plant."""
    scale = time_scale(plant)
    return MonitorSettings(LOOKBACK * scale, CONFIRM * scale, LONGEST * scale)
