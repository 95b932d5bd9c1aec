"""Monte Carlo plan: isolation of sudden and incipient faults, a multiple of their smallest isolable sizes, of
components, sensors and actuators.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from fdi_torch.estimate.proportion import wilson
from fdi_torch.monitor.detection import Chart, make_detector
from fdi_torch.monitor.diagnosability import REACH
from fdi_torch.monitor.hypothesis import SHAPE, Fault
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monte_carlo.simulated_runs import (
    FaultSchedule,
    Numbers,
    SimulatedRig,
    Task,
    fault_free_schedule,
    quantiles,
    seeded_generator,
)
from fdi_torch.monitor.noise_model import learn_noise
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow, no_change
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.state_update import advance_observer
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.scales import time_scale
from fdi_torch.tables import Table

RUNS_PER_TASK = 10
NAME = "naming"
LARGEST_SHARE = 0.9  # of a parameter's range; faults that need a larger size are left out
# Period of a simulated oscillation, and what a window shows before the onset, in units of the plant's time scale.
PERIOD, BEFORE_ONSET = 40.0, 60.0


@dataclass(frozen=True)
class IsolationPlan:
    """Every fault in the space of the rig is simulated, sudden and (except stuck sensors and oscillations) incipient.

    loop: name of the plan, "open" or "closed". times: fault size as a multiple of the smallest isolable size.
    """

    rig: SimulatedRig
    loop: str
    chart: Chart
    monitor: MonitorSettings
    runs: int
    samples: int
    onset: float
    times: float
    every: float
    seed: int

    def tasks(self) -> list[Task]:
        firsts = range(0, self.runs, RUNS_PER_TASK)
        return [Task(f"{NAME}/{self.loop}", lambda first=first: self._isolate(first)) for first in firsts]  # type: ignore[misc]

    @cached_property
    def _designed(self) -> tuple[Monitor, list[FaultScenario], list[float]]:
        """The monitor, with the noise of a fault-free run, the simulated faults, their smallest isolable sizes."""
        rig = self.rig
        nominal = rig.space.nominal()
        training = rig.run(fault_free_schedule(rig.space, 1), 3600, seeded_generator(self.seed, 6)).member(0)
        noise, _ = learn_noise(rig.network, training, rig.space, nominal, levels=rig.levels)
        sensors = training.readings.shape[-1]
        detector = make_detector(
            self.chart, self.every, rig.sampling, sensors, seeded_generator(self.seed, 7), learnt=noise.whitening
        )
        monitor = Monitor(rig.network, rig.space, noise, detector, self.monitor)
        scenarios = self._scenarios(monitor)
        free = training.segment(0, self.samples)
        state = advance_observer(monitor.observer, monitor.start(free, levels=rig.levels), free.segment(1, len(free)))
        window = state.window(self.onset - BEFORE_ONSET * time_scale(rig.network.description))
        smallest = smallest_isolable(monitor.observer, window, nominal, scenarios, self.onset)
        isolable = [(k, s) for k, s in zip(scenarios, smallest, strict=True) if self._in_range(k, s)]
        return monitor, [k for k, _ in isolable], [s for _, s in isolable]

    def _scenarios(self, monitor: Monitor) -> list[FaultScenario]:
        scenarios, period = [], PERIOD * time_scale(self.rig.network.description)
        for fault in monitor.faults:
            names = [ParameterName.parse(self.rig.space.names[c]).field for c in fault.shape]
            shape = tuple((c, period if n == "period" else 0.7) for c, n in zip(fault.shape, names, strict=True))
            stuck = "stuck" in self.rig.space.names[fault.size]
            manners = (False,) if shape or stuck else (False, True)
            scenarios += [FaultScenario(fault, shape, incipient) for incipient in manners]
        return scenarios

    def _isolate(self, first: int) -> Numbers:
        monitor, scenarios, smallest = self._designed
        rig, count = self.rig, min(RUNS_PER_TASK, self.runs - first)
        chosen = [(first + r) % len(scenarios) for r in range(count)]
        nominal, end = rig.space.nominal(), (self.samples - 1) * rig.sampling
        theta = torch.stack([scenarios[k].theta(nominal, self._size(scenarios[k], smallest[k])) for k in chosen])
        onset = torch.full((count,), self.onset, dtype=theta.dtype)
        ramp = torch.tensor([end - self.onset if scenarios[k].incipient else 0.0 for k in chosen], dtype=theta.dtype)
        seen = rig.run(FaultSchedule(theta, onset, ramp), self.samples, seeded_generator(self.seed, 8, first))
        results = [isolate_run(monitor, seen.member(r), nominal, rig.levels, self.onset) for r in range(count)]
        names = [rig.space.names[scenarios[k].fault.size] for k in chosen]
        return {
            "fault": [
                f"{n} {'slow' if scenarios[k].incipient else 'sudden'}" for n, k in zip(names, chosen, strict=True)
            ],
            "named": [" + ".join(s.last) for s in results],
            "delay": [-1.0 if s.alarm is None else s.alarm - self.onset for s in results],
            "early": float(sum(s.early for s in results)),
            "ways": float(len(scenarios)),
        }

    def _in_range(self, scenario: FaultScenario, smallest: float) -> bool:
        """Whether the parameter's range allows the size; otherwise the fault is not isolable in this experiment."""
        p = self.rig.space.parameters[scenario.fault.size]
        return self.times * smallest <= LARGEST_SHARE * max(p.high - p.nominal, p.nominal - p.low)

    def _size(self, scenario: FaultScenario, smallest: float) -> float:
        p = self.rig.space.parameters[scenario.fault.size]
        if "stuck" in p.name:
            return p.high
        up = p.high - p.nominal >= p.nominal - p.low
        return p.nominal + (1.0 if up else -1.0) * self.times * smallest

    def result_table(self, numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
        results = numbers.get(f"{NAME}/{self.loop}", ())
        truth, named_faults = [t for n in results for t in n["fault"]], [s for n in results for s in n["named"]]
        right = sum(t.partition(" ")[0] == s for t, s in zip(truth, named_faults, strict=True))
        low, high = wilson(right, len(named_faults))
        delay_values = [float("inf") if d < 0 else d for n in results for d in n["delay"]]
        q, missed = quantiles(delay_values, (0.5, 0.95)), sum(d == float("inf") for d in delay_values)
        first = (self.loop, str(len(named_faults)), f"{right} ({100 * low:.0f} … {100 * high:.0f} %)", str(missed))
        rows = [(*first, str(sum(int(n["early"]) for n in results)), f"{q[0]:.0f}, {q[1]:.0f}", "")]
        wrong = [(t, tuple(s.split(" + ")) if s else ()) for t, s in zip(truth, named_faults, strict=True)]
        wrong = [(t, s) for t, s in wrong if s != (t.partition(" ")[0],)]
        mistakes = confusions([t for t, _ in wrong], [s for _, s in wrong], 12)
        rows += [("", "", "", "", "", "", f"{t} as {s}: {n}".replace(".size", "")) for t, s, n in mistakes]
        summary = f"{right} of {len(named_faults)} faults named right in {self.loop} loop" if results else ""
        header = ("loop", "runs", "named right", "missed", "false alarms", "delay, s (50, 95 %)", "wrong")
        title = f"faults of {self.times:g} times the smallest isolable size"
        title += f", drawn from {results[0]['ways']:.0f}" if results else ""
        return Table(header, rows if results else (), title, summary=summary)


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
    growth: |signature| sin(angle) = REACH. Infinite if another fault has the same signature.
    """
    base = observer.white_innovations(window, believed, no_change(believed)).flatten(1)
    end = float(window.samples.time[-1])
    offsets = torch.linspace(-0.2, 0.4, RIVAL_ONSETS, dtype=believed.dtype) * (end - onset)
    space, columns = observer.space, [k.fault.size for k in scenarios]
    towards_farther_end = torch.where(space.high() - believed >= believed - space.low(), 1.0, -1.0)
    trials = (TRIAL_SIZE * observer.space_width() * towards_farther_end)[columns].tolist()
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
    shapes = base - observer.white_innovations(window, believed, rivals).flatten(1)
    unit = shapes / torch.linalg.vector_norm(shapes, dim=1).clamp(min=1e-30).unsqueeze(1)
    at_onset = ChangeHypotheses(theta, torch.full((len(scenarios),), onset, dtype=believed.dtype), incipient)
    signature = base - observer.white_innovations(window, believed, at_onset).flatten(1)
    length = torch.linalg.vector_norm(signature, dim=1)
    cosine = (signature / length.clamp(min=1e-30).unsqueeze(1)) @ unit.mT
    of_each = torch.tensor(columns)
    same_fault = of_each.unsqueeze(1) == of_each.repeat_interleave(RIVAL_ONSETS)
    nearest = torch.where(same_fault, 0.0, cosine.abs()).amax(1).clamp(max=1.0)
    distance = length * torch.sqrt(1.0 - nearest**2)
    return [
        REACH * abs(t) / float(d) if float(d) > 1e-9 else float("inf") for t, d in zip(trials, distance, strict=True)
    ]


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
    """Monitor one simulated run. believed (P,), levels (tanks,) m: at the first sample; onset: of the fault, s."""
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
