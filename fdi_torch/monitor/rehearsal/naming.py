"""Whether the right fault is named: simulated faults of a multiple of the smallest size that can be isolated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from fdi_torch.monitor.change import ChangedObserver, Changes, Window, unchanged
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.hypothesis import Fault
from fdi_torch.monitor.monitor import SHAPE, Monitor
from fdi_torch.monitor.samples import Samples

# Rates for which a size is isolable: of calling it where it is not, and of missing it.
FALSE_ALARM, MISS = 0.001, 0.05
TRIAL = 0.01  # of a parameter's range: for signatures
RIVAL_ONSETS = 13  # moments, about the fault's own, at which another fault may imitate it


@dataclass(frozen=True)
class Kind:
    """A fault to be simulated: its column of size, values of its shape by column, and whether it grows slowly."""

    fault: Fault
    shape: tuple[tuple[int, float], ...] = ()
    incipient: bool = False

    def theta(self, believed: Tensor, size: float) -> Tensor:
        """Values (P,) with the fault at `size`."""
        theta = believed.clone()
        theta[self.fault.size] = size
        for column, value in self.shape:
            theta[column] = value
        return theta


def smallest_isolable(
    observer: ChangedObserver, window: Window, believed: Tensor, kinds: Sequence[Kind], onset: float
) -> list[float]:
    """For each kind the deviation, in its parameter's unit, that is told from every other single fault of the list.

    From the distance of its signature to the nearest other one, whatever that one's size, onset and way of growing:
    |signature| sin(angle) = reach. What is told from nothing is infinite.
    """
    reach = NormalDist().inv_cdf(1.0 - 0.5 * FALSE_ALARM) + NormalDist().inv_cdf(1.0 - MISS)
    base = observer.white(window, believed, unchanged(believed)).flatten(1)
    end = float(window.samples.time[-1])
    spread = torch.linspace(-0.2, 0.4, RIVAL_ONSETS, dtype=believed.dtype) * (end - onset)
    trials = [TRIAL * float(observer.space_width()[k.fault.size]) * _inward(observer, believed, k) for k in kinds]
    theta = torch.stack(
        [k.theta(believed, float(believed[k.fault.size]) + t) for k, t in zip(kinds, trials, strict=True)]
    )
    onsets = onset + spread
    late = torch.tensor([k.incipient for k in kinds])
    changes = Changes(
        theta.repeat_interleave(RIVAL_ONSETS, 0), onsets.repeat(len(kinds)), late.repeat_interleave(RIVAL_ONSETS)
    )
    shapes = torch.cat(
        [base - observer.white(window, believed, part).flatten(1) for part in observer.blocks(window, changes)]
    )
    lengths = torch.linalg.vector_norm(shapes, dim=1).clamp(min=1e-30)
    unit = shapes / lengths.unsqueeze(1)
    own = Changes(theta, torch.full((len(kinds),), onset, dtype=believed.dtype), late)
    signature = base - observer.white(window, believed, own).flatten(1)
    length = torch.linalg.vector_norm(signature, dim=1)
    cosine = (signature / length.clamp(min=1e-30).unsqueeze(1)) @ unit.mT
    columns = torch.tensor([k.fault.size for k in kinds])
    same = columns.unsqueeze(1) == columns.repeat_interleave(RIVAL_ONSETS)
    nearest = torch.where(same, 0.0, cosine.abs()).amax(1).clamp(max=1.0)
    apart = length * torch.sqrt(1.0 - nearest**2)
    return [reach * abs(t) / float(a) if float(a) > 1e-9 else float("inf") for t, a in zip(trials, apart, strict=True)]


def _inward(observer: ChangedObserver, believed: Tensor, kind: Kind) -> float:
    p = observer.space.parameters[kind.fault.size]
    return 1.0 if p.high - float(believed[kind.fault.size]) >= float(believed[kind.fault.size]) - p.low else -1.0


@dataclass(frozen=True)
class Named:
    """What the monitor made of a run. alarm: of the first alarm after the onset, s, or None. first, last: parameters
    that the first and the last event after it name; grows: whether the last one says that the fault grows slowly.
    """

    alarm: float | None
    first: tuple[str, ...]
    last: tuple[str, ...]
    grows: bool
    early: int


def name(monitor: Monitor, samples: Samples, believed: Tensor, levels: Tensor, onset: float) -> Named:
    """Follows one run to its end. believed (P,) and levels (tanks,) m at its first sample, onset s of what happens."""
    state = monitor.start(samples, believed, levels)
    _, events = monitor.advance(state, samples.stretch(1, len(samples)))
    return _said(events, onset)


def _said(events: Sequence[Event], onset: float) -> Named:
    alarms = [e.time for e in events if e.kind == "alarm"]
    after = [t for t in alarms if t >= onset]
    told = [e for e in events if e.faults and e.time >= onset]
    first, last = (_sizes(told[0]), _sizes(told[-1])) if told else ((), ())
    return Named(after[0] if after else None, first, last, bool(told) and told[-1].growing, len(alarms) - len(after))


def _sizes(event: Event) -> tuple[str, ...]:
    """The faults that an event names, without the period and phase of one that swings."""
    return tuple(name for name in event.faults if name.rpartition(".")[2] not in SHAPE)


def confusions(truth: Sequence[str], said: Sequence[tuple[str, ...]], most: int = 8) -> list[tuple[str, str, int]]:
    """The commonest wrong answers: (what it was, what was named, how often)."""
    wrong = Counter((t, " + ".join(s) or "nothing") for t, s in zip(truth, said, strict=True) if s != (t,))
    return [(t, s, n) for (t, s), n in wrong.most_common(most)]
