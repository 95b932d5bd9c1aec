"""Observers with parameters as states: on a leak and a plugged outlet whose sizes are known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from benchmarks.paper.adaptive_observer import JointModel, adaptive_observer, joint_filter
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, place
from fdi_torch.monitor.observer import bind_parameters
from fdi_torch.monitor.observer_gain import hand_gain
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import Stepper
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.equilibrium import equilibrium

NETWORK = build_network(load_plant("three_tank"), [place("leak", "T1"), place("plugging", "OUT2")])
SPACE = ParameterSpace([NETWORK.constants["T1.leak.size"], NETWORK.constants["OUT2.plugging.size"]])
TRUTH = torch.tensor([0.1, 0.2], dtype=torch.float64)
INPUTS = torch.tensor([50e-6, 50e-6], dtype=torch.float64)
REST = equilibrium(NETWORK, INPUTS)
STD = 1e-3
MODEL = JointModel(NETWORK, SPACE)


def faulty(samples: int, runs: int = 3) -> Samples:
    stepper, values = Stepper(NETWORK), bind_parameters(NETWORK, SPACE, TRUTH)
    state = stepper.start(REST, INPUTS, values)
    levels = [state.levels]
    for k in range(samples - 1):
        state = stepper.advance(state, lambda share: INPUTS, float(k), 1.0, values)
        levels.append(state.levels)
    clean = torch.stack(levels)
    noise = torch.randn(runs, *clean.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Samples(torch.arange(samples, dtype=torch.float64), INPUTS.expand(samples, 2), clean + STD * noise)


def start(runs: int = 3) -> tuple[Tensor, Tensor]:
    return REST.expand(runs, 3), SPACE.nominal().expand(runs, 2)


def test_the_conventional_adaptive_observer_finds_two_sizes() -> None:
    gain = hand_gain(0.1 * torch.eye(3, dtype=torch.float64))
    # A leak lowers level 1, plugging of the outlet raises level 2.
    rate = torch.tensor([[-0.3, 0.0, 0.0], [0.0, 0.3, 0.0]], dtype=torch.float64)
    seen = adaptive_observer(MODEL, faulty(400), *start(), gain, rate)
    torch.testing.assert_close(seen.theta[:, 200:].mean(1), TRUTH.expand(3, 2), rtol=0, atol=0.01)


@pytest.mark.slow
def test_the_extended_kalman_filter_finds_two_sizes_within_its_own_errors() -> None:
    start_std = torch.tensor([STD, STD, STD, 0.3, 0.3], dtype=torch.float64)
    wander = torch.tensor([1e-6, 1e-6, 1e-6, 1e-5, 1e-5], dtype=torch.float64)
    samples = faulty(100)
    samples.readings[:, 50:60, 1] = torch.nan
    seen = joint_filter(MODEL, samples, *start(), start_std, wander, torch.full((3,), STD, dtype=torch.float64))
    pull = (seen.theta[:, -1] - TRUTH) / seen.std[:, -1]
    assert float(seen.std[:, -1].max()) < 0.02
    assert float(pull.abs().max()) < 4.0


def test_a_gain_of_the_wrong_shape_and_effects_with_memory_are_refused() -> None:
    gain = hand_gain(torch.zeros(3, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="expected K_theta of 2 parameters x 3 sensors"):
        adaptive_observer(MODEL, faulty(3), *start(), gain, torch.zeros(3, 2, dtype=torch.float64))
    with pytest.raises(ValueError, match="without memory"):
        JointModel(build_network(load_plant("three_tank"), [place("pump_lag", "Q1")]), SPACE)
