"""What a monitor carries from sample to sample, and the observer that moves it on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.change import LONG_AGO, NEVER, ChangedObserver, Changes, Window
from fdi_torch.monitor.hypothesis import Finding
from fdi_torch.monitor.samples import Arrived, Samples, joined
from fdi_torch.monitor.states import Alarm

# A believed fault's law may be off by so much of its own effect (a hole is not the orifice of a formula).
OFF = 0.1


@dataclass(frozen=True)
class Track:
    """The size of a fault that stands, over time. column: of the space. first, last: (s, size, std) of the first and
    the latest estimate. strength: root mean square of what it adds to the white residuals, as far as it is known.
    announced: when its size was last said aloud, s.
    """

    column: int
    number: int
    onset: float
    first: tuple[float, float, float]
    last: tuple[float, float, float]
    strength: float
    announced: float
    adjusted: float = LONG_AGO

    @property
    def rate(self) -> float | None:
        """Of its growth between the two, per s; None where they do not differ by three standard errors."""
        (t0, size0, std0), (t1, size1, std1) = self.first, self.last
        apart = t1 > t0 and abs(size1 - size0) > 3.0 * math.hypot(std0, std1)
        return (size1 - size0) / (t1 - t0) if apart else None


@dataclass(frozen=True)
class Change:
    """The latest change. number: of its alarm, raised at `alarm` s. before (P,): the belief before it, held since
    `since` s. explanations: all that hold more than a thousandth of the posterior, likeliest first; the first is what
    the observer believes. next_look: when all of them are fitted again, s. ends: the faults that went away with it.
    told: names of the explanations as they were said last.
    """

    number: int
    before: Tensor
    since: float
    explanations: tuple[Finding, ...]
    alarm: float
    next_look: float
    ends: tuple[Track, ...] = ()
    told: tuple[tuple[str, ...], ...] = ()

    @property
    def finding(self) -> Finding:
        """The likeliest that changes something."""
        return self.explanations[0]


@dataclass(frozen=True)
class Looking:
    """An alarm that is being confirmed: its number, and how often its cause was sought in vain."""

    number: int
    looks: int = 0


@dataclass(frozen=True)
class MonitorState:
    """All that a monitor carries from sample to sample.

    samples: what came lately; for each, state (S, tanks + M) of the observer after it, residual and white (S, sensors),
    and effect (S, E, sensors): by how much the residual would be another without each of the effects believed in.
    number: samples since the observer's start. believed (P,); healthy (P,): the same without a fault. blind
    (E, tanks + M): the states of observers without each effect. reachable: no window starts before it, s. rest
    (sensors,): white residuals that are the believed faults' own, in standard deviations of noise, where they do not
    explain all. arrived: how far the clock has come. floor: no window begins before it, s, whatever is still held.
    charted: what the detector remembers, None where it starts afresh. alarms: all so far. looking: the one that is
    being confirmed. change: the latest. tracks: the faults that stand. learning_until: no alarm comes up to then, s.
    """

    samples: Samples
    state: Tensor
    residual: Tensor
    white: Tensor
    effect: Tensor
    number: int
    believed: Tensor
    healthy: Tensor
    blind: Tensor
    reachable: float
    rest: Tensor
    arrived: Arrived
    floor: float = LONG_AGO
    charted: Tensor | None = None
    alarms: tuple[Alarm, ...] = ()
    looking: Looking | None = None
    change: Change | None = None
    tracks: tuple[Track, ...] = ()
    learning_until: float = LONG_AGO

    @property
    def adjusted(self) -> float:
        """Since when sizes other than the latest change says are believed in, s."""
        return max((t.adjusted for t in self.tracks), default=LONG_AGO)

    def alarm(self, number: int) -> Alarm:
        return self.alarms[number - 1]

    def with_alarm(self, alarm: Alarm) -> MonitorState:
        return replace(self, alarms=tuple(alarm if a.number == alarm.number else a for a in self.alarms))

    @property
    def now(self) -> float:
        """When the last sample came, s."""
        return float(self.samples.time[-1])

    def standing(self, observer: ChangedObserver) -> list[int]:
        """Which of the space's effects are believed in as faults."""
        off = (self.believed != self.healthy).tolist()
        return [e for e, columns in enumerate(observer.effects) if any(off[c] for c in columns)]

    def without_each(self, observer: ChangedObserver) -> Tensor:
        """What is believed, each time without one of the faults that stand, (standing, P)."""
        standing = self.standing(observer)
        theta = self.believed.repeat(len(standing), 1)
        for lane, e in enumerate(standing):
            theta[lane, list(observer.effects[e])] = self.healthy[list(observer.effects[e])]
        return theta

    def before(self, moment: float) -> int:
        """The last sample before a moment, so that at least two follow; the first where there is none."""
        return max(min(int((self.samples.time < moment).sum()) - 1, len(self.samples) - 3), 0)

    def window(self, start: float) -> Window:
        """From the last sample before `start` on."""
        first = self.before(max(start, self.floor))
        seen = self.number - (len(self.samples) - 1 - first)
        return Window(self.samples.stretch(first, len(self.samples)), self.state[first], seen)


def begin(
    observer: ChangedObserver, samples: Samples, believed: Tensor, healthy: Tensor, levels: Tensor | None = None
) -> MonitorState:
    """The state after the first of some samples; levels (tanks,) from the readings where not given."""
    first = samples.stretch(0, 1)
    state, residual = observer.first_state(samples, believed, levels)
    white, effects = observer.whitening(residual[None]), len(observer.effects)
    blind, none = state.expand(effects, -1), torch.zeros_like(residual)
    effect = none.expand(1, effects, -1)
    now = float(first.time[0])
    return MonitorState(
        first, state[None], residual[None], white, effect, 1, believed, healthy, blind, now, none, Arrived(now)
    )


def observe(observer: ChangedObserver, state: MonitorState, samples: Samples) -> MonitorState:
    """The observer moved on by some samples."""
    last = len(state.samples) - 1
    window = Window(joined(state.samples.stretch(last, last + 1), samples), state.state[-1], state.number)
    state = replace(state, samples=joined(state.samples, samples), number=state.number + len(samples))
    return _run(observer, state, window, state.blind, state.believed, NEVER)


def believe(observer: ChangedObserver, state: MonitorState, change: Change, believed: Tensor) -> MonitorState:
    """The observer run again from the change's onset with the new values (P,); the detector starts afresh."""
    finding = change.finding
    window = state.window(finding.onset)
    incipient, standing = finding.hypothesis.incipient, state.standing(observer)
    state = replace(state, believed=believed, change=change, looking=None, charted=None)
    moved = _run(observer, state, window, _alike(observer, window), change.before, finding.onset, incipient)
    left = moved.white[-len(window) :].square().nanmean(dim=0).nan_to_num().sqrt()
    if finding.fits or not moved.standing(observer):
        left = torch.zeros_like(left)
    elif set(state.standing(observer)) >= set(standing):
        left = torch.maximum(left, state.rest)  # nothing went away: what was left before may come back
    return replace(moved, rest=left)


def adjust(observer: ChangedObserver, state: MonitorState, finding: Finding) -> MonitorState:
    """The observer run again with other sizes of the faults that it believes in."""
    window, before = state.window(finding.onset), state.believed
    moved = replace(state, believed=finding.value, charted=None)
    return _run(observer, moved, window, _alike(observer, window), before, finding.onset)


def forget(state: MonitorState) -> MonitorState:
    """Without what no window reaches, once that is a quarter of all."""
    first = max(int((state.samples.time < state.floor).sum()) - 1, 0)
    if first < 0.25 * len(state.samples):
        return state
    return replace(
        state,
        samples=state.samples.stretch(first, len(state.samples)),
        state=state.state[first:],
        residual=state.residual[first:],
        white=state.white[first:],
        effect=state.effect[first:],
    )


def trusted(observer: ChangedObserver, state: MonitorState, count: int) -> Tensor:
    """The last white residuals (count, sensors) in standard deviations of noise and of the believed faults' own
    imperfection: e / sqrt(max(1, rest)^2 + sum (OFF f)^2), with f what each of them takes out of the residual at that
    moment, and rest what they left in it when they were found.
    """
    standing = state.standing(observer)
    if not standing:
        return state.white[-count:]
    known = count + observer.whitening.order
    effects = observer.whitening.filter(state.effect[-known:, standing].movedim(1, 0))[:, -count:]
    return state.white[-count:] / torch.sqrt(state.rest.clamp(min=1.0) ** 2 + (OFF * effects).square().sum(0))


def strength(observer: ChangedObserver, state: MonitorState, column: int, since: float) -> float:
    """Root mean square of what a fault that stands adds to the white residuals since a moment (s)."""
    [effect] = [e for e, columns in enumerate(observer.effects) if column in columns]
    count = max(int((state.samples.time > since).sum()), 1)
    return float(observer.whitening.filter(state.effect[:, effect])[-count:].square().mean().sqrt())


def _run(
    observer: ChangedObserver,
    state: MonitorState,
    window: Window,
    blind: Tensor,
    before: Tensor,
    onset: float,
    incipient: bool = False,
) -> MonitorState:
    """The state with its last samples, those of a window, run (again): from the belief `before` to the one held now.

    blind (E, tanks + M): at the window's start, of observers without one of the effects that are believed in, which run
    beside it.
    """
    first, standing = len(state.samples) - len(window), state.standing(observer)
    theta = torch.cat([state.believed[None], state.without_each(observer)])
    onsets = before.new_tensor([onset, *[LONG_AGO] * len(standing)])
    changes = Changes(theta, onsets, torch.tensor([incipient, *[False] * len(standing)]))
    starts = torch.cat([window.state[None], blind[standing]])
    path, residual = observer.follow(replace(window, state=starts), before, changes)
    effect = residual.new_zeros(len(window), len(observer.effects), residual.shape[-1])
    effect[:, standing] = (residual[1:] - residual[0]).movedim(0, 1).nan_to_num()
    last = path[0, -1].repeat(len(observer.effects), 1)
    last[standing] = path[1:, -1]
    moved = replace(
        state,
        state=torch.cat([state.state[:first], path[0]]),
        residual=torch.cat([state.residual[:first], residual[0]]),
        effect=torch.cat([state.effect[:first], effect]),
        blind=last,
    )
    return _whitened(observer, moved, first)


def _alike(observer: ChangedObserver, window: Window) -> Tensor:
    """Observers without one effect that begin where the one with all of them is, (E, tanks + M)."""
    return window.state.expand(len(observer.effects), -1)


def _whitened(observer: ChangedObserver, state: MonitorState, first: int) -> MonitorState:
    """White residuals from sample `first` on, made anew from the residuals before and after it."""
    history = max(first - observer.whitening.order, 0)
    white = observer.whitening(state.residual[history:])[first - history :]
    return replace(state, white=torch.cat([state.white[:first], white]))
