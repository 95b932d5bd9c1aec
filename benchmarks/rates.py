"""Rates of all levels with their slopes along a recording, by the traced equations and by automatic differentiation."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.networks import an_hour, branched
from benchmarks.timing import seconds_in_rounds
from fdi_torch.effects import build_network, placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.actuation import with_parameters
from fdi_torch.simulate.linearised_stage import partials
from fdi_torch.simulate.traced_rates import TracedRates

SIZES = (3, 10, 30)
STEPS = 1200
Row = tuple[int, float, float, float]


def measure(budget: float) -> list[Row]:
    """Tanks, CPU seconds of a trace, of an evaluation by it, and of one by automatic differentiation."""
    return [_row(tanks, budget) for tanks in SIZES]


def _row(tanks: int, budget: float) -> Row:
    plant = branched(tanks)
    network = build_network(plant, placements_for({"T1.leak.size": 0.3}))
    space = ParameterSpace(p for p in network.constants if p.name.endswith(("discharge_coefficient", "leak.size")))
    theta, hour = space.nominal().unsqueeze(0), an_hour(plant)
    state = 0.1 + 0.5 * torch.rand(1, tanks, STEPS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    commands = list(hour.inputs[:STEPS].T.unsqueeze(1).contiguous())
    start, one = torch.arange(STEPS, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    clock = Clock(start, torch.ones_like(start), one)
    traced, bound = TracedRates(network, space.names), network.bind(space, theta.unsqueeze(-2))

    def by_trace() -> object:
        return traced(state, commands, theta, network.nominal, clock, moved=range(len(space)))

    def rates(x: list[Tensor]) -> list[Tensor]:
        return network.rates(x[:tanks], commands, clock, with_parameters(bound, space.names, x[tanks:]))

    inputs = [*state.unbind(1), *(column.unsqueeze(-1) for column in theta.unbind(-1))]
    runs = [lambda: TracedRates(network, space.names), by_trace, lambda: partials(rates, inputs, (1, STEPS))]
    trace, evaluation, differentiation = seconds_in_rounds(runs, budget)
    return tanks, trace, evaluation, differentiation


def table(rows: list[Row]) -> str:
    lines = ["| tanks | trace, once, ms | evaluation, ms | over three tanks | automatic differentiation over it |"]
    lines.append("|---|---|---|---|---|")
    for tanks, trace, evaluation, differentiation in rows:
        growth, ratio = evaluation / rows[0][2], differentiation / evaluation
        lines.append(f"| {tanks} | {1e3 * trace:.1f} | {1e3 * evaluation:.2f} | {growth:.1f} | {ratio:.0f} |")
    return "\n".join(lines)
