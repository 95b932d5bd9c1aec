"""The first-order forcing at an effect's place equals the change in the whole plant."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fdi_torch.effects import EFFECTS, build_network
from fdi_torch.gap.forcing import Forcing
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Placement, Stage, fits
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.experiment import lay_out
from tests.rigs import constant_inputs, three_tank

PLANT = three_tank()
# At given levels alone an effect with states is in steady state; test_effects_states.py runs the gap on these.
TRIED = [
    Placement(e, p) for e in EFFECTS if not (e.quantizes or e.states) for p in PLANT.locations() if fits(e, PLANT, p)
]


@pytest.mark.parametrize("placement", TRIED, ids=lambda p: p.prefix)
def test_an_effect_forces_the_levels_and_moves_the_readings_as_the_whole_plant_says(placement: Placement) -> None:
    blank = constant_inputs(PLANT, 120.0)
    inputs = blank.inputs.clone()
    inputs[40:80] *= 0.3
    recording = replace(blank, inputs=inputs)
    experiment = lay_out(recording, PLANT.channels(), 1.0)
    network = build_network(PLANT, [placement])
    time = experiment.nodes
    levels = torch.stack([0.3 + 0.1 * torch.sin(time / 20.0 + k) for k in range(len(PLANT.tanks))])
    starts = [
        {f"{placement.prefix}.{n}": v for n, v in s.items()}
        for s in placement.effect.starts(placement.location, PLANT, operating_range_of(recording, PLANT))
    ]
    for start in starts:
        space = ParameterSpace(network.constants[n] for n in start)
        engine = Collocation(network, space, experiment)
        none, with_it = space.nominal().unsqueeze(0), space.vector(start).unsqueeze(0)
        values = network.bind(ParameterSpace(()), torch.zeros(1, 1, 0, dtype=torch.float64))
        forcing = Forcing(network, network, (), values, levels, experiment)
        short = {n.rpartition(".")[2]: torch.tensor([[v]], dtype=torch.float64) for n, v in start.items()}
        if placement.effect.stage is Stage.READING:
            expected = engine.read(levels.T.unsqueeze(0), with_it) - engine.read(levels.T.unsqueeze(0), none)
            found = forcing.readings(placement, short).permute(1, 2, 0)
        else:
            middle = (0.5 * (levels[:, 1:] + levels[:, :-1])).T.unsqueeze(0)
            expected = engine.rates(middle, with_it) - engine.rates(middle, none)
            found = forcing.rates(placement, short).permute(1, 2, 0)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-15)
