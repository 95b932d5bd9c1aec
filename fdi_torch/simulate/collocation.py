"""Whole trajectories at once: the implicit midpoint rule over all steps, linearised and solved by a scan in time.

    h_{k+1} = h_k + dt f((h_k + h_{k+1}) / 2, u_k, theta)

Every step's right-hand side is evaluated in one call, its slopes in one backward pass a tank; Newton's correction of
the trajectory and its sensitivities to theta then obey one linear recurrence. A Gauss-Newton fit can therefore
correct parameters and trajectory together (Bock, 1987), at the price of one evaluation an iteration, and nothing is
compiled for a plant. Error of the rule: dt^2 h'''/24 a second; with 1 s steps on the three tanks below 1e-3 cm.

Inside, time is the last dimension in memory; what is handed out has the shapes that are written beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.scales import length_scale
from fdi_torch.simulate.actuation import Actuation, moved
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.midpoint import newton_step
from fdi_torch.simulate.pointwise import partials
from fdi_torch.simulate.scan import scan_in_time
from fdi_torch.simulate.seen import Look, Sight

# A level that moves by no more has settled, in units of the plant's length scale: of the whole plant, of one tank.
SETTLED, ONE_SETTLED = 1e-7, 1e-5


@dataclass(frozen=True)
class Linearised:
    """A trajectory and its neighbourhood.

    levels (L, K+1, tanks) m: the corrected trajectory, slopes (L, K+1, tanks, P) its sensitivity; readings (L, S, C)
    and jacobian (L, S, C, P): the same at the sensors.
    transition (L, K, tanks, tanks) and gain (L, K, tanks, tanks): a disturbance w of the rates over step k adds
    gain_k w to the next level, which transition hands on. defect (L,): the largest correction of a level, m.
    """

    levels: Tensor
    slopes: Tensor
    readings: Tensor
    jacobian: Tensor
    transition: Tensor
    gain: Tensor
    defect: Tensor

    def lanes(self, which: Tensor) -> Linearised:
        """Some of the lanes, by place or by choice."""
        return Linearised(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    def replaced(self, which: Tensor, new: Linearised) -> Linearised:
        """The same with the lanes at places `which` as `new` has them, in this order."""
        if len(which) == len(self.defect):
            return new
        names = self.__dataclass_fields__
        return Linearised(*(getattr(self, n).index_copy(0, which, getattr(new, n)) for n in names))


class Collocation:
    """Readings of a plant and their Jacobian for many parameter vectors, from guesses of their trajectories."""

    def __init__(self, network: TankNetwork, space: ParameterSpace, experiment: Experiment) -> None:
        self.network, self.space, self.experiment = network, space, experiment
        tanks = [f"{t.name}.start_level" for t in network.description.tanks]
        self._start_columns = {space.index(name): i for i, name in enumerate(tanks) if name in space}
        self._moving = [j for j in range(len(space)) if j not in self._start_columns]
        self._below_rims = network.without_overflow()
        self._rims = [t.height for t in network.description.tanks]
        self._length = length_scale(network.description)
        self._names = [space.names[j] for j in self._moving]
        self._actuation = Actuation(network, experiment, self._names)
        self._sight = Sight(network, experiment, self._names)
        self._still_commands: list[Tensor] | None = None

    def linearise(self, theta: Tensor, levels: Tensor) -> Linearised:
        """theta (L, P), levels (L, K+1, tanks) a guess of the trajectory -> one Newton step further, with slopes."""
        lanes, nodes, tanks = levels.shape
        what = f"{lanes} trajectories of {nodes:.3g} steps with {len(self.space)} sensitivities each"
        expect_room(float(levels.numel()) * (tanks + len(self.space)), what, "choose a longer step")
        path = levels.movedim(1, 2).contiguous()
        middle = 0.5 * (path[..., :-1] + path[..., 1:])
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        rates, by_level, by_theta = self._rate_slopes(middle, values, self._columns(theta), len(self.space))
        step = self.experiment.steps
        start, start_slopes = self._start(theta, values)
        corrected, slopes, transition, gain, defect = newton_step(
            step, path, rates, by_level, by_theta, start, start_slopes
        )
        look = self._sight.look(corrected, values, self._columns(theta))
        return Linearised(
            corrected.movedim(2, 1),
            slopes.permute(0, 3, 1, 2),
            look.readings.movedim(1, 2),
            self._jacobian(look, slopes).permute(0, 3, 1, 2),
            transition.permute(0, 3, 1, 2),
            gain.permute(0, 3, 1, 2),
            defect,
        )

    def corrected(self, theta: Tensor, levels: Tensor) -> tuple[Tensor, Tensor]:
        """The levels of `linearise` and their defect, without slopes: for much less."""
        path = levels.movedim(1, 2).contiguous()
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        rates, by_level, by_theta = self._rate_slopes(0.5 * (path[..., :-1] + path[..., 1:]), values, [], 0)
        start = self._start(theta, values)[0]
        none = start.new_empty(*start.shape, 0)
        found, _, _, _, defect = newton_step(self.experiment.steps, path, rates, by_level, by_theta, start, none)
        return found.movedim(2, 1), defect

    def settle(self, theta: Tensor, levels: Tensor, rounds: int = 12) -> Linearised:
        """Newton steps at fixed theta from levels (L, K+1, tanks) in m until they have settled."""
        for _ in range(rounds):
            found = self.linearise(theta, levels)
            levels = found.levels
            if float(found.defect.max()) < SETTLED * self._length:
                break
        return found

    def driven(self, theta: Tensor, levels: Tensor, tank: int, rounds: int = 8) -> Tensor:
        """levels (L, K+1, tanks) with that of one tank as the model has it while all others are what they are."""
        levels = levels.clone()
        for _ in range(rounds):
            path = levels.movedim(1, 2)
            values = self.network.bind(self.space, theta.unsqueeze(-2))
            rates, by_level, _ = self._rate_slopes(0.5 * (path[..., :-1] + path[..., 1:]), values, [], 0)
            own, step = path[:, tank], self.experiment.steps
            inverse = 1.0 / (1.0 - 0.5 * step * by_level[:, tank, tank])
            misfit = step * rates[:, tank] - torch.diff(own)
            still = own.new_zeros(len(own), 1, 1)
            found = scan_in_time((2.0 * inverse - 1.0)[:, None, None], (inverse * misfit)[:, None, None], still)[
                :, 0, 0
            ]
            levels[..., tank] += found
            if float(found.abs().max()) < ONE_SETTLED * self._length:
                break
        return levels

    def rates(self, middle: Tensor, theta: Tensor) -> Tensor:
        """dh/dt (L, K, tanks) at given mid-step levels (L or 1, K, tanks)."""
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        shape = (len(theta), middle.shape[1])
        commands, levels = self._actuation.commands(values, len(theta)), middle.movedim(-1, 0).contiguous()
        rates = self.network.rates(levels.unbind(0), commands, self._actuation.clock, values)
        return torch.stack([r.expand(shape) for r in rates], dim=1).movedim(1, 2)

    def read(self, levels: Tensor, theta: Tensor) -> Tensor:
        """Readings (L, S, C) of given levels (L or 1, K+1, tanks)."""
        path = levels.expand(len(theta), *levels.shape[1:]).movedim(1, 2)
        return self._sight.read(path, self.network.bind(self.space, theta.unsqueeze(-2))).movedim(1, 2)

    def look(self, levels: Tensor, theta: Tensor) -> Look:
        """The sensors about given levels (L, K+1, tanks), from which follows how readings change with the levels."""
        values = self.network.bind(self.space, theta.unsqueeze(-2))
        return self._sight.look(levels.movedim(1, 2), values, self._columns(theta))

    def constant_guess(self, theta: Tensor) -> Tensor:
        """Levels that stay where they start (L, K+1, tanks)."""
        start, _ = self._start(theta, self.network.bind(self.space, theta.unsqueeze(-2)))
        return start.unsqueeze(1).expand(-1, len(self.experiment.nodes), -1).clone()

    def _columns(self, theta: Tensor) -> list[Tensor]:
        """What of theta may move rates and readings, each (L, 1)."""
        return [theta[:, j, None] for j in self._moving]

    def _start(self, theta: Tensor, values: PlaceValues) -> tuple[Tensor, Tensor]:
        start = torch.cat([h.expand(len(theta), 1) for h in self.network.start_levels(values)], dim=1)
        slopes = theta.new_zeros(*start.shape, theta.shape[-1])
        for column, tank in self._start_columns.items():
            slopes[:, tank, column] = 1.0
        return start, slopes

    def _jacobian(self, look: Look, slopes: Tensor) -> Tensor:
        """slopes (L, tanks, P, K+1) of the levels -> of the readings (L, C, P, S)."""
        moves = [-1] * len(self.space)
        for q, column in enumerate(self._moving):
            moves[column] = q
        return look.along(slopes, moves)

    def _rate_slopes(
        self, middle: Tensor, values: PlaceValues, moving: Sequence[Tensor], width: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """middle (L, n, K) -> rates (L, n, K), their slopes by level (L, n, n, K) and by theta (L, n, P, K).

        moving: what of theta may move the rates, each (L, 1), or nothing; width: P.
        """
        lanes, n, steps = middle.shape
        shape = (lanes, steps)
        full = bool((middle >= middle.new_tensor(self._rims).unsqueeze(-1)).any())
        network = self.network if full else self._below_rims
        commands, command_slopes, columns = self._commands(values, moving, lanes)
        driven = [i for i, slopes in enumerate(command_slopes) if slopes is not None]

        def rates(x: list[Tensor]) -> list[Tensor]:
            acting = list(commands)
            for i, value in zip(driven, x[n : n + len(driven)], strict=True):
                acting[i] = value
            own = moved(values, self._names, x[n + len(driven) :])
            return network.rates(x[:n], acting, self._actuation.clock, own)

        inputs = [*middle.unbind(1), *(commands[i] for i in driven), *moving]
        found, rows = partials(rates, inputs, shape)
        by_level, by_theta = (middle.new_zeros(lanes, n, m, steps) for m in (n, width))
        for i, row in enumerate(rows):
            for j in range(n):
                if (slope := row[j]) is not None:
                    by_level[:, i, j] = slope
            for q, slope in enumerate(row[n + len(driven) :]):
                if slope is not None:
                    by_theta[:, i, self._moving[q]] = slope
            for d, slope in zip(driven, row[n : n + len(driven)], strict=True):
                course = command_slopes[d]
                if slope is not None and course is not None:
                    for q, column in enumerate(columns):
                        by_theta[:, i, self._moving[column]] += slope * course[:, q]
        return torch.stack(found, dim=1), by_level, by_theta

    def _commands(
        self, values: PlaceValues, moving: Sequence[Tensor], lanes: int
    ) -> tuple[list[Tensor], list[Tensor | None], list[int]]:
        """As `Actuation.slopes`; where no parameter moves any command, they are worked out once."""
        if self._still_commands is None:
            if not moving and self._names:
                commands = self._actuation.commands(values, lanes)
                return commands, [None] * len(commands), []
            found = self._actuation.slopes(values, moving, lanes)
            if found[2]:
                return found
            self._still_commands = [command[:1] for command in found[0]]
        return [c.expand(lanes, -1) for c in self._still_commands], [None] * len(self._still_commands), []
