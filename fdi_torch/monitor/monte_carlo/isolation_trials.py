"""Isolation trials: smallest isolable fault sizes, and the fault that the monitor names in a simulated run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from fdi_torch.monitor.hypothesis import SHAPE, Fault
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow, no_change
from fdi_torch.monitor.samples import Samples
from fdi_torch.parameters import ParameterName

# Error rates that define an isolable size: false alarms and missed faults.
FALSE_ALARM, MISS = 0.001, 0.05
TRIAL_SIZE = 0.01  # fault size for signatures, as a share of the parameter's range
RIVAL_ONSETS = 13  # onsets about the fault's own at which another fault may have the same signature


@dataclass(frozen=True)
class FaultScenario:
    """A fault to simulate. shape: values of period and phase by column. incipient: whether it grows slowly."""

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
    observer: ObserverBank, window: ObserverWindow, believed: Tensor, scenarios: Sequence[FaultScenario], onset: float
) -> list[float]:
    """Smallest deviation of each fault, in its parameter's unit, that is distinguished from every other single fault.

    It follows from the angle between its signature and the nearest other one, over all sizes, onsets and manners of
    growth: |signature| sin(angle) = reach. Infinite if another fault has the same signature.
    """
    reach = NormalDist().inv_cdf(1.0 - 0.5 * FALSE_ALARM) + NormalDist().inv_cdf(1.0 - MISS)
    base = observer.white_innovations(window, believed, no_change(believed)).flatten(1)
    end = float(window.samples.time[-1])
    offsets = torch.linspace(-0.2, 0.4, RIVAL_ONSETS, dtype=believed.dtype) * (end - onset)
    trials = [
        TRIAL_SIZE * float(observer.space_width()[k.fault.size]) * _inward(observer, believed, k) for k in scenarios
    ]
    theta = torch.stack(
        [k.theta(believed, float(believed[k.fault.size]) + t) for k, t in zip(scenarios, trials, strict=True)]
    )
    onsets = onset + offsets
    incipient = torch.tensor([k.incipient for k in scenarios])
    rivals = ChangeHypotheses(
        theta.repeat_interleave(RIVAL_ONSETS, 0),
        onsets.repeat(len(scenarios)),
        incipient.repeat_interleave(RIVAL_ONSETS),
    )
    blocks = observer.in_blocks(window, rivals)
    shapes = torch.cat([base - observer.white_innovations(window, believed, block).flatten(1) for block in blocks])
    unit = shapes / torch.linalg.vector_norm(shapes, dim=1).clamp(min=1e-30).unsqueeze(1)
    at_onset = ChangeHypotheses(theta, torch.full((len(scenarios),), onset, dtype=believed.dtype), incipient)
    signature = base - observer.white_innovations(window, believed, at_onset).flatten(1)
    length = torch.linalg.vector_norm(signature, dim=1)
    cosine = (signature / length.clamp(min=1e-30).unsqueeze(1)) @ unit.mT
    columns = torch.tensor([k.fault.size for k in scenarios])
    same_fault = columns.unsqueeze(1) == columns.repeat_interleave(RIVAL_ONSETS)
    nearest = torch.where(same_fault, 0.0, cosine.abs()).amax(1).clamp(max=1.0)
    distance = length * torch.sqrt(1.0 - nearest**2)
    return [
        reach * abs(t) / float(d) if float(d) > 1e-9 else float("inf") for t, d in zip(trials, distance, strict=True)
    ]


def _inward(observer: ObserverBank, believed: Tensor, scenario: FaultScenario) -> float:
    """Sign of a deviation towards the farther end of the parameter's range."""
    p = observer.space.parameters[scenario.fault.size]
    return (
        1.0 if p.high - float(believed[scenario.fault.size]) >= float(believed[scenario.fault.size]) - p.low else -1.0
    )


@dataclass(frozen=True)
class IsolationResult:
    """Result of the monitor on one run.

    alarm: time of the first alarm after the onset, s, or None. last: the faults named by the last event after the
    onset, without period and phase of an oscillation. early: number of earlier alarms.
    """

    alarm: float | None
    last: tuple[str, ...]
    early: int


def isolate_run(monitor: Monitor, samples: Samples, believed: Tensor, levels: Tensor, onset: float) -> IsolationResult:
    """Run the monitor along one run. believed (P,) and levels (tanks,) m: at the first sample;
    onset of the fault, s.
    """
    state = monitor.start(samples, believed, levels)
    _, events = monitor.advance(state, samples.segment(1, len(samples)))
    alarms = [e.time for e in events if e.kind == "alarm"]
    after = [t for t in alarms if t >= onset]
    named = next((e.faults for e in reversed(events) if e.faults and e.time >= onset), ())
    last = tuple(name for name in named if ParameterName.parse(name).field not in SHAPE)
    return IsolationResult(after[0] if after else None, last, len(alarms) - len(after))


def confusions(truth: Sequence[str], named: Sequence[tuple[str, ...]], most: int = 8) -> list[tuple[str, str, int]]:
    """The most frequent wrong answers: (true fault, named faults, count)."""
    wrong = Counter((t, " + ".join(s) or "nothing") for t, s in zip(truth, named, strict=True) if s != (t,))
    return [(t, s, n) for (t, s), n in wrong.most_common(most)]
