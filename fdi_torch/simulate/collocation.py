"""Collocation: trajectories by the implicit midpoint rule, and their derivatives about a whole trajectory at once.

    h_{k+1} = h_k + dt f((h_k + h_{k+1}) / 2, u_k, theta)

A trajectory is solved by Newton's method on blocks of steps, from a nearby trajectory if there is one. About it, one
call evaluates the right-hand side of all steps and its slopes, from one trace of the equations; the sensitivities to
theta obey a linear recurrence. Local error of the rule: dt^2 h'''/24 per second; below 1e-3 cm for 1 s steps on the
three-tank plant.

Internally time is the last dimension; the documented shapes are those of arguments and results. L lanes (parameter
vectors), K steps, S samples, C sensors, P parameters.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.scales import length_scale
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.actuation import Actuation, with_parameters
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.linearised import Linearised
from fdi_torch.simulate.linearised_stage import partials
from fdi_torch.simulate.output_map import LinearisedOutputs, OutputMap
from fdi_torch.simulate.scan import newton_correction, newton_step, scan_in_time
from fdi_torch.simulate.traced_rates import traced_rates

# Newton's method has converged at corrections below these, in units of the plant's length scale: of the whole plant,
# of one tank.
CONVERGED, ONE_CONVERGED = 1e-7, 1e-5
ONE_ROUNDS = 8  # maximum number of corrections of one tank
ROUNDS = 12  # maximum number of corrections of a block of steps


class Collocation:
    """Readings of a plant and their Jacobian for many parameter vectors, from approximate trajectories.

    by: the P parameters by which it differentiates; all of the space by default.
    """

    def __init__(
        self, network: TankNetwork, space: ParameterSpace, experiment: Experiment, by: Sequence[str] | None = None
    ) -> None:
        self.network, self.space, self.experiment = network, space, experiment
        self.by = space.names if by is None else tuple(by)
        tanks = [f"{t.name}.start_level" for t in network.description.tanks]
        self._start_columns = {self.by.index(name): i for i, name in enumerate(tanks) if name in self.by}
        self._moving = [q for q in range(len(self.by)) if q not in self._start_columns]
        self._without_overflow = network.without_overflow()
        self._rims = [t.height for t in network.description.tanks]
        self._effect_states = network.order - len(tanks)
        self._length = length_scale(network.description)
        self._names = [self.by[q] for q in self._moving]
        self._moved = [space.index(name) for name in self._names]
        self._column_of = dict(zip(self._moved, self._moving, strict=True))
        self._actuation = Actuation(network, experiment, self._names)
        self._output_map = OutputMap(network, experiment, self._names)
        self._fixed_commands: list[Tensor] | None = None

    def linearise(self, theta: Float[Tensor, "L P"], levels: Float[Tensor, "L nodes n"]) -> Linearised:
        """One Newton step from the trajectories `levels`, with derivatives.

        A trajectory of the tanks' levels alone (n = tanks) is completed by the steady states of the effects.
        """
        lanes, nodes, _ = levels.shape
        what = f"{lanes} trajectories of {nodes:.3g} steps with {len(self.by)} sensitivities each"
        numbers = float(lanes * nodes * self.network.order) * (self.network.order + len(self.by))
        expect_room(numbers, what, "choose a longer step")
        path = self._path(theta, levels)
        middle = 0.5 * (path[..., :-1] + path[..., 1:])
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        rates, by_level, by_theta = self._rate_slopes(middle, theta, slopes=True)
        corrected, slopes, transition, gain, defect = newton_step(
            self.experiment.steps, path, rates, by_level, by_theta, *self._start(theta, values)
        )
        look = self._output_map.look(corrected, values, self._columns(theta))
        moves = [self._moving.index(column) if column in self._moving else -1 for column in range(len(self.by))]
        return Linearised(
            corrected.movedim(2, 1),
            slopes.permute(0, 3, 1, 2),
            look.readings.movedim(1, 2),
            look.along(slopes, moves).permute(0, 3, 1, 2),
            transition.permute(0, 3, 1, 2),
            gain.permute(0, 3, 1, 2),
            defect,
            path.movedim(2, 1),
        )

    def corrected(
        self, theta: Float[Tensor, "L P"], levels: Float[Tensor, "L nodes m"]
    ) -> tuple[Float[Tensor, "L nodes n"], Float[Tensor, " L"]]:
        """The levels and defect of `linearise` without derivatives, at a fraction of the cost."""
        path = self._path(theta, levels)
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        rates, by_level, _ = self._rate_slopes(0.5 * (path[..., :-1] + path[..., 1:]), theta)
        start = self._start(theta, values, slopes=False)[0]
        corrected, defect = newton_correction(self.experiment.steps, path, rates, by_level, start)
        return corrected.movedim(2, 1), defect

    def converge(self, theta: Float[Tensor, "L P"]) -> Linearised:
        """The trajectories at theta, with derivatives."""
        return self.linearise(theta, self.trajectories(theta))

    def trajectories(
        self, theta: Float[Tensor, "L P"], guess: Float[Tensor, "L nodes n"] | None = None
    ) -> Float[Tensor, "L nodes n"]:
        """The trajectories at theta, m, solved block after block of steps; no lane depends on another one."""
        values, tolerance = self.network.bind(self.space, theta.unsqueeze(-2)), CONVERGED * self._length
        start = self._start(theta, values, slopes=False)[0]
        constant = start.unsqueeze(1).expand(-1, len(self.experiment.nodes), -1)
        path = self._path(theta, constant if guess is None else guess).clone()
        path[..., 0] = start
        rates, commands = traced_rates(self.network, self.space.names), self._commands(values, [], len(theta))[0]
        guessed, clock = guess is not None, self._actuation.clock
        if rates.solve(path, commands, theta, self.network.nominal, clock, guessed, tolerance, ROUNDS):
            return path.movedim(1, 2)
        return torch.cat([self._by_torch(*lane, tolerance) for lane in zip(theta.split(1), path.split(1), strict=True)])

    def _by_torch(self, theta: Tensor, path: Tensor, tolerance: float) -> Tensor:
        """One trajectory by corrections of all steps at once; they move the time of a kink by few steps each."""
        levels = path.movedim(1, 2)
        for _ in range(ROUNDS * levels.shape[1]):
            levels, defect = self.corrected(theta, levels)
            if float(defect) < tolerance:
                break
        return levels

    def simulate_tank(
        self, theta: Float[Tensor, "L P"], levels: Float[Tensor, "L nodes tanks"], tank: int
    ) -> Float[Tensor, "L nodes n"]:
        """Simulate one tank with the levels of all others given, m: the trajectory with that tank's level replaced."""
        levels = self._path(theta, levels).movedim(1, 2).clone()
        for _ in range(ONE_ROUNDS):
            path = levels.movedim(1, 2)
            rates, by_level, _ = self._rate_slopes(0.5 * (path[..., :-1] + path[..., 1:]), theta)
            level, step = path[:, tank], self.experiment.steps
            inverse = 1.0 / (1.0 - 0.5 * step * by_level[:, tank, tank])
            misfit = step * rates[:, tank] - torch.diff(level)
            transition, forcing = (2.0 * inverse - 1.0)[:, None, None], (inverse * misfit)[:, None, None]
            correction = scan_in_time(transition, forcing, level.new_zeros(len(level), 1, 1))[:, 0, 0]
            levels[..., tank] += correction
            if float(correction.abs().max()) < ONE_CONVERGED * self._length:
                break
        return levels

    def rates(self, middle: Float[Tensor, "#L K m"], theta: Float[Tensor, "L P"]) -> Float[Tensor, "L K n"]:
        """dh/dt of the tanks, m/s, at given mid-step levels, m."""
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        shape = (len(theta), middle.shape[1])
        commands, levels = self._actuation.commands(values, len(theta)), middle.movedim(-1, 0).contiguous()
        rates = self.network.rates(levels.unbind(0), commands, self._actuation.clock, values)
        return torch.stack([r.expand(shape) for r in rates], dim=1).movedim(1, 2)

    def read(self, levels: Float[Tensor, "#L nodes n"], theta: Float[Tensor, "L P"]) -> Float[Tensor, "L S C"]:
        """Readings at given levels, m."""
        path = levels.expand(len(theta), *levels.shape[1:]).movedim(1, 2)
        return self._output_map.read(path, self.network.bind(self.space, theta.unsqueeze(-2))).movedim(1, 2)

    def look(self, levels: Float[Tensor, "L nodes n"], theta: Float[Tensor, "L P"]) -> LinearisedOutputs:
        """The sensors linearised at given levels, m."""
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        return self._output_map.look(levels.movedim(1, 2), values, self._columns(theta))

    def apart(self, theta: Tensor, near: Linearised) -> list[tuple[Collocation, Tensor, Linearised]]:
        """As `JointCollocation`, for one recording."""
        return [(self, theta, near)]

    def _columns(self, theta: Tensor) -> list[Tensor]:
        """The parameters other than start levels, each (L, 1)."""
        return [theta[:, self.space.index(name), None] for name in self._names]

    def _path(self, theta: Tensor, levels: Tensor) -> Tensor:
        """Trajectories (L, n, K+1) from levels (L, K+1, n) or (L, K+1, tanks)."""
        path = levels.movedim(1, 2).contiguous()
        if path.shape[1] == self.network.order:
            return path
        values, tanks = self.network.bind(self.space, theta.unsqueeze(-2)), len(self._rims)
        held = [torch.cat([c, c[:, -1:]], dim=1) for c in self._commands(values, [], len(theta))[0]]
        clock, last = self._actuation.clock, slice(-1, None)
        step, resolution = (torch.cat([x, x[last]]) for x in (clock.step, clock.resolution.expand_as(clock.step)))
        clock = Clock(self.experiment.nodes, step, resolution)
        state = self.network.with_steady_states(path[:, :tanks].unbind(1), held, clock, values)
        return torch.stack([x.expand(path[:, 0].shape) for x in state], dim=1)

    def _start(self, theta: Tensor, values: PlaceValues, slopes: bool = True) -> tuple[Tensor, Tensor]:
        """The state at the start (L, n) and its slopes (L, n, P), or zeros instead of them."""
        lanes = len(theta)
        start = torch.cat([h.expand(lanes, 1) for h in self.network.start_levels(values)], dim=1)
        by_theta = theta.new_zeros(*start.shape, len(self.by))
        for column, tank in self._start_columns.items():
            by_theta[:, tank, column] = 1.0
        if not self._effect_states:
            return start, by_theta
        return self._steady_start(start, by_theta, values, self._columns(theta) if slopes else [])

    def _steady_start(
        self, start: Tensor, by_theta: Tensor, values: PlaceValues, moving: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Complete the levels at the start (L, tanks) and their slopes by those of effects in steady state."""
        lanes, tanks = start.shape
        commands, command_slopes, columns = self._commands(values, moving, lanes)
        clock = self._actuation.clock.part(slice(1))
        count = tanks + len(commands)

        def steady(x: list[Tensor]) -> list[Tensor]:
            bound = with_parameters(values, self._names, x[count:])
            return self.network.with_steady_states(x[:tanks], x[tanks:count], clock, bound)[tanks:]

        inputs = [*start.unsqueeze(-1).unbind(1), *(c[:, :1] for c in commands), *moving]
        states, rows = partials(steady, inputs, (lanes, 1))
        slopes = [torch.zeros_like(by_theta[:, 0]) for _ in rows]
        for row, slope in zip(rows, slopes, strict=True):
            for tank in range(tanks):
                if (by_level := row[tank]) is not None:
                    slope += by_level * by_theta[:, tank]
            for q, direct in enumerate(row[count:]):
                if direct is not None:
                    slope[:, self._moving[q]] += direct[:, 0]
            for by_command, course in zip(row[tanks:count], command_slopes, strict=True):
                if by_command is not None and course is not None:
                    for q, column in enumerate(columns):
                        slope[:, self._moving[column]] += by_command[:, 0] * course[:, q, 0]
        return torch.cat([start, *states], dim=1), torch.cat([by_theta, torch.stack(slopes, dim=1)], dim=1)

    def _rate_slopes(self, middle: Tensor, theta: Tensor, slopes: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Rates (L, n, K) at mid-step levels (L, n, K), their slopes by level (L, n, n, K) and by theta (L, n, P, K).

        slopes: whether to differentiate by theta; otherwise P is 0.
        """
        reaches_rim = bool((middle[:, : len(self._rims)] >= middle.new_tensor(self._rims).unsqueeze(-1)).any())
        network = self.network if reaches_rim else self._without_overflow
        values, moving = self.network.bind(self.space, theta.unsqueeze(-2)), self._columns(theta) if slopes else []
        commands, command_slopes, columns = self._commands(values, moving, len(theta))
        traced = traced_rates(network, self.space.names)(
            middle,
            commands,
            theta,
            network.nominal,
            self._actuation.clock,
            driven=[i for i, slopes in enumerate(command_slopes) if slopes is not None],
            moved=self._moved if slopes else [],
        )
        by_theta = middle.new_zeros(*middle.shape[:2], len(self.by) if slopes else 0, middle.shape[-1])
        for (i, p), slope in traced.by_parameter.items():
            by_theta[:, i, self._column_of[p]] = slope
        for (i, d), slope in traced.by_command.items():
            course = command_slopes[d]
            assert course is not None
            for q, column in enumerate(columns):
                by_theta[:, i, self._moving[column]] += slope * course[:, q]
        return traced.rates, traced.by_state, by_theta

    def _commands(
        self, values: PlaceValues, moving: Sequence[Tensor], lanes: int
    ) -> tuple[list[Tensor], list[Tensor | None], list[int]]:
        """As `Actuation.slopes`, computed once if no parameter affects any command."""
        if self._fixed_commands is None:
            if not moving and self._names:
                commands = self._actuation.commands(values, lanes)
                return commands, [None] * len(commands), []
            linearised = self._actuation.slopes(values, moving, lanes)
            if linearised[2]:
                return linearised
            self._fixed_commands = [command[:1] for command in linearised[0]]
        return [c.expand(lanes, -1) for c in self._fixed_commands], [None] * len(self._fixed_commands), []
