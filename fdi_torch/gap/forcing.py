"""First-order forcing by an effect: how it changes the level rates, or a reading, along a given trajectory.

Only the component with the effect is evaluated again. The influence of its flow on the level rates is linearised once
for all effects, so that the whole library costs little more than one right-hand side.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.plant.effect import Placement, Stage
from fdi_torch.plant.flow_component import FlowOrder
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.operating_point import OperatingPoint
from fdi_torch.plant.scales import length_scale
from fdi_torch.simulate.actuation import Actuation
from fdi_torch.simulate.collocation import CONVERGED
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.linearised_stage import Row, partials
from fdi_torch.simulate.output_map import OutputMap
from fdi_torch.simulate.scan import newton_correction

Starts = Mapping[str, Tensor]
NEWTON_ROUNDS = 12


class Forcing:
    """A trajectory of a fitted plant, states (n, K+1) m at the nodes, along which effects are tried.

    union: the fitted plant with every effect that may be tried. present: prefixes of the effects that act. values: the
    plant's constants, bound to one lane.

    Attributes at the middle of each step: levels (1, K) m of each tank; commands of each actuator; flows (m^3/s) and
    heads (m): of each flow component by its name; unforced: level rates without the effect that is tried, m/s. The
    n rates are those of the levels and then of the fitted effects' states.
    """

    def __init__(
        self,
        fitted: TankNetwork,
        union: TankNetwork,
        present: Iterable[str],
        values: PlaceValues,
        path: Tensor,
        experiment: Experiment,
    ) -> None:
        self.union, self.present, self.values, self.experiment = union, frozenset(present), values, experiment
        self._path = path.unsqueeze(0)
        network = union.restricted_to(self.present)
        middle = list((0.5 * (path[:, 1:] + path[:, :-1])).unsqueeze(1).unbind(0))
        levels, states = fitted.split(middle)
        self.levels, self._rows = list(levels), [prefix for prefix, own in states.items() for _ in own]
        self._states = {prefix: own for prefix, own in states.items() if prefix in self.present}
        actuation = Actuation(network, experiment, [])
        self._clock = actuation.clock
        self.commands = actuation.commands(values, 1)
        now = self._now(network, values, self.commands)
        self._unforced_states = network.state_rates(now)
        first = network.flows(now)
        gathered = network.net_inflows(now, first)
        self._gathered = [net.expand(self.levels[0].shape) for net in gathered]
        self.flows = first | network.last_flows(now, self._gathered)[0]
        flows_at = {c.name: now.at_flow(c) for c in union.description.flow_components()}
        self.heads = {name: local.head for name, local in flows_at.items()}
        self._net = network.less_overflow(now, self._gathered)
        self.unforced, self._by_inflow = self._inflow_slopes(network)
        self._no_inflow: list[Row] = [[None] * len(self.levels) for _ in self._rows]
        self._readings = OutputMap(network, experiment, []).read(self._path, values)[0]

    def rates(self, placement: Placement, starts: Starts) -> Tensor:
        """Change of the rates (n, M, K) m/s by an effect. starts: its parameters by short name, (M, 1)."""
        network, values, lanes = self._with(placement, starts)
        if placement.effect.stage is Stage.STORAGE:
            rates = network.level_rates(self._now(network, values, self.commands), self._net)
            return self._changes(rates, lanes)
        return self._rates_by_flow(network, placement, values, lanes)

    def by_inflows(self, inflows: Sequence[Tensor | None], lanes: int) -> Tensor:
        """Change of the rates (n, M, K) by additional flows into each tank, (M, K) or (1, K) m^3/s; None for no
        flow.
        """
        changed = []
        for row in (*self._by_inflow, *self._no_inflow):
            total = self.levels[0].new_zeros(lanes, self.levels[0].shape[-1])
            for slope, inflow in zip(row, inflows, strict=True):
                if slope is not None and inflow is not None:
                    total += slope * inflow
            changed.append(total)
        return torch.stack(changed)

    def by_rates(self, weights: Tensor) -> Tensor:
        """The transpose of `by_inflows`: weights of the rates (n, M, K) -> weights of the inflows (tanks, M, K)."""
        levels = weights[: len(self._by_inflow)]
        by_inflow = torch.zeros_like(levels)
        for row, weight in zip(self._by_inflow, levels, strict=True):
            for tank, slope in enumerate(row):
                if slope is not None:
                    by_inflow[tank] += slope * weight
        return by_inflow

    def readings(self, placement: Placement, starts: Starts) -> Tensor:
        """Change of the readings (C, M, S) by an effect, in each sensor's unit."""
        network, values, lanes = self._with(placement, starts)
        with_effect = OutputMap(network, self.experiment, []).read(self._path.expand(lanes, -1, -1), values)
        return (with_effect - self._readings).movedim(0, 1)

    def _with(self, placement: Placement, starts: Starts) -> tuple[TankNetwork, PlaceValues, int]:
        network = self.union.restricted_to({*self.present, placement.prefix})
        values = {**self.values, placement.prefix: {**self.values[placement.prefix], **starts}}
        return network, values, max(len(s) for s in starts.values())

    def _now(self, network: TankNetwork, values: PlaceValues, commands: Sequence[Tensor]) -> OperatingPoint:
        return replace(network.operating_point(self.levels, commands, self._clock, values), states=self._states)

    def _with_states(
        self, network: TankNetwork, placement: Placement, now: OperatingPoint, lanes: int
    ) -> OperatingPoint:
        """The point with the states that a tried effect would have along the trajectory, from steady state on, by
        Newton's method for the implicit midpoint rule.
        """
        shape, steps = (lanes, self.levels[0].shape[-1]), self.experiment.steps

        def rates(x: Sequence[Tensor]) -> Sequence[Tensor]:
            return network.state_rates(replace(now, states={**now.states, placement.prefix: tuple(x)}))[
                placement.prefix
            ]

        steady = torch.stack([x.expand(shape) for x in network.steady_states(now)[placement.prefix]], dim=1)
        start, path = steady[..., 0], torch.cat([steady[..., :1], steady], dim=-1)
        for _ in range(NEWTON_ROUNDS):
            middle = 0.5 * (path[..., 1:] + path[..., :-1])
            values, rows = partials(rates, middle.unbind(1), shape)
            by_state = [torch.stack([torch.zeros_like(middle[:, 0]) if s is None else s for s in r], 1) for r in rows]
            path, defect = newton_correction(
                steps, path.contiguous(), torch.stack(values, 1), torch.stack(by_state, 1), start
            )
            if float(defect.max()) < CONVERGED * length_scale(network.description):
                break
        middle = 0.5 * (path[..., 1:] + path[..., :-1])
        return replace(now, states={**now.states, placement.prefix: middle.unbind(1)})

    def _rates_by_flow(self, network: TankNetwork, placement: Placement, values: PlaceValues, lanes: int) -> Tensor:
        """Change of the rates (n, M, K) m/s by an effect that changes a flow."""
        plant, place, commands = network.description, placement.location, self.commands
        if placement.effect.stage is Stage.BALANCE:
            net = list(self._gathered)
            network.transfer_by_effect(net, placement, self._now(network, values, commands))
            return self.by_inflows([a - b for a, b in zip(net, self._gathered, strict=True)], lanes)
        if placement.effect.stage is Stage.COMMAND:
            commands = Actuation(network, self.experiment, []).commands(values, lanes)
        now = self._now(network, values, commands)
        component = next(c for c in plant.flow_components() if c.name == place)
        if component.order > FlowOrder.BY_LEVELS:  # its own limits depend on the net inflow, as `unforced` does
            rates = network.level_rates(now, network.less_overflow(now, self._gathered))
            return self._changes(rates, lanes)
        if placement.effect.states:
            now = self._with_states(network, placement, now, lanes)
        inflows = [torch.zeros_like(net) for net in self._gathered]
        network.transfer(inflows, component.source, component.target, network.flow(now, component) - self.flows[place])
        changes, after = self.by_inflows(inflows, lanes), network.state_rates(now)
        for prefix, unforced in self._unforced_states.items():
            first = len(self.levels) + self._rows.index(prefix)
            for row, (rate, before) in enumerate(zip(after[prefix], unforced, strict=True), first):
                changes[row] = rate - before
        return changes

    def _changes(self, rates: Sequence[Tensor], lanes: int) -> Tensor:
        """Differences of level rates from `unforced`, and no change of the states' rates, (n, M, K) m/s."""
        shape = (lanes, self.levels[0].shape[-1])
        levels = [(a - b).expand(shape) for a, b in zip(rates, self.unforced, strict=True)]
        return torch.stack([*levels, *(torch.zeros_like(levels[0]) for _ in self._no_inflow)])

    def _inflow_slopes(self, network: TankNetwork) -> tuple[list[Tensor], list[Row]]:
        """Level rates, and slope of each tank's rate with the flow into each tank, 1/m^2."""

        now = self._now(network, self.values, self.commands)

        def rates(net: Sequence[Tensor]) -> Sequence[Tensor]:
            return network.level_rates(now, network.less_overflow(now, net))

        return partials(rates, self._gathered, self.levels[0].shape)
