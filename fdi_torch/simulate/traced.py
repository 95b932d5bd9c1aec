"""The engine without a compiler: the same traced program, each of its operations run by torch on all lanes.

Slower than the compiled engine and faster than differentiating through torchdiffeq; runs on any of torch's devices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.engine import Readings, expect_problems, gram_of, moments_of
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.gradient import expect_no_gradient, is_differentiated, readings_with_gradient
from fdi_torch.simulate.implicit import ImplicitStep
from fdi_torch.simulate.injection import Injection, expect_injectable
from fdi_torch.simulate.integrate import hermite
from fdi_torch.simulate.interpreter import Change, Interpreter
from fdi_torch.simulate.own_steps import judged, own_step
from fdi_torch.simulate.program import Program, build_program


class TracedEngine:
    """Readings and their Jacobians (forward mode) of many parameter vectors at once, by fixed-step RK4."""

    name = "traced"

    def __init__(self, network: TankNetwork, space: ParameterSpace, experiment: Experiment, why: str = "") -> None:
        self.network, self.space, self.experiment, self.why = network, space, experiment, why

    def levels(self, theta: Tensor) -> Tensor:
        expect_no_gradient(self, theta, "levels")
        return self._simulate(theta, tangent=False, levels=True)[0]

    def readings(self, theta: Tensor) -> Tensor:
        if is_differentiated(theta):
            return readings_with_gradient(self, theta)
        return self._simulate(theta, tangent=False)[0]

    def linearise(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        expect_no_gradient(self, theta, "linearise")
        readings, jacobian = self._simulate(theta, tangent=True)
        assert jacobian is not None
        return readings, jacobian

    def moments(self, theta: Tensor, data: Readings) -> Tensor:
        expect_no_gradient(self, theta, "moments")
        expect_problems(theta, data)
        return moments_of(self.readings(theta), data)

    def gram(self, theta: Tensor, data: Readings) -> Tensor:
        expect_no_gradient(self, theta, "gram")
        expect_problems(theta, data)
        return gram_of(*self.linearise(theta), data)

    def observe(self, theta: Tensor, data: Readings, injection: Injection) -> Tensor:
        expect_no_gradient(self, theta, "observe")
        program = build_program(self.network, self.space.names, False, self.experiment.own is not None)
        expect_injectable(self.experiment, injection, program.command_memory + program.reading_memory)
        lanes = theta.detach().reshape(theta.shape[:-1].numel(), theta.shape[-1])
        run = _Run(program, self.network, self.experiment, lanes, injection)
        values, weight = (t.expand(len(lanes), *t.shape[-2:]) for t in (data.known, data.weight))
        rows = [run.correct(s, values[:, s], weight[:, s]) for s in run.samples()]
        return torch.stack(rows, dim=1).reshape(*theta.shape[:-1], len(rows), -1)

    def _simulate(self, theta: Tensor, tangent: bool, levels: bool = False) -> tuple[Tensor, Tensor | None]:
        program = build_program(self.network, self.space.names, tangent, self.experiment.own is not None)
        run = _Run(
            program, self.network, self.experiment, theta.detach().reshape(theta.shape[:-1].numel(), theta.shape[-1])
        )
        rows = [run.levels() if levels else run.read(s) for s in run.samples()]
        full = len(run.lanes)
        values = torch.stack([torch.stack([v.expand(full) for v, _ in row], dim=-1) for row in rows], dim=1)
        values = values.reshape(*theta.shape[:-1], *values.shape[1:])
        if not tangent:
            return values, None
        slopes = torch.stack([torch.stack([run.full(d) for _, d in row], dim=-1) for row in rows], dim=2)
        return values, slopes.movedim(0, -1).reshape(*values.shape, theta.shape[-1])


class _Run:
    """One simulation of lanes (L, P)."""

    def __init__(
        self,
        program: Program,
        network: TankNetwork,
        experiment: Experiment,
        lanes: Tensor,
        injection: Injection | None = None,
    ) -> None:
        self.program, self.experiment, self.lanes, self.injection = program, experiment, lanes, injection
        self.resolution = experiment.resolution.to(lanes)
        interpreter = Interpreter(program, lanes, network.nominal, self.resolution)
        self.state, self.compute, self.full = interpreter.state, interpreter.run, interpreter.full
        self.history: list[list[tuple[Tensor, Change]]] = []
        self.implicit = ImplicitStep(program, self.state, self.compute, self.full)
        self.pace = lanes.new_full((len(lanes),), torch.inf)
        self.size = lanes.new_zeros(lanes.shape[::-1])

    def samples(self) -> Iterator[int]:
        """Runs; at each sample's turn the state holds 'sample' levels and the sample's number is handed out."""
        e, p, state = self.experiment, self.program, self.state
        firsts = torch.searchsorted(e.sample_step, torch.arange(len(e.nodes))).tolist()
        shares = e.sample_share.tolist()
        self.compute(p.prepare)
        if self.injection is not None:
            self._begin_with("level", self.injection.start)
        for k in range(len(e.nodes) - 1):
            self._enter(k)
            if k == 0:
                self.compute(p.settle_commands)
                self._remember("command_memory", 0, p.command_memory)
            mine = list(range(firsts[k], firsts[k + 1]))
            for s in [s for s in mine if shares[s] <= 0.0]:
                state.put("sample", self._levels())
                yield s
            self._set_clock(e.nodes[k], e.steps[k])  # reading a sample has set another
            before = self._levels()
            self._step(k)
            if any(0.0 < shares[s] < 1.0 for s in mine):
                self.compute(p.end)
            for s in [s for s in mine if shares[s] > 0.0]:
                state.put("sample", self._between(before, k, e.sample_share[s]))
                yield s

    def levels(self) -> list[tuple[Tensor, Change]]:
        return self.state.group("sample", self.program.tanks)

    def read(self, s: int) -> list[tuple[Tensor, Change]]:
        p, times = self.program, self.experiment.sample_times
        interval = self.experiment.sample_intervals[s]
        self._set_clock(times[s] - interval, interval)
        seen = self.levels()
        self.state.put("seen", [seen[tank] for tank in p.sensor_tanks])
        self._see_late(s)
        if s == 0:
            self.compute(p.settle_readings)
            self._remember("reading_memory", p.command_memory, p.reading_memory)
        self.compute(p.read)
        return self.state.group("reading", p.sensors)

    def correct(self, s: int, values: Tensor, weight: Tensor) -> Tensor:
        """The observer's correction at sample s: levels, memories and the reading expected, (L, n + M + C)."""
        assert self.injection is not None
        full = len(self.lanes)
        expected = torch.stack([value.expand(full) for value, _ in self.read(s)], dim=-1)
        error = torch.where(weight != 0, values - expected, 0.0)
        gain = self.injection.gains[..., s, :, :]
        move = sum(gain[..., c] * error[..., c : c + 1] for c in range(error.shape[-1]))
        levels = torch.stack([level.expand(full) for level, _ in self._levels()], dim=-1) + move
        self._begin_with("level", torch.clamp(levels, min=0.0))
        p, state = self.program, self.state
        kinds = (("level", p.tanks), ("command_memory", p.command_memory), ("reading_memory", p.reading_memory))
        kept = [value.expand(full) for kind, count in kinds for value, _ in state.group(kind, count)]
        return torch.cat([torch.stack(kept, dim=-1), expected], dim=-1)

    def _begin_with(self, kind: str, values: Tensor) -> None:
        self.state.put(kind, [(value, None) for value in values.unbind(-1)])

    def _remember(self, kind: str, first: int, count: int) -> None:
        if self.injection is not None and self.injection.memory is not None:
            self._begin_with(kind, self.injection.memory[..., first : first + count])

    def _step(self, k: int) -> None:
        """A step of the grid: at once, or each lane in as many of its own as it needs."""
        e, p, values = self.experiment, self.program, self.state.values
        if e.own is None:
            return self.compute(p.step)
        self.compute(p.act)
        start, span = values["clock", 0], values["clock", 1]
        gone = torch.zeros_like(self.pace)
        while bool((gone < span).any()):
            own = own_step(gone, self.pace, span)
            values["part", 0], values["part", 1] = start + gone, own
            before = self._levels()
            error, wrong = self.implicit.take(own, e.own.tolerance)
            size = self._largest_slopes(wrong)
            kept, gone, self.pace = judged(own, self._worst(error, wrong, size), gone, self.pace, span, e.own.shortest)
            self.size = torch.where(kept, size, self.size)
            rows = zip(self._levels(), before, strict=True)
            self.state.put("level", [self._either(kept, now, then) for now, then in rows])

    def _largest_slopes(self, wrong: Sequence[Tensor]) -> Tensor:
        """Of the levels by each parameter so far, (P, L)."""
        if not wrong:
            return self.size
        return torch.maximum(self.size, torch.stack([self.full(d).abs() for _, d in self._levels()]).amax(dim=0))

    def _worst(self, error: Tensor, wrong: Sequence[Tensor], size: Tensor) -> Tensor:
        """The larger of a step's two errors, each as a share of what is tolerated, (L,)."""
        if not wrong or not len(size):
            return error
        assert self.experiment.own is not None
        largest = torch.stack(list(wrong)).amax(dim=0)
        share = torch.where(largest > 0.0, largest / (self.experiment.own.slope_tolerance * size), 0.0)
        return torch.fmax(error, torch.nan_to_num(share, nan=0.0).amax(dim=0))

    def _either(self, yes: Tensor, x: tuple[Tensor, Change], y: tuple[Tensor, Change]) -> tuple[Tensor, Change]:
        level = torch.where(yes, x[0], y[0])
        both = x[1] is None and y[1] is None
        return level, None if both else torch.where(yes, self.full(x[1]), self.full(y[1]))

    def _levels(self) -> list[tuple[Tensor, Change]]:
        return self.state.group("level", self.program.tanks)

    def _set_clock(self, start: Tensor, step: Tensor) -> None:
        self.state.values["clock", 0], self.state.values["clock", 1] = start.to(self.lanes), step.to(self.lanes)

    def _enter(self, k: int) -> None:
        """The clock and the channels of step k, late ones looked up."""
        e = self.experiment
        start, step = e.nodes[k], e.steps[k]
        self._set_clock(start, step)
        for c in range(e.inputs.shape[1]):
            self.state.values["channel", c] = e.inputs[k, c].to(self.lanes)
        for j, actuator in enumerate(self.program.late_actuators):
            self._look_up(j, self.program.channels[actuator], start, step)

    def _look_up(self, j: int, channel: int, start: Tensor, step: Tensor) -> None:
        signal, delay = self.experiment.signal, self.state.values["command_delay", j]
        begin = start - delay
        self.state.values["late_channel", j] = signal.average(start, step, channel, delay)
        d_delay = self.state.changes.get(("command_delay", j))
        if d_delay is not None:
            rise = signal.slope_at(begin + step, channel) - signal.slope_at(begin, channel)
            self.state.changes["late_channel", j] = -rise / step * d_delay

    def _between(self, before: list[tuple[Tensor, Change]], k: int, share: Tensor) -> list[tuple[Tensor, Change]]:
        """The levels at a share of step k."""
        after = self._levels()
        if share >= 1.0:
            return after
        step, tanks = self.experiment.steps[k], self.program.tanks
        left, right = self.state.group("slope1", tanks), self.state.group("slope_right", tanks)
        rows = list(zip(before, after, left, right, strict=True))
        levels = [hermite(h0[0], h1[0], k0[0], k1[0], step, share) for h0, h1, k0, k1 in rows]
        if not self.program.tangent:
            return [(level, None) for level in levels]
        moved = [[self.full(change) for _, change in row] for row in rows]
        return [(h, hermite(d[0], d[1], d[2], d[3], step, share)) for h, d in zip(levels, moved, strict=True)]

    def _see_late(self, s: int) -> None:
        """Late sensors see what was, between the samples on a straight line."""
        late, times, state = self.program.late_sensors, self.experiment.sample_times, self.state
        self.history.append([(state.values["seen", i], state.changes.get(("seen", i))) for i in late])
        for j, i in enumerate(late) if s else ():
            delay = state.values["reading_delay", j].expand(len(self.lanes))
            wanted = times[s] - torch.clamp(delay, min=0.0)
            right = torch.searchsorted(times, wanted.contiguous()).clamp(1, s)
            gap = times[right] - times[right - 1]
            linear = (wanted - times[right - 1]) / gap
            share = torch.clamp(linear, min=0.0)
            past = torch.stack([row[j][0].expand(len(self.lanes)) for row in self.history])
            first, last = past.gather(0, right[None] - 1)[0], past.gather(0, right[None])[0]
            state.values["seen", i] = first + share * (last - first)
            if state.changes:
                moved = torch.where((linear >= 0) & (delay >= 0), -(last - first) / gap, 0.0)
                state.changes["seen", i] = self._late_change(j, right, share, moved)

    def _late_change(self, j: int, right: Tensor, share: Tensor, moved: Tensor) -> Tensor:
        past = torch.stack([self.full(row[j][1]) for row in self.history])
        index = right.expand(1, *past.shape[1:])
        first, last = past.gather(0, index - 1)[0], past.gather(0, index)[0]
        return first + share * (last - first) + moved * self.full(self.state.changes.get(("reading_delay", j)))
