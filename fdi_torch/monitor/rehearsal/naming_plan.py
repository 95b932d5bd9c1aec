"""Rehearsal: whether faults of components, sensors and actuators, sudden and growing, are told from each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from fdi_torch.estimate.proportion import wilson
from fdi_torch.monitor.detection import Chart, make_detector
from fdi_torch.monitor.following import observe
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.noise import Noise, learn_noise
from fdi_torch.monitor.rehearsal.naming import Kind, confusions, name, smallest_isolable
from fdi_torch.monitor.rehearsal.pieces import Numbers, Piece, Shown, quantiles, seeded
from fdi_torch.monitor.rehearsal.runs import Controller, Course, LevelControl, Rig, fault_free
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.settings import MonitorSettings
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import area_scale, time_scale

PART = 10  # runs of a piece
NAME = "naming"
LARGEST_SHARE = 0.9  # of the way to the end of a parameter's range: what needs more is left out
PERIOD = 40.0  # s, of a simulated oscillation
GAIN, RESET = 1.5e-3, 0.01  # m^2/s and 1/s, of a level control on a bench


@dataclass(frozen=True)
class NamingPlan:
    """rig: whose space are the faults. times: multiple of the smallest isolable size. slow: faults that also come
    growing, all but stuck and swinging ones. loop: what the rehearsal is called by.
    """

    rig: Rig
    loop: str
    chart: Chart
    monitor: MonitorSettings
    runs: int
    samples: int
    onset: float
    times: float
    every: float
    seed: int

    def pieces(self) -> list[Piece]:
        firsts = range(0, self.runs, PART)
        return [Piece(f"{NAME}/{self.loop}", lambda first=first: self._named(first)) for first in firsts]  # type: ignore[misc]

    @cached_property
    def _ready(self) -> tuple[Noise, Monitor, list[Kind], list[float]]:
        """The monitor, its noise learnt from a run of its own, and the ways and sizes in which faults come."""
        rig = self.rig
        nominal = rig.space.nominal()
        learnt = _one(rig.run(fault_free(rig.space, 1), 3600, seeded(self.seed, 6)), 0)
        noise, _ = learn_noise(rig.network, learnt, rig.space, nominal, levels=rig.levels)
        sensors = learnt.readings.shape[-1]
        detector = make_detector(
            self.chart, self.every, rig.sampling, sensors, seeded(self.seed, 7), learnt=noise.whitening
        )
        monitor = Monitor(rig.network, rig.space, noise, detector, self.monitor)
        kinds = self._kinds(monitor)
        free = learnt.stretch(0, self.samples)
        state = observe(monitor.observer, monitor.start(free, levels=rig.levels), free.stretch(1, len(free)))
        smallest = smallest_isolable(monitor.observer, state.window(self.onset - 60.0), nominal, kinds, self.onset)
        told = [(k, s) for k, s in zip(kinds, smallest, strict=True) if self._within(k, s)]
        return noise, monitor, [k for k, _ in told], [s for _, s in told]

    def _kinds(self, monitor: Monitor) -> list[Kind]:
        kinds = []
        for fault in monitor.faults:
            names = [self.rig.space.names[c].rpartition(".")[2] for c in fault.shape]
            shape = tuple((c, PERIOD if n == "period" else 0.7) for c, n in zip(fault.shape, names, strict=True))
            held = "stuck" in self.rig.space.names[fault.size]
            ways = (False,) if shape or held else (False, True)
            kinds += [Kind(fault, shape, way) for way in ways]
        return kinds

    def _named(self, first: int) -> Numbers:
        _, monitor, kinds, smallest = self._ready
        rig, count = self.rig, min(PART, self.runs - first)
        chosen = [(first + r) % len(kinds) for r in range(count)]
        nominal, end = rig.space.nominal(), (self.samples - 1) * rig.sampling
        theta = torch.stack([kinds[k].theta(nominal, self._size(kinds[k], smallest[k], monitor)) for k in chosen])
        onset = torch.full((count,), self.onset, dtype=theta.dtype)
        ramp = torch.tensor([end - self.onset if kinds[k].incipient else 0.0 for k in chosen], dtype=theta.dtype)
        seen = rig.run(Course(theta, onset, ramp), self.samples, seeded(self.seed, 8, first))
        said = [name(monitor, _one(seen, r), nominal, rig.levels, self.onset) for r in range(count)]
        names = [rig.space.names[kinds[k].fault.size] for k in chosen]
        return {
            "fault": [f"{n} {'slow' if kinds[k].incipient else 'sudden'}" for n, k in zip(names, chosen, strict=True)],
            "named": [" + ".join(s.last) for s in said],
            "delay": [-1.0 if s.alarm is None else s.alarm - self.onset for s in said],
            "early": float(sum(s.early for s in said)),
            "ways": float(len(kinds)),
        }

    def _within(self, kind: Kind, smallest: float) -> bool:
        """Whether a size so large is there at all; what needs more cannot be told in this experiment."""
        p = self.rig.space.parameters[kind.fault.size]
        return self.times * smallest <= LARGEST_SHARE * max(p.high - p.nominal, p.nominal - p.low)

    def _size(self, kind: Kind, smallest: float, monitor: Monitor) -> float:
        p = self.rig.space.parameters[kind.fault.size]
        if "stuck" in p.name:
            return p.high
        up = p.high - p.nominal >= p.nominal - p.low
        return p.nominal + (1.0 if up else -1.0) * self.times * smallest

    def shown(self, found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Shown:
        own = found.get(f"{NAME}/{self.loop}", ())
        truth, said = [t for n in own for t in n["fault"]], [s for n in own for s in n["named"]]
        right = sum(t.partition(" ")[0] == s for t, s in zip(truth, said, strict=True))
        low, high = wilson(right, len(said))
        late = [float("inf") if d < 0 else d for n in own for d in n["delay"]]
        q, missed = quantiles(late, (0.5, 0.95)), sum(d == float("inf") for d in late)
        first = (self.loop, str(len(said)), f"{right} ({100 * low:.0f} .. {100 * high:.0f} %)", str(missed))
        ways = f"{own[0]['ways']:.0f} ways" if own else ""
        rows = [(*first, str(sum(int(n["early"]) for n in own)), f"{q[0]:.0f}, {q[1]:.0f}", ways)]
        wrong = [(t, tuple(s.split(" + ")) if s else ()) for t, s in zip(truth, said, strict=True)]
        wrong = [(t, s) for t, s in wrong if s != (t.partition(" ")[0],)]
        mixed = confusions([t for t, _ in wrong], [s for _, s in wrong], 12)
        rows += [("", "", "", "", "", "", f"{t} as {s}: {n}".replace(".size", "")) for t, s, n in mixed]
        told = f"{right} of {len(said)} faults named right in {self.loop} loop" if own else ""
        header = ("loop", "runs", "named right", "missed", "false alarms", "delay, s (50, 95 %)", "wrong")
        title = f"faults of {self.times:g} times the smallest isolable size"
        return Shown(title, header, tuple(rows) if own else (), told)


def moving_set_points(
    plant: PlantDescription, steady: Tensor, levels: Tensor, swing: float
) -> Callable[[], Controller]:
    """Level control of the pumped tanks whose set points move up and down by `swing` m each minute of a bench.

    steady (channels,): the commands at rest, one for each pump. levels (tanks,) m: then.
    Raises ValueError where a pump's channel is not its own, or its tank has no sensor.
    """
    pumps, tanks = plant.pumps, [t.name for t in plant.tanks]
    if [p.channel for p in pumps] != list(plant.channels()):
        raise ValueError(f"closed loop: expected a channel for each pump, got {', '.join(plant.channels())}")
    reading = [next((i for i, s in enumerate(plant.sensors) if s.tank == p.target), -1) for p in pumps]
    if -1 in reading:
        tank = pumps[reading.index(-1)].target
        raise ValueError(f"closed loop: expected a sensor at every tank that is pumped into, got none at {tank}")
    sensors, pace = [plant.sensors[i] for i in reading], time_scale(plant)
    at_rest = levels[[tanks.index(p.target) for p in pumps]]
    slope, offset, pumped = (
        levels.new_tensor(x) for x in ([s.gain for s in sensors], [s.offset for s in sensors], [p.gain for p in pumps])
    )
    gain, highest = GAIN * area_scale(plant) / pace / (slope * pumped), levels.new_tensor([p.max_flow for p in pumps])

    def made() -> Controller:
        control, clock = LevelControl(steady, at_rest, reading, gain, RESET / pace, highest / pumped), [0.0]

        def command(readings: Tensor, span: Tensor) -> Tensor:
            clock[0] += float(span)
            minute = int(clock[0] // (60.0 * pace))
            signs = torch.tensor([1.0 if (minute + i) % 2 else -1.0 for i in range(len(pumps))], dtype=levels.dtype)
            control.wanted = slope * (at_rest + swing * signs * (0.4 + 0.3 * (minute % 3))) + offset
            return control(readings, span)

        return command

    return made


def moving_commands(steady: Tensor, share: float) -> Callable[[], Controller]:
    """No control: commands (channels,) that change by up to `share` of themselves each minute."""

    def made() -> Controller:
        clock = [0.0]

        def command(readings: Tensor, span: Tensor) -> Tensor:
            clock[0] += float(span)
            minute = int(clock[0] // 60.0)
            signs = torch.tensor([1.0 if (minute + i) % 2 else -1.0 for i in range(len(steady))], dtype=steady.dtype)
            now = steady * (1.0 + share * signs * (0.4 + 0.3 * (minute % 3)))
            return now.expand(len(readings), -1)

        return command

    return made


def _one(samples: Samples, run: int) -> Samples:
    inputs = samples.inputs[run] if samples.inputs.dim() > 2 else samples.inputs
    return Samples(samples.time, inputs, samples.readings[run])
