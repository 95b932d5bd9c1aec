"""Explanations of the readings in the windows of a monitor's state, and how long a change is fitted again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from fdi_torch.monitor.alarm_state import State
from fdi_torch.monitor.hypothesis import Fault, HypothesisFit, credible_set, merged
from fdi_torch.monitor.isolation import SMALLEST_PROBABILITY, isolate
from fdi_torch.monitor.monitor_settings import GROWING_WINDOWS, REVISE, MonitorSettings
from fdi_torch.monitor.monitor_state import DetectedChange, MonitorState
from fdi_torch.monitor.observer_bank import ObserverBank


@dataclass(frozen=True)
class Explainer:
    """Fits the faults that may occur. unlisted: those that are not on the list."""

    observer: ObserverBank
    faults: Sequence[Fault]
    settings: MonitorSettings
    unlisted: Sequence[Fault] = ()

    def search_start(self, state: MonitorState, alarm_time: float) -> float:
        """The earliest onset of a change that raised an alarm, s: not before the previous change."""
        return max(alarm_time - self.settings.lookback, state.valid_since)

    def of_alarm(self, state: MonitorState, alarm_time: float) -> list[HypothesisFit]:
        """Explanations of an alarm, likeliest first."""
        start, since = self.search_start(state, alarm_time), max(state.valid_since, state.earliest_start)
        return self._fits(state, start, since, state.believed)

    def of_change(self, state: MonitorState, change: DetectedChange) -> list[HypothesisFit]:
        """Explanations of the latest change, likeliest first; those it had are further initial guesses."""
        since = max(change.since, state.reachable)
        start, earliest = max(change.best.onset - self.settings.lookback, since), max(since, state.earliest_start)
        return self._fits(state, start, earliest, change.before, change.explanations)

    def _fits(
        self,
        state: MonitorState,
        start: float,
        earliest: float,
        believed: Tensor,
        earlier: Sequence[HypothesisFit] = (),
    ) -> list[HypothesisFit]:
        """Fits of all hypotheses since `start` s, likeliest first.

        While the most likely onset under a plausible hypothesis is the beginning of the window, the fault may have
        begun earlier. The window is then doubled, back to `earliest` s at most.
        """
        s, observer = self.settings, self.observer.knowing(state.errors.constants)
        while True:
            window = state.window(start)
            fits = isolate(
                observer,
                window,
                believed,
                self.faults,
                s.growth_times,
                s.together,
                state.healthy,
                earlier,
                flows=True,
                unlisted=self.unlisted,
                reach=s.lookback,
            )
            plausible = [f for f in fits if f.hypothesis.columns and f.probability > SMALLEST_PROBABILITY]
            if start <= earliest or all(f.onset - start > 2.0 * f.onset_std for f in plausible):
                return fits
            start = max(start - (state.now - start), earliest)

    def is_current(self, state: MonitorState, change: DetectedChange) -> bool:
        """Whether a change is recent enough to be fitted again."""
        longest = self.settings.longest * (GROWING_WINDOWS if change.best.hypothesis.incipient else 1.0)
        return state.now - change.best.onset <= longest and change.best.onset >= state.reachable

    def next_fit(self, fit: HypothesisFit, now: float) -> float:
        """When an explanation is fitted again, s."""
        return fit.onset + REVISE * max(now - fit.onset, self.settings.confirm)

    def reported(self, fits: Sequence[HypothesisFit]) -> list[HypothesisFit]:
        """The fewest explanations that together have the reported probability of 95 %."""
        return credible_set(merged(fits))


def answer_of(reported: Sequence[HypothesisFit]) -> State:
    """The state of an alarm with these explanations, the likeliest first."""
    best = reported[0]
    if best.at_bound:
        return State.CANNOT_TELL
    return State.ISOLATED if len(reported) == 1 and best.fits else State.EXPLAINED
