"""The detector's test of the residuals of a monitor's state."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.monitor.detection import Detector
from fdi_torch.monitor.law_errors import normalized
from fdi_torch.monitor.monitor_state import MonitorState


class ResidualTest:
    """The detector on the residuals of a state. reach: samples over which those beside known faults are normalized."""

    def __init__(self, detector: Detector, lookback: float) -> None:
        self.detector, self.reach = detector, max(round(lookback / detector.design.interval), 1)

    def statistic(self, state: MonitorState, count: int, memory: Tensor | None) -> tuple[Tensor, Tensor]:
        """The detector's statistic at the last `count` samples, (count,), and its memory after them. memory: before."""
        return self.detector.update(residuals_to_test(state, count, self.reach), memory)

    def is_quiet(self, state: MonitorState) -> bool:
        """Whether the detector, run again from the latest change on, stays within its threshold now.

        The misfit of a long window is no such test: its noise hides a deviation of a few seconds.
        """
        statistic, _ = self.statistic(state, _samples_after(state, state.valid_since), None)
        return float(statistic[-1]) <= self.detector.threshold

    def shares(self, state: MonitorState, since: float) -> list[float]:
        """The share of each sensor in the detector's statistic, by the samples after `since`, s."""
        white = residuals_to_test(state, _samples_after(state, since), self.reach)
        shares: list[float] = self.detector.shares(white).tolist()
        return shares


def residuals_to_test(state: MonitorState, count: int, reach: int) -> Tensor:
    """The last white residuals (count, sensors) for the detector. reach: samples over which those beside known faults
    are normalized.
    """
    return normalized(state.tested, count, reach) if bool(state.off_nominal.any()) else state.tested[-count:]


def _samples_after(state: MonitorState, time: float) -> int:
    return max(int((state.samples.time > time).sum()), 1)
