"""Which estimated parameters count as faults, and which faults have an equivalent hole."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.effects import build_network, place
from fdi_torch.estimate.diagnosis import Diagnosis, diagnose
from fdi_torch.estimate.misfit import NOISE_ERROR, Misfit, channel_misfit
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlacedEffect

DEAD_ZONE = "Q1.pump_dead_zone.dead_zone"


def diagnosis() -> Diagnosis:
    """A leak and a plugging of 0.1, and a dead zone that is known as 5 ± 2 cm^3/s and estimated at 6 cm^3/s."""
    known = PlacedEffect("pump_dead_zone", "Q1", {"dead_zone": 5e-6})
    plant = replace(chosen_plant("three_tank"), effects=(known,), tolerances={DEAD_ZONE: 2e-6})
    network = build_network(plant, (place("leak", "T1"), place("plugging", "P13")))
    space = ParameterSpace([network.constants[n] for n in ("T1.leak.size", "P13.plugging.size", DEAD_ZONE)])
    value = torch.tensor([0.1, 0.1, 6e-6], dtype=torch.float64)
    std = torch.tensor([1e-3, 1e-3, 1e-8], dtype=torch.float64)
    levels, channels = torch.tensor([0.5, 0.3, 0.4]).double(), torch.tensor([5e-5, 5e-5]).double()
    return diagnose(network, space, value, std, levels, channels, misfit=Misfit(1.0))


def test_a_known_effect_within_its_tolerance_is_no_fault() -> None:
    assert [fault.name for fault in diagnosis().present] == ["T1.leak.size", "P13.plugging.size"]


def test_only_a_fault_of_a_tank_has_a_hole() -> None:
    """The flow of the hole by Torricelli's law is that of the leak."""
    leak, plugging = diagnosis().present
    assert leak.hole is not None and leak.flow is not None and plugging.flow is not None
    assert 0.6 * math.pi / 4.0 * leak.hole**2 * math.sqrt(2 * 9.81 * 0.5) == pytest.approx(leak.flow)
    assert plugging.flow > 0.0 and plugging.hole is None


@pytest.mark.parametrize(("error", "explained"), [(2e-6, True), (2e-5, False)])
def test_the_error_of_the_simulation_is_no_misfit_of_a_recording_without_noise_that_rests(
    error: float, explained: bool
) -> None:
    """A level that settles within 100 s of an hour; the plant that made it predicts it to within a few micrometres."""
    time = torch.arange(3600.0, dtype=torch.float64)[:, None]
    levels = 1.0 - 0.5 * torch.exp(-time / 20.0)
    assert channel_misfit(levels.new_tensor([error]), levels, torch.ones_like(levels)).explained == explained


@pytest.mark.parametrize("samples", [50, 100, 300])
def test_the_model_that_made_a_short_recording_is_seldom_rejected(samples: int) -> None:
    """White noise alone is left; its level is estimated from the same readings, of which 50 know it to 17 %."""
    generator = torch.Generator().manual_seed(7)
    noise = torch.randn(1000, samples, 1, dtype=torch.float64, generator=generator)
    left = [channel_misfit(each.square().mean(dim=0).sqrt(), each, torch.ones_like(each)) for each in noise]
    assert sum(not each.explained for each in left) <= 10
    error = torch.tensor([each.ratio for each in left]).log().std() * math.sqrt(samples)
    assert float(error) == pytest.approx(NOISE_ERROR, rel=0.1)
    slow = 5.0 * torch.sin(torch.linspace(0.0, 3.0, samples, dtype=torch.float64))[:, None]  # what the model lacks
    wrong = [channel_misfit((x + slow).square().mean(dim=0).sqrt(), x, torch.ones_like(x)) for x in noise]
    assert sum(each.explained for each in wrong) <= 10
