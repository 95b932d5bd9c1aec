"""From findings to events: explanations with their masses and sizes, and the text that people read."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from fdi_torch.monitor.change import ChangedObserver
from fdi_torch.monitor.events import (
    Event,
    Explanation,
    Kind,
    Limit,
    Size,
    amount,
    headline,
    rate_words,
    shares_words,
)
from fdi_torch.monitor.following import Change, MonitorState, Track
from fdi_torch.monitor.hypothesis import Finding
from fdi_torch.monitor.limits import limits
from fdi_torch.monitor.noise import Noise
from fdi_torch.monitor.settings import MonitorSettings
from fdi_torch.monitor.states import Alarm

AHEAD = 4.0  # longest windows: how far the plant is run ahead


class Teller:
    """Makes the events of one monitor."""

    def __init__(self, observer: ChangedObserver, noise: Noise, settings: MonitorSettings, watched: int) -> None:
        self.observer, self.space, self.noise, self.settings = observer, observer.space, noise, settings
        self.watched, self.matters = watched, {m.fault: m for m in observer.network.description.matters}

    def notice(self, state: MonitorState, text: str) -> Event:
        return self._event(state, "notice", text)

    def raised(self, state: MonitorState, alarm: Alarm) -> Event:
        told = shares_words(alarm.shares)
        return self._event(state, "alarm", f"the residual leaves its fault-free range: {told}", alarm)

    def answered(self, state: MonitorState, change: Change, found: Sequence[Finding], kind: Kind, aloud: bool) -> Event:
        """What explains an alarm. found: the explanations that are told, likeliest first."""
        alarm, best = state.alarm(change.number), found[0]
        explanations = tuple(self.explanation(f, change, state.now) for f in found)
        text = f"{headline(explanations)}, {_since(best)}"
        if best.onset - state.reachable <= 2.0 * max(best.onset_std, 0.5):
            text += ", where the observer starts: it may have been there before"
        rates = [rate_words(self.space[s.name], s.rate) for s in explanations[0].sizes if s.rate is not None]
        text += f"; grows by {', '.join(rates)}" if rates else ""
        if best.rest > 1.0:
            text += "; does not explain all of the residual"
        ahead = self._limits(state, change, found)
        text += "".join(f"; {limit.words}" for limit in ahead[:1] if limit.chance > 0.5)
        delay, (urgency, announced) = change.alarm - best.onset, self._severity(explanations)
        text += f"; urgency: {urgency}" if urgency else ""
        return self._event(
            state, kind, text, alarm, explanations=explanations, delay=delay, limits=ahead, severity=urgency,
            announced=announced and aloud,
        )  # fmt: skip

    def _limits(self, state: MonitorState, change: Change, found: Sequence[Finding]) -> tuple[Limit, ...]:
        """What comes if nothing changes; the draws are those of the alarm's number."""
        changing = [f for f in found if f.hypothesis.columns]
        generator = torch.Generator().manual_seed(change.number)
        horizon = AHEAD * self.settings.longest
        return limits(self.observer, self.noise, state, change, changing, horizon, self.settings.lookback, generator)

    def _severity(self, explanations: Sequence[Explanation]) -> tuple[str, bool]:
        """The plant file's word for the likeliest explanation, and whether any of its faults is large enough to be said
        aloud.
        """
        words, loud = [], []
        for s in explanations[0].sizes:
            matter = self.matters.get(s.name)
            large = matter is None or abs(s.size - self.space[s.name].nominal) >= matter.smallest
            loud.append(large)
            words += [matter.urgency] if matter and large and matter.urgency else []
        return ", ".join(dict.fromkeys(words)), any(loud)

    def unexplained(self, state: MonitorState, number: int, found: Sequence[Finding]) -> Event:
        explanations = tuple(self.explanation(f, None, state.now) for f in found)
        text = f"no fault of the list explains the alarm better than chance does: {headline(explanations)}"
        return self._event(state, "cannot tell", text, state.alarm(number), explanations=explanations)

    def retired(self, state: MonitorState, alarm: Alarm, reason: str, announced: bool) -> Event:
        return self._event(state, "retired", f"alarm {alarm.number}: {reason}", alarm, announced=announced)

    def ended(
        self,
        state: MonitorState,
        change: Change,
        found: Sequence[Finding],
        number: int,
        names: Sequence[str],
        observable: bool,
    ) -> Event:
        """Faults of one alarm that went away; or that the readings no longer show, whether they stand or not."""
        explanations = tuple(self.explanation(f, change, state.now) for f in found)
        text = f"{', '.join(names)}: back to nominal, {_since(found[0])}"
        if " or " in headline(explanations):
            text += f"; {headline(explanations)}"
        if not observable:
            text = (
                f"{', '.join(names)}: the readings since {found[0].onset:.1f} s would not show whether it still stands"
            )
        kind: Kind = "recovered" if observable else "cannot tell"
        delay = change.alarm - found[0].onset
        return self._event(state, kind, text, state.alarm(number), explanations=explanations, delay=delay)

    def followed(self, state: MonitorState, tracks: Sequence[Track], due: Sequence[Track]) -> list[Event]:
        """New sizes of faults that stand; due: those that are said aloud again."""
        return [
            self._event(
                state,
                "followed",
                f"{self._track_words(t)}, since {t.onset:.1f} s",
                state.alarm(t.number),
                explanations=(self._track_explanation(t),),
                announced=t in due,
            )
            for t in tracks
        ]

    def summary(self, state: MonitorState, alarm: Alarm) -> Event:
        """One line for an alarm, at the end of what is followed."""
        own = [t for t in state.tracks if t.number == alarm.number]
        what = "; ".join(f"{self._track_words(t)}, since {t.onset:.1f} s" for t in own) or ", ".join(alarm.faults)
        times = f"raised {alarm.count} times, {alarm.first:g} s to {alarm.last:g} s" if alarm.count > 1 else (
            f"raised at {alarm.first:g} s"
        )  # fmt: skip
        text = f"alarm {alarm.number}, {alarm.state}{': ' if what else ''}{what}; {times}"
        explanations = tuple(self._track_explanation(t) for t in own)
        return self._event(state, "summary", text, alarm, explanations=explanations)

    def explanation(self, finding: Finding, change: Change | None, now: float) -> Explanation:
        h, sizes = finding.hypothesis, []
        for c in h.columns:
            p, size, std = self.space.parameters[c], float(finding.value[c]), float(finding.std[c])
            at_end = c in finding.at_end
            grows = change is not None and h.incipient and c in h.sizes and now > finding.onset
            rate = (size - float(change.before[c])) / (now - finding.onset) if grows and change else None
            sizes.append(Size(p.name, size, std, p.unit, amount(p, size, std, at_end), at_end, rate))
        if not sizes:
            return Explanation(finding.mass, ())
        gone = set(h.gone) >= set(h.sizes)
        return Explanation(finding.mass, tuple(sizes), finding.onset, finding.onset_std, h.incipient, gone)

    def _track_explanation(self, track: Track) -> Explanation:
        p, (_, size, std) = self.space.parameters[track.column], track.last
        told = Size(p.name, size, std, p.unit, amount(p, size, std), rate=track.rate)
        return Explanation(1.0, (told,), track.onset, None, track.rate is not None)

    def _track_words(self, track: Track) -> str:
        p, (_, size, std) = self.space.parameters[track.column], track.last
        grows = f", changes by {rate_words(p, track.rate)}" if track.rate is not None else ""
        return amount(p, size, std) + grows

    def _event(self, state: MonitorState, kind: Kind, text: str, alarm: Alarm | None = None, **more: object) -> Event:
        off = (state.believed != state.healthy).nonzero().flatten().tolist()
        believed = tuple((self.space.names[c], float(state.believed[c])) for c in off if c < self.watched)
        if alarm is None:
            return Event(state.now, kind, text, believed=believed)
        return Event(
            state.now, kind, text, alarm.number, alarm.state, shares=alarm.shares, first=alarm.first, last=alarm.last,
            count=alarm.count, believed=believed, **more,  # type: ignore[arg-type]
        )  # fmt: skip


def _since(finding: Finding) -> str:
    manner = "growing since" if finding.hypothesis.incipient else "since"
    return f"{manner} {finding.onset:.1f} ± {finding.onset_std:.2g} s"
