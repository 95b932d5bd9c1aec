"""Recordings with long sampling intervals, and tanks without a sensor."""

from dataclasses import replace

import pytest
import torch

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, effect
from fdi_torch.gap.accurate_steps import errors_by_readings, with_accurate_steps
from fdi_torch.gap.channel_noise import estimate_noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.problem import checked_data_set
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of, with_simulated_levels
from fdi_torch.recording import Recording
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.engine_choice import make_engine
from fdi_torch.simulate.experiment import Experiment, divided, lay_out
from tests.rigs import constant_inputs, three_tank
from tests.test_gap import WHOLE, nominal_plant, recorded


@pytest.mark.parametrize(("ar", "count"), [(0.0, 1024), (0.0, 6000), (0.7, 6000)])
def test_a_model_error_above_the_corner_frequency_is_not_taken_for_correlated_noise(ar: float, count: int) -> None:
    generator = torch.Generator().manual_seed(1)
    fresh = torch.randn(count, 2, dtype=torch.float64, generator=generator)
    noise, slope, level = fresh[:, 0].clone(), fresh[:, 1].clone(), torch.zeros(count, dtype=torch.float64)
    for k in range(1, count):
        noise[k] += ar * noise[k - 1]
        slope[k] += 0.9 * slope[k - 1]  # flows that are wrong for some ten samples at a time
        level[k] = 0.98 * level[k - 1] + slope[k]
    found = estimate_noise((noise + level).unsqueeze(1), torch.ones(count, 1, dtype=torch.bool), WHOLE)
    assert float(found.ar[0]) == pytest.approx(ar, abs=0.25)
    assert float(found.std[0]) == pytest.approx(float(noise.std()), rel=0.35)


def test_the_range_of_a_tank_without_a_sensor_is_that_of_the_model() -> None:
    plant = load_plant("cascaded_tanks")
    time = torch.arange(3, dtype=torch.float64)
    readings = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
    recording = Recording(time, readings, readings, ("u_pump",), ("y_lower_level",), ("V",), ("V",))
    plain = operating_range_of(recording, plant)
    assert plain.levels["upper"] == (0.0, pytest.approx(0.14))
    levels = torch.tensor([[0.05, 0.5], [0.08, 0.6]], dtype=torch.float64)
    found = with_simulated_levels(plain, plant, levels)
    assert found.levels["upper"] == (0.05, 0.08)
    assert found.levels["lower"] == plain.levels["lower"]


def test_samples_far_apart_are_simulated_in_shorter_steps() -> None:
    recording = recorded({"P13.discharge_coefficient": 0.615}, 11)
    steps = [
        float(checked_data_set(nominal_plant(), (), [recording.every(n)], None).experiment.steps.max())
        for n in (1, 5, 10, 12)
    ]
    assert steps == pytest.approx([1.0, 2.5, 2.5, 2.4], abs=1e-12)


@pytest.mark.parametrize(("sample", "step"), [(1.0, 1.0), (2.0, 0.5)])
def test_the_error_of_a_step_follows_from_third_differences(sample: float, step: float) -> None:
    """Samples of a cubic: h = 0.1 + 2e-4 t^3, so that dt^3 h''' / 24 = 5e-5 dt^3."""
    blank = constant_inputs(nominal_plant(), 8.0, sample=sample)
    cubic = (0.1 + 2e-4 * blank.time**3).unsqueeze(1).expand(-1, 3)
    flat = torch.full_like(cubic, 0.1)
    noise = torch.tensor([1e-3, 1e-3, 2e-3], dtype=torch.float64)
    for readings, error in ((torch.stack([flat[:, 0], flat[:, 1], cubic[:, 2]], dim=1), 5e-5 / 2e-3), (flat, 0.0)):
        part = data_set_of(nominal_plant(), (), replace(blank, outputs=readings, mask=None), step).parts[0]
        assert errors_by_readings(part, noise).tolist() == pytest.approx(
            [step**3 * error] * len(part.experiment.steps), abs=1e-9
        )


def test_steps_in_which_a_level_moves_fast_are_divided() -> None:
    """T1 starts 10 cm above the crest of a wide overflow, and falls to it within two seconds."""
    plant = three_tank(start=(0.5, 0.2, 0.1))
    notch = Placement(effect("overflow"), "T1", {"below_rim": 0.6, "crest": 0.2})
    blank, network = constant_inputs(plant, 200.0, sample=1.0), build_network(plant, [notch])
    space = ParameterSpace([network.constants["P13.discharge_coefficient"]])
    theta = space.nominal().unsqueeze(0)
    exact = make_engine(network, space, lay_out(blank, plant.channels(), 0.02)).readings(theta)[0]
    std = 1e-3  # m
    noise = std * torch.randn(exact.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    data = with_accurate_steps(data_set_of(plant, (), replace(blank, outputs=exact + noise, mask=None), 1.0))
    assert len(data.experiment.steps) < len(blank) + 20, "steps in which all levels move slowly are not divided"
    assert torch.equal(data.experiment.sample_times, blank.time)
    assert torch.equal(data.experiment.nodes[data.experiment.sample_step[1:] + 1], blank.time[1:])

    def error(experiment: Experiment) -> float:
        engine = Collocation(network, space, experiment)
        return float((engine.converge(theta).readings[0] - exact).abs().max())

    assert error(lay_out(blank, plant.channels(), 1.0)) > 20.0 * std
    assert error(data.experiment) < std


def test_divided_steps_keep_the_inputs_and_their_means() -> None:
    recording = recorded({}, 3, samples=200)
    whole = lay_out(recording, nominal_plant().channels(), 1.0)
    counts = torch.ones(len(whole.steps), dtype=torch.int64)
    counts[4], counts[69], counts[-1] = 3, 2, 4
    parts = divided(whole, counts)
    assert len(parts.steps) == int(counts.sum())
    assert parts.steps[4:7].tolist() == pytest.approx([1.0 / 3.0] * 3)
    assert parts.resolution[[3, 4, 7]].tolist() == pytest.approx([1.0, 1.0 / 3.0, 1.0])
    volume = torch.cumsum(parts.inputs * parts.steps.unsqueeze(1), 0)[torch.cumsum(counts, 0) - 1]
    assert torch.allclose(volume, torch.cumsum(whole.inputs * whole.steps.unsqueeze(1), 0), rtol=1e-12, atol=0)


def test_steps_are_accurate_for_a_tank_that_exchanges_its_water_fast() -> None:
    """T1 has a tenth of the others' area, so that its level follows that of T3 within seconds."""
    plant, recording = three_tank(start=(0.5, 0.2, 0.1)), recorded({}, 7, samples=600)
    plant = replace(plant, tanks=(replace(plant.tanks[0], area=1.6e-3), *plant.tanks[1:]))
    network = build_network(plant, [])
    space = ParameterSpace([network.constants["P13.discharge_coefficient"]])
    theta = space.nominal().unsqueeze(0)
    exact = make_engine(network, space, lay_out(recording, plant.channels(), 0.02)).readings(theta)[0]
    std = 2e-4  # m
    noise = std * torch.randn(exact.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    data = data_set_of(plant, (), replace(recording, outputs=exact + noise, mask=None), 1.0)
    accurate = with_accurate_steps(data)

    def chi_square(experiment: Experiment) -> float:
        engine = Collocation(network, space, experiment)
        error = engine.converge(theta).readings[0] - exact
        return float((error / std).square().sum(dim=0).max())

    assert chi_square(data.experiment) > 100.0
    assert chi_square(accurate.experiment) < 10.0, "one for the errors of single steps, which add up for a while"
    assert len(accurate.experiment.steps) < 3 * len(recording)
    assert with_accurate_steps(accurate).experiment.steps.shape == accurate.experiment.steps.shape


@pytest.mark.slow
def test_a_sound_rig_with_a_small_tank_has_no_gap() -> None:
    """With steps of 1 s throughout, the errors of the integration were named as a cause."""
    plant = replace(nominal_plant(), tanks=three_tank(start=(0.5, 0.2, 0.1)).tanks)
    plant = replace(plant, tanks=(replace(plant.tanks[0], area=1.6e-3), *plant.tanks[1:]))
    recording, network = recorded({}, 7, samples=1200), build_network(plant, [])
    space = ParameterSpace([network.constants["P13.discharge_coefficient"]])
    fine = lay_out(recording, plant.channels(), 0.02)
    exact = make_engine(network, space, fine).readings(space.nominal().unsqueeze(0))[0]
    noise = 3e-4 * torch.randn(exact.shape, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    library = ("pump_gain", "pump_lag", "laminar_flow", "leak", "sensor_bias", "flow_exponent")
    found = diagnose(plant, replace(recording, outputs=exact + noise, mask=None), settings=Settings(library=library))
    assert found.verdict == "no_gap"
