"""Events of a monitor made from its state: explanations with probabilities and sizes, and the text that people read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from fdi_torch.amounts import estimate_words, parameter_words
from fdi_torch.estimate.diagnosis import fault_flow
from fdi_torch.monitor.alarm_state import Alarm
from fdi_torch.monitor.events import (
    Event,
    Explanation,
    Kind,
    Size,
    headline,
    rates_text,
    shares_text,
    size_of,
)
from fdi_torch.monitor.hypothesis import HypothesisFit
from fdi_torch.monitor.level_forecast import forecast_limits
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monitor_state import DetectedChange, FaultTrack, HiddenFault, MonitorState
from fdi_torch.monitor.observer_bank import ObserverBank
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.effect import Stage

FORECAST_WINDOWS = 4.0  # horizon of the level forecast, in longest windows


Ends = Mapping[int, tuple[float, float] | None]
"""First and last time at which a fault may have ended, s, by the column of its size; None: at the onset of the fit."""


class EventWriter:
    """Writes the events of one monitor."""

    def __init__(self, observer: ObserverBank, settings: MonitorSettings, watched: int) -> None:
        self.observer, self.space, self.settings = observer, observer.space, settings
        self.watched, self.matters = watched, {m.fault: m for m in observer.network.description.matters}

    def notice(self, state: MonitorState, text: str) -> Event:
        return self._event(state, "notice", text)

    def raised(self, state: MonitorState, alarm: Alarm) -> Event:
        """A new alarm, with the sensors that raised it."""
        text = f"the residual leaves its fault-free range: {shares_text(alarm.shares)}"
        return self._event(state, "alarm", text, alarm)

    def answered(
        self,
        state: MonitorState,
        change: DetectedChange,
        fits: Sequence[HypothesisFit],
        kind: Kind,
        announce: bool,
    ) -> Event:
        """The explanation of an alarm. fits: the reported explanations, likeliest first."""
        alarm, best = state.alarm(change.number), fits[0]
        explanations = tuple(self.explanation(f, state, change) for f in fits)
        text = f"{headline(explanations)}, {_onset_text(best, best.hypothesis.incipient)}"
        interval = float(torch.diff(state.samples.time).median())
        if best.onset - state.reachable <= max(2.0 * best.onset_std, interval):
            text += ", where the observer starts: it may have been there before"
        text += rates_text(explanations[0].sizes, self.space) + _unexplained_text(best)
        faulty = [f for f in fits if f.hypothesis.columns]
        horizon, lookback = FORECAST_WINDOWS * self.settings.longest, self.settings.lookback
        generator = torch.Generator().manual_seed(change.number)  # the draws depend on the alarm's number only
        limits = forecast_limits(self.observer, state, change, faulty, horizon, lookback, generator)
        text += "".join(f"; {limit.text}" for limit in limits[:1] if limit.chance > 0.5)
        delay, (urgency, large) = change.alarm_time - best.onset, self._severity(explanations)
        text += f"; urgency: {urgency}" if urgency else ""
        return self._event(
            state, kind, text, alarm, explanations=explanations, delay=delay, limits=limits, severity=urgency,
            announced=large and announce,
        )  # fmt: skip

    def unexplained(self, state: MonitorState, number: int, fits: Sequence[HypothesisFit]) -> Event:
        """An alarm for which "no change" is among the likely explanations."""
        explanations = tuple(self.explanation(f, state) for f in fits)
        text = f"the likeliest cause of the alarm is no fault of the list: {headline(explanations)}"
        return self._event(state, "cannot tell", text, state.alarm(number), explanations=explanations)

    def retired(self, state: MonitorState, alarm: Alarm, reason: str, announced: bool) -> Event:
        return self._event(state, "retired", f"alarm {alarm.number}: {reason}", alarm, announced=announced)

    def ended(
        self,
        state: MonitorState,
        change: DetectedChange,
        fits: Sequence[HypothesisFit],
        number: int,
        columns: Sequence[int],
        observable: bool,
        ends: Ends,
    ) -> Event:
        """Recovery of the faults of one alarm. columns: of their sizes. observable: whether the readings would show
        them if still present. The likeliest explanation leaves the recovered faults of other alarms to their events.
        """
        explanations = tuple(self.explanation(f, state, change) for f in fits)
        others = {self.space.names[t.column] for t in change.ended if t.column not in columns}
        kept = [name for name in explanations[0].names if name not in others]
        explanations = (explanations[0].restricted_to(kept), *explanations[1:])
        intervals = [interval for c in columns if (interval := ends[c]) is not None]
        uncertain, certain = [c for c in columns if ends[c] is not None], [c for c in columns if ends[c] is None]
        said = []
        if intervals:
            first, last = min(first for first, _ in intervals), max(last for _, last in intervals)
            said.append(f"{self._faults(uncertain)}: back to nominal, between {first:.1f} s and {last:.1f} s")
            explanations = (_at_any_time(explanations[0], first, last), *explanations[1:])
        if certain:
            when = _onset_text(fits[0], fits[0].hypothesis.incipient)
            said.append(f"{self._faults(certain)}: back to nominal, {when}")
        if " or " in headline(explanations):
            said.append(headline(explanations))
        text = "; ".join(said)
        if not observable:
            hidden = f"the readings since {fits[0].onset:.1f} s would not show whether it still stands"
            text = f"{self._faults(columns)}: {hidden}"
        kind: Kind = "recovered" if observable else "cannot tell"
        delay = change.alarm_time - (fits[0].onset if explanations[0].onset is None else explanations[0].onset)
        return self._event(state, kind, text, state.alarm(number), explanations=explanations, delay=delay)

    def _faults(self, columns: Sequence[int]) -> str:
        return ", ".join(parameter_words(self.space.names[c]) for c in columns)

    def end_shown(self, state: MonitorState, number: int, faults: Sequence[HiddenFault]) -> Event:
        """The end of hidden faults of one alarm, once the readings have shown it."""
        names = [parameter_words(self.space.names[f.track.column]) for f in faults]
        first, seen = min(f.ended for f in faults), max(f.seen for f in faults)
        text = f"{', '.join(names)}: back to nominal between {first:.1f} s and {state.now:.1f} s, "
        text += f"as the readings since {seen:.1f} s show"
        nominal = [self.space.parameters[f.track.column] for f in faults]
        sizes = tuple(Size(p.name, p.nominal, 0.0, p.unit, estimate_words(p.name, p.unit, p.nominal)) for p in nominal)
        ended = tuple(p.name for p in nominal)
        explanation = _at_any_time(Explanation(1.0, sizes, ended=ended), first, state.now)
        return self._event(state, "recovered", text, state.alarm(number), explanations=(explanation,))

    def followed(
        self, state: MonitorState, tracks: Sequence[FaultTrack], announced: Sequence[FaultTrack]
    ) -> list[Event]:
        """New sizes of known faults, one event each."""
        return [
            self._event(
                state,
                "followed",
                self._tracks_text((explanation := self._tracks_explanation(state, [t]),), [t]),
                state.alarm(t.number),
                explanations=(explanation,),
                announced=t in announced,
            )
            for t in tracks
        ]

    def summary(self, state: MonitorState, alarm: Alarm) -> Event:
        """Summary of one alarm at the end of the recording: the explanations of its last answer, with the present
        sizes of the likeliest; only their names if its faults have gone.
        """
        tracks = [t for t in state.tracks if t.number == alarm.number]
        faults = headline(alarm.explanations, sizes=False) if alarm.explanations else ""
        explanations: tuple[Explanation, ...] = ()
        if tracks:
            likeliest, *rivals = alarm.explanations
            explanations = (self._tracks_explanation(state, tracks, likeliest.mass), *rivals)
            faults = self._tracks_text(explanations, tracks)
        if state.change is not None and state.change.number == alarm.number:
            faults = (faults + _unexplained_text(state.change.best)).removeprefix("; ")
        if alarm.count > 1:
            times = f"raised {alarm.count} times, {alarm.first:g} s to {alarm.last:g} s"
        else:
            times = f"raised at {alarm.first:g} s"
        text = f"alarm {alarm.number}, {alarm.state}{': ' if faults else ''}{faults}; {times}"
        return self._event(state, "summary", text, alarm, explanations=explanations)

    def explanation(self, fit: HypothesisFit, state: MonitorState, change: DetectedChange | None = None) -> Explanation:
        """A fit in the form that events report."""
        h, now, sizes = fit.hypothesis, state.now, []
        hidden = [f.track.column for f in state.hidden] if change is not None else []
        for c in h.columns:
            p, size, std = self.space.parameters[c], float(fit.value[c]), float(fit.std[c])
            if c in hidden:
                sizes.append(Size(p.name, size, float("inf"), p.unit, f"{ParameterName.parse(p.name).field} unknown"))
                continue
            grows = change is not None and h.incipient and c in h.sizes and now > fit.onset
            rate = (size - float(change.before[c])) / (now - fit.onset) if grows and change else None
            sizes.append(self._size(state, c, size, std, rate))
        if not sizes:
            return Explanation(fit.probability, (), unlisted=h.unlisted or not fit.fits)
        ended = tuple(self.space.names[c] for c in h.recovered if c not in hidden)
        return Explanation(fit.probability, tuple(sizes), fit.onset, fit.onset_std, h.incipient, ended)

    def _severity(self, explanations: Sequence[Explanation]) -> tuple[str, bool]:
        """The urgency of the likeliest explanation, and whether one of its faults is large enough to announce."""
        urgencies, announced = [], []
        for s in explanations[0].sizes:
            matter = self.matters.get(s.name)
            large = matter is None or abs(s.size - self.space[s.name].nominal) >= matter.smallest
            announced.append(large)
            urgencies += [matter.urgency] if matter and large and matter.urgency else []
        return ", ".join(dict.fromkeys(urgencies)), any(announced)

    def _size(self, state: MonitorState, column: int, size: float, std: float, rate: float | None) -> Size:
        """A parameter's estimate; of a fault that adds a flow, such as a leak, with the flow at the present levels."""
        p, network = self.space.parameters[column], self.observer.network
        shown, prefix = size_of(p, size, std, rate), ParameterName.parse(p.name).prefix
        adds_flow = any(x.prefix == prefix and x.effect.stage is Stage.BALANCE for x in network.placements)
        if shown.at_end or p.unit == "m^3/s" or not adds_flow:
            return shown
        value = state.believed.clone()
        value[column] = size
        levels, inputs = state.state[-1, : len(network.description.tanks)], state.samples.inputs[-1].nan_to_num()
        return replace(shown, flow=fault_flow(network, self.space, value, column, levels, inputs)[0])

    def _tracks_explanation(self, state: MonitorState, tracks: Sequence[FaultTrack], mass: float = 1.0) -> Explanation:
        """The present sizes of known faults as one explanation, with the onset of the first."""
        sizes = tuple(self._size(state, t.column, *self._present(t, state.now), t.rate) for t in tracks)
        first = min(tracks, key=lambda t: t.onset)
        return Explanation(mass, sizes, first.onset, first.onset_std, any(s.rate is not None for s in sizes))

    def _present(self, track: FaultTrack, now: float) -> tuple[float, float]:
        """The size of a known fault now, within its range, and its standard deviation."""
        size, std = track.at(now)
        p = self.space.parameters[track.column]
        return min(max(size, p.low), p.high), std

    def _tracks_text(self, explanations: Sequence[Explanation], tracks: Sequence[FaultTrack]) -> str:
        """The explanations, the likeliest of which consists of known faults, with the onset and growth of these."""
        since = ", ".join(dict.fromkeys(_onset_text(t) for t in tracks))
        return f"{headline(explanations)}, {since}{rates_text(explanations[0].sizes, self.space)}"

    def _event(self, state: MonitorState, kind: Kind, text: str, alarm: Alarm | None = None, **more: object) -> Event:
        off = (state.believed != state.healthy).nonzero().flatten().tolist()
        believed = tuple((self.space.names[c], float(state.believed[c])) for c in off if c < self.watched)
        if alarm is None:
            return Event(state.now, kind, text, believed=believed)
        return Event(
            state.now, kind, text, alarm.number, alarm.state, shares=alarm.shares, first=alarm.first, last=alarm.last,
            count=alarm.count, believed=believed, **more,  # type: ignore[arg-type]
        )  # fmt: skip


def _at_any_time(explanation: Explanation, first: float, last: float) -> Explanation:
    """The explanation with an onset at any time between two, s: mean and standard deviation."""
    return replace(explanation, onset=0.5 * (first + last), onset_std=(last - first) / 12.0**0.5)


def _unexplained_text(fit: HypothesisFit) -> str:
    return "; does not explain all of the residual" if fit.misfit_ratio > 1.0 else ""


def _onset_text(change: HypothesisFit | FaultTrack, growing: bool = False) -> str:
    return f"{'growing since' if growing else 'since'} {change.onset:.1f} ± {change.onset_std:.2g} s"
