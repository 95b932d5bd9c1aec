"""Traced rates and their slopes against automatic differentiation of the plant's equations."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from fdi_torch.effects import EFFECTS, build_network, place
from fdi_torch.gap.free_form import FreeInflow
from fdi_torch.parameters import ParameterSpace, by_prefix
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Placement, Stage, fits
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.array_program import BLOCK
from fdi_torch.simulate.linearised_stage import partials
from fdi_torch.simulate.program import build_program
from fdi_torch.simulate.traced_rates import RateSlopes, TracedRates, traced_rates
from tests.rigs import three_tank

STEPS, LANES = BLOCK + 7, 2
IN_RATES = [e for e in EFFECTS if e.stage in (Stage.FLOW, Stage.BALANCE, Stage.STORAGE)]


@pytest.fixture(params=["interpreter", "torch"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The compiled interpreter, where there is a compiler, and torch."""
    if request.param == "torch":
        monkeypatch.setattr("fdi_torch.simulate.array_program._library", lambda: None)
    return request.param


both_ways = pytest.mark.usefixtures("way")


def draws(network: TankNetwork, lanes: int = LANES) -> tuple[Tensor, list[Tensor], Tensor, ParameterSpace, Clock]:
    """Random states, some of them over a rim and some dry, commands and parameters near nominal, and a clock."""
    generator = torch.Generator().manual_seed(5)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    space = ParameterSpace(p for p in network.constants if ".start_level" not in p.name)
    nominal = space.nominal()
    theta = nominal * (1.0 + 0.02 * draw(lanes, len(nominal))) + torch.where(nominal == 0.0, 0.05, 0.0)
    state = 0.7 * draw(lanes, network.order, STEPS) - 0.02
    start = torch.arange(STEPS, dtype=torch.float64)
    clock = Clock(start, torch.ones_like(start), torch.tensor(1.0, dtype=torch.float64))
    return state, [1e-4 * draw(lanes, STEPS) for _ in network.actuators()], theta, space, clock


def by_autograd(network: TankNetwork, given: tuple[Tensor, list[Tensor], Tensor, ParameterSpace, Clock]) -> RateSlopes:
    state, commands, theta, space, clock = given
    n, m = network.order, len(commands)
    nominal = dict(network.bind(space, theta.unsqueeze(-2)))

    def rates(x: list[Tensor]) -> list[Tensor]:
        values = {prefix: dict(fields) for prefix, fields in nominal.items()}
        for prefix, fields in by_prefix(dict(zip(space.names, x[n + m :], strict=True))).items():
            values[prefix] |= fields
        return network.rates(x[:n], x[n : n + m], clock, values)

    inputs = [*state.unbind(1), *commands, *(column.unsqueeze(-1) for column in theta.unbind(-1))]
    values, rows = partials(rates, inputs, (len(theta), STEPS))
    zero = torch.zeros_like(values[0])
    slopes = [[zero if slope is None else slope for slope in row] for row in rows]
    return RateSlopes(
        torch.stack(values, dim=1),
        torch.stack([torch.stack(row[:n], dim=1) for row in slopes], dim=1),
        {(i, d): row[n + d] for i, row in enumerate(slopes) for d in range(m)},
        {(i, p): row[n + m + p] for i, row in enumerate(slopes) for p in range(len(space))},
    )


def traced(network: TankNetwork, given: tuple[Tensor, list[Tensor], Tensor, ParameterSpace, Clock]) -> RateSlopes:
    state, commands, theta, space, clock = given
    everything = {"driven": range(len(commands)), "moved": range(len(space))}
    return TracedRates(network, space.names)(state, commands, theta, network.nominal, clock, **everything)


def rig_of(effect: Effect) -> tuple[PlantDescription, str]:
    """A rig and a place for the effect: the three tanks, or one with a component of a kind that accepts it."""
    plant = three_tank()
    pairs = [f"{a}-{b}" for a, b in plant.tank_pairs()]
    at = next((p for p in [*plant.locations(), *pairs] if fits(effect, plant, p)), None)
    if at is None:
        pytest.skip(f"the three tanks have no place for {effect.name}")
    return plant, at


@both_ways
@pytest.mark.parametrize("effect", IN_RATES, ids=lambda e: e.name)
def test_rates_and_slopes_are_those_of_the_equations(effect: Effect) -> None:
    plant, at = rig_of(effect)
    network = build_network(plant, [place(effect.name, at)])
    given = draws(network)
    expected, found = by_autograd(network, given), traced(network, given)
    assert torch.allclose(found.rates, expected.rates, rtol=1e-12, atol=1e-15)
    assert torch.allclose(found.by_state, expected.by_state, rtol=1e-10, atol=1e-12)
    for ours, theirs in ((found.by_command, expected.by_command), (found.by_parameter, expected.by_parameter)):
        for (i, p), slope in theirs.items():
            largest = max(float(theirs[k, p].abs().max()) for k in range(network.order))  # terms may cancel
            mine = ours[i, p] if (i, p) in ours else torch.zeros_like(slope)
            assert torch.allclose(mine, slope, rtol=1e-10, atol=1e-11 * largest), (i, p)


@both_ways
def test_a_lane_gives_the_same_bits_alone_and_in_a_batch() -> None:
    network = build_network(three_tank(), [place("leak", "T1")])
    state, commands, theta, space, clock = draws(network, 3)
    together = traced(network, (state, commands, theta, space, clock))
    for k in range(3):
        one = slice(k, k + 1)
        alone = traced(network, (state[one], [c[one] for c in commands], theta[one], space, clock))
        assert torch.equal(alone.rates[0], together.rates[k])
        assert torch.equal(alone.by_state[0], together.by_state[k])
        for entry, slope in alone.by_parameter.items():
            assert torch.equal(slope[0], together.by_parameter[entry][k])


def test_plants_share_a_trace_only_if_their_equations_are_the_same() -> None:
    networks = [build_network(three_tank(), [place("leak", at)]) for at in ("T1", "T1", "T2")]
    networks.append(build_network(three_tank(tank_height=0.4), [place("leak", "T1")]))
    names = ["P13.discharge_coefficient", "T1.leak.size"]
    first, same, elsewhere, lower = (traced_rates(n, names[: 1 + ("T1.leak.size" in n.constants)]) for n in networks)
    assert first is same
    assert len({id(first), id(elsewhere), id(lower)}) == 3
    assert traced_rates(networks[0], names[:1]) is not first
    free = (build_network(three_tank(), [Placement(FreeInflow({"level": [0.0, 0.6]}, s), "T1")]) for s in (1.0, 2.0))
    assert len({id(traced_rates(network, names[:1])) for network in free}) == 2


def test_equal_plants_share_what_was_traced_and_others_do_not() -> None:
    """Whatever the equations depend on: the effects and their places, the limits of a sensor, the rims."""
    at_both = TankNetwork(three_tank(), [place("leak", "T1"), place("leak", "T2")])
    names = at_both.constants.names
    at_each = [at_both.restricted_to([prefix]) for prefix in ("T1.leak", "T2.leak")]
    first, *rest = three_tank().sensors
    limited = replace(three_tank(), sensors=(replace(first, high=0.5), *rest))
    others = [*at_each, at_both.without_overflow(), TankNetwork(limited, at_both.placements)]
    programs = [build_program(network, names, False) for network in (at_both, *others)]
    assert len({id(program) for program in programs}) == 5
    again = TankNetwork(three_tank(), at_both.placements)
    assert build_program(again, names, False) is programs[0]
    assert build_program(again, names, True) is not programs[0]
    assert traced_rates(again, names) is traced_rates(at_both, names)
    assert len({id(traced_rates(network, names)) for network in (at_both, *others[:3])}) == 4
