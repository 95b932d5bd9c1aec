"""First-order forcing by an effect: how it changes the level rates, or a reading, along a given trajectory.

Only the component with the effect is evaluated again. The influence of its flow on the level rates is linearised once
for all effects, so that the whole library costs little more than one right-hand side.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor

from fdi_torch.plant.effect import Placement, Stage
from fdi_torch.plant.flow_component import FlowOrder
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.operating_point import OperatingPoint
from fdi_torch.simulate.actuation import Actuation
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.output_map import OutputMap
from fdi_torch.simulate.pointwise import Row, partials

Starts = Mapping[str, Tensor]


class Forcing:
    """A trajectory of a plant, levels (tanks, K+1) m at the nodes, along which effects are tried.

    union: the plant with every effect that may be tried. present: prefixes of the effects that act. values: the plant's
    constants, bound to one lane.

    Attributes at the middle of each step: levels (1, K) m of each tank; commands of each actuator; flows (m^3/s) and
    heads (m): of each flow component by its name; still: level rates without the effect that is tried, m/s.
    """

    def __init__(
        self,
        union: TankNetwork,
        present: Iterable[str],
        values: PlaceValues,
        levels: Tensor,
        experiment: Experiment,
    ) -> None:
        self.union, self.present, self.values, self.experiment = union, frozenset(present), values, experiment
        self._path = levels.unsqueeze(0)
        self.levels = list((0.5 * (levels[:, 1:] + levels[:, :-1])).unsqueeze(1).unbind(0))
        network = union.restricted_to(self.present)
        actuation = Actuation(network, experiment, [])
        self._clock = actuation.clock
        self.commands = actuation.commands(values, 1)
        now = self._now(network, values, self.commands)
        first = network.flows(now)
        gathered = network.net_inflows(now, first)
        self._gathered = [net.expand(self.levels[0].shape) for net in gathered]
        self.flows = first | network.last_flows(now, self._gathered)[0]
        flows_at = {c.name: now.at_flow(c) for c in union.description.flow_components()}
        self.heads = {name: local.head for name, local in flows_at.items()}
        self._net = network.less_overflow(now, self._gathered)
        self.still, self._by_inflow = self._inflow_slopes(network)
        self._readings = OutputMap(network, experiment, []).read(self._path, values)[0]

    def rates(self, placement: Placement, starts: Starts) -> Tensor:
        """Change of the level rates (tanks, M, K) m/s by an effect. starts: its parameters by short name, (M, 1)."""
        network, values, lanes = self._with(placement, starts)
        if placement.effect.stage is Stage.STORAGE:
            rates = network.level_rates(self._now(network, values, self.commands), self._net)
            return self._changes(rates, lanes)
        return self._rates_by_flow(network, placement, values, lanes)

    def by_inflows(self, inflows: Sequence[Tensor | None], lanes: int) -> Tensor:
        """Change of the level rates by additional flows into each tank, (M, K) or (1, K) m^3/s; None for no flow."""
        changed = []
        for row in self._by_inflow:
            total = self.levels[0].new_zeros(lanes, self.levels[0].shape[-1])
            for slope, inflow in zip(row, inflows, strict=True):
                if slope is not None and inflow is not None:
                    total += slope * inflow
            changed.append(total)
        return torch.stack(changed)

    def by_rates(self, weights: Tensor) -> Tensor:
        """The transpose of `by_inflows`: weights of the rates (tanks, M, K) -> weights of the inflows, same shape."""
        by_inflow = torch.zeros_like(weights)
        for row, weight in zip(self._by_inflow, weights, strict=True):
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
        return network.operating_point(self.levels, commands, self._clock, values)

    def _rates_by_flow(self, network: TankNetwork, placement: Placement, values: PlaceValues, lanes: int) -> Tensor:
        """Change of the level rates (tanks, M, K) m/s by an effect that changes a flow."""
        plant, place, commands = network.description, placement.location, self.commands
        if placement.effect.stage is Stage.BALANCE:
            net = list(self._gathered)
            network.transfer_by_effect(net, placement, self._now(network, values, commands))
            return self.by_inflows([a - b for a, b in zip(net, self._gathered, strict=True)], lanes)
        if placement.effect.stage is Stage.COMMAND:
            commands = Actuation(network, self.experiment, []).commands(values, lanes)
        now = self._now(network, values, commands)
        component = next(c for c in plant.flow_components() if c.name == place)
        if component.order > FlowOrder.BY_LEVELS:  # its own limits depend on the net inflow, as `still` does
            rates = network.level_rates(now, network.less_overflow(now, self._gathered))
            return self._changes(rates, lanes)
        inflows = [torch.zeros_like(net) for net in self._gathered]
        network.transfer(inflows, component.source, component.target, network.flow(now, component) - self.flows[place])
        return self.by_inflows(inflows, lanes)

    def _changes(self, rates: Sequence[Tensor], lanes: int) -> Tensor:
        """Differences of level rates from `still`, (tanks, M, K) m/s."""
        shape = (lanes, self.levels[0].shape[-1])
        return torch.stack([(a - b).expand(shape) for a, b in zip(rates, self.still, strict=True)])

    def _inflow_slopes(self, network: TankNetwork) -> tuple[list[Tensor], list[Row]]:
        """Level rates, and slope of each tank's rate with the flow into each tank, 1/m^2."""

        now = self._now(network, self.values, self.commands)

        def rates(net: Sequence[Tensor]) -> Sequence[Tensor]:
            return network.level_rates(now, network.less_overflow(now, net))

        return partials(rates, self._gathered, self.levels[0].shape)
