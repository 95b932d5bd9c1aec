"""The traced engine: the traced program executed by torch, operation by operation on all lanes; needs no compiler.

Slower than the compiled engine, faster than differentiation through torchdiffeq; runs on any device of torch.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.engine import Engine, Readings, expect_no_gradient
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.injection import Injection, expect_injectable
from fdi_torch.simulate.interpreter import Change, Interpreter
from fdi_torch.simulate.program import Program, build_program
from fdi_torch.simulate.reference_engine import hermite


class TracedEngine(Engine):
    """Readings and their Jacobians (forward mode) of many parameter vectors at once, by fixed-step RK4."""

    name = "traced"

    def moments(self, theta: Float[Tensor, "*problems N P"], data: Readings) -> Float[Tensor, "*problems N C 3"]:
        expect_no_gradient(self, theta, "moments")
        return super().moments(theta, data)

    def observe(
        self, theta: Float[Tensor, "*batch P"], data: Readings, injection: Injection
    ) -> Float[Tensor, "*batch S columns"]:
        expect_no_gradient(self, theta, "observe")
        lanes = theta.detach().reshape(theta.shape[:-1].numel(), theta.shape[-1])
        run = self._run(lanes, False, injection)
        expect_injectable(self.experiment, injection, run.program.command_memory + run.program.reading_memory)
        values, weight = (t.expand(len(lanes), *t.shape[-2:]) for t in (data.known, data.weight))
        rows = [run.correct(s, values[:, s], weight[:, s]) for s in run.samples()]
        return torch.stack(rows, dim=1).reshape(*theta.shape[:-1], len(rows), -1)

    def _run(self, lanes: Tensor, tangent: bool, injection: Injection | None = None) -> _Run:
        program = build_program(self.network, self.space.names, tangent)
        return _Run(program, self.network, self.experiment, lanes, injection)

    def _simulate(self, mode: str, theta: Tensor) -> tuple[Tensor, Tensor | None]:
        tangent = mode == "linearise"
        run = self._run(theta.detach().reshape(theta.shape[:-1].numel(), theta.shape[-1]), tangent)
        if mode == "levels":
            rows = [run.levels()[: run.program.tanks] for _ in run.samples()]
        else:
            rows = [run.read(s) for s in run.samples()]
        lanes = len(run.lanes)
        values = torch.stack([torch.stack([v.expand(lanes) for v, _ in row], dim=-1) for row in rows], dim=1)
        values = values.reshape(*theta.shape[:-1], *values.shape[1:])
        if not tangent:
            return values, None
        slopes = torch.stack([torch.stack([run.full(d) for _, d in row], dim=-1) for row in rows], dim=2)
        return values, slopes.movedim(0, -1).reshape(*values.shape, theta.shape[-1])


class _Run:
    """One simulation with L sets of parameters side by side, the lanes (L, P)."""

    def __init__(
        self,
        program: Program,
        network: TankNetwork,
        experiment: Experiment,
        lanes: Tensor,
        injection: Injection | None = None,
    ) -> None:
        self.program, self.experiment, self.lanes, self.injection = program, experiment, lanes, injection
        interpreter = Interpreter(program, lanes, network.nominal, experiment.resolution.to(lanes))
        self.state, self.compute, self.full = interpreter.state, interpreter.run, interpreter.full
        self.history: list[list[tuple[Tensor, Change]]] = []

    def samples(self) -> Iterator[int]:
        """Run the simulation; yields the index of each sample while the state holds its levels as 'sample'."""
        e, p, state = self.experiment, self.program, self.state
        firsts = torch.searchsorted(e.sample_step, torch.arange(len(e.nodes), device=e.nodes.device)).tolist()
        shares = e.sample_share.tolist()
        self.compute(p.prepare)
        self._restore_levels()
        for k in range(len(e.nodes) - 1):
            self._begin_step(k)
            if k == 0:
                self.compute(p.settle_commands)
                self._restore_memory("command_memory", 0, p.command_memory)
                self._restore_levels()
            due = list(range(firsts[k], firsts[k + 1]))
            for s in [s for s in due if shares[s] <= 0.0]:
                state.put("sample", self._levels())
                yield s
            self._set_clock(e.nodes[k], e.steps[k])  # reading a sample has changed the clock
            before = self._levels()
            self._step()
            if any(0.0 < shares[s] < 1.0 for s in due):
                self.compute(p.end)
            for s in [s for s in due if shares[s] > 0.0]:
                state.put("sample", self._between(before, k, e.sample_share[s]))
                yield s

    def levels(self) -> list[tuple[Tensor, Change]]:
        return self.state.group("sample", self.program.order)

    def read(self, s: int) -> list[tuple[Tensor, Change]]:
        p, times = self.program, self.experiment.sample_times
        interval = self.experiment.sample_intervals[s]
        self._set_clock(times[s] - interval, interval)
        levels = self.levels()
        self.state.put("seen", [levels[tank] for tank in p.sensor_tanks])
        self._delay_levels(s)
        if s == 0:
            self.compute(p.settle_readings)
            self._restore_memory("reading_memory", p.command_memory, p.reading_memory)
        self.compute(p.read)
        return self.state.group("reading", p.sensors)

    def correct(self, s: int, values: Tensor, weight: Tensor) -> Tensor:
        """The observer's correction at sample s: state, memories and the predicted reading, (L, n + M + C)."""
        assert self.injection is not None
        lanes = len(self.lanes)
        expected = torch.stack([value.expand(lanes) for value, _ in self.read(s)], dim=-1)
        error = torch.where(weight != 0, values - expected, 0.0)
        gain = self.injection.gains[..., s, :, :]
        correction = sum(gain[..., c] * error[..., c : c + 1] for c in range(error.shape[-1]))
        levels = torch.stack([level.expand(lanes) for level, _ in self._levels()], dim=-1) + correction
        p, state = self.program, self.state
        self._set_state("level", torch.cat([torch.clamp(levels[:, : p.tanks], min=0.0), levels[:, p.tanks :]], dim=-1))
        kinds = (("level", p.order), ("command_memory", p.command_memory), ("reading_memory", p.reading_memory))
        state_values = [value.expand(lanes) for kind, count in kinds for value, _ in state.group(kind, count)]
        return torch.cat([torch.stack(state_values, dim=-1), expected], dim=-1)

    def _set_state(self, kind: str, values: Tensor) -> None:
        self.state.put(kind, [(value, None) for value in values.unbind(-1)])

    def _restore_levels(self) -> None:
        if self.injection is not None:
            self._set_state("level", self.injection.start)

    def _restore_memory(self, kind: str, first: int, count: int) -> None:
        if self.injection is not None and self.injection.memory is not None:
            self._set_state(kind, self.injection.memory[..., first : first + count])

    def _step(self) -> None:
        """One step of the grid."""
        self.compute(self.program.step)

    def _levels(self) -> list[tuple[Tensor, Change]]:
        return self.state.group("level", self.program.order)

    def _set_clock(self, start: Tensor, step: Tensor) -> None:
        self.state.values["clock", 0], self.state.values["clock", 1] = start.to(self.lanes), step.to(self.lanes)

    def _begin_step(self, k: int) -> None:
        """Set the clock and the channels of step k, including delayed ones."""
        e = self.experiment
        start, step = e.nodes[k], e.steps[k]
        self._set_clock(start, step)
        for c in range(e.inputs.shape[1]):
            self.state.values["channel", c] = e.inputs[k, c].to(self.lanes)
        for j, actuator in enumerate(self.program.late_actuators):
            self._delay_channel(j, self.program.channels[actuator], start, step)

    def _delay_channel(self, j: int, channel: int, start: Tensor, step: Tensor) -> None:
        """The mean of a delayed channel over a step, and its slopes."""
        signal, delay = self.experiment.signal, self.state.values["command_delay", j]
        begin = start - delay
        self.state.values["late_channel", j] = signal.average(start, step, channel, delay)
        d_delay = self.state.changes.get(("command_delay", j))
        if d_delay is not None:
            rise = signal.slope_at(begin + step, channel) - signal.slope_at(begin, channel)
            self.state.changes["late_channel", j] = -rise / step * d_delay

    def _between(self, before: list[tuple[Tensor, Change]], k: int, share: Tensor) -> list[tuple[Tensor, Change]]:
        """The levels at a fraction of step k."""
        after = self._levels()
        if share >= 1.0:
            return after
        step, order = self.experiment.steps[k], self.program.order
        left, right = self.state.group("slope1", order), self.state.group("slope_right", order)
        rows = list(zip(before, after, left, right, strict=True))
        levels = [hermite(h0[0], h1[0], k0[0], k1[0], step, share) for h0, h1, k0, k1 in rows]
        if not self.program.tangent:
            return [(level, None) for level in levels]
        changes = [[self.full(change) for _, change in row] for row in rows]
        return [(h, hermite(d[0], d[1], d[2], d[3], step, share)) for h, d in zip(levels, changes, strict=True)]

    def _delay_levels(self, s: int) -> None:
        """Replace the levels at delayed sensors by earlier ones, with linear interpolation between samples."""
        delayed, times, state = self.program.late_sensors, self.experiment.sample_times, self.state
        self.history.append([(state.values["seen", i], state.changes.get(("seen", i))) for i in delayed])
        for j, i in enumerate(delayed) if s else ():
            delay = state.values["reading_delay", j].expand(len(self.lanes))
            instant = times[s] - torch.clamp(delay, min=0.0)
            right = torch.searchsorted(times, instant.contiguous()).clamp(1, s)
            gap = times[right] - times[right - 1]
            linear = (instant - times[right - 1]) / gap
            share = torch.clamp(linear, min=0.0)
            past = torch.stack([row[j][0].expand(len(self.lanes)) for row in self.history])
            first, last = past.gather(0, right[None] - 1)[0], past.gather(0, right[None])[0]
            state.values["seen", i] = first + share * (last - first)
            if state.changes:
                by_delay = torch.where((linear >= 0) & (delay >= 0), -(last - first) / gap, 0.0)
                state.changes["seen", i] = self._late_change(j, right, share, by_delay)

    def _late_change(self, j: int, right: Tensor, share: Tensor, by_delay: Tensor) -> Tensor:
        """Slopes of a delayed level. by_delay: its slope by the delay."""
        past = torch.stack([self.full(row[j][1]) for row in self.history])
        index = right.expand(1, *past.shape[1:])
        first, last = past.gather(0, index - 1)[0], past.gather(0, index)[0]
        return first + share * (last - first) + by_delay * self.full(self.state.changes.get(("reading_delay", j)))
