"""Limits of a sensor that the readings show without a model."""

import math
from dataclasses import replace

import pytest
import torch

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import place
from fdi_torch.effects.clipping import clipping_bias
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.preprocess.sensor_limits import limits_from_readings, limits_of
from fdi_torch.gap.problem import problem_of
from fdi_torch.recording import Recording
from tests.test_gap import noise, nominal_plant, recorded


def noisy(count: int = 400) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    wave = 5.0 + 4.0 * torch.sin(torch.arange(count, dtype=torch.float64) / 30.0)
    return wave + 0.02 * torch.randn(count, dtype=torch.float64, generator=generator)


def test_constant_readings_at_an_end_show_the_limit() -> None:
    assert limits_of(noisy()) == {}
    assert limits_of(noisy().clamp(max=8.0)) == {"sensor_saturation": 8.0}
    assert limits_of(noisy().clamp(2.0, 8.0)) == {"sensor_saturation": 8.0, "sensor_floor": 2.0}


def test_a_channel_at_rest_or_coarsely_quantized_shows_no_limit() -> None:
    assert limits_of((noisy() / 0.5).round() * 0.5) == {}
    assert limits_of(torch.cat([torch.zeros(200), torch.ones(200)]).double()) == {}


def test_a_limit_that_the_plant_has_or_that_is_not_searched_is_not_added() -> None:
    plant = load_plant("quadruple_tank")
    sensor = plant.sensors[0]
    values = noisy().clamp(max=8.0).unsqueeze(1)
    time = torch.arange(len(values), dtype=torch.float64)
    recording = Recording(time, values[:, :0], values, (), (sensor.column,), (), (sensor.unit,))
    saturation = place("sensor_saturation", sensor.name)
    (told,) = limits_from_readings(plant, [recording], [], [saturation])
    assert told.prefix == saturation.prefix
    assert told.values == {"limit": pytest.approx(8.0)}
    assert limits_from_readings(plant, [recording], [saturation], [saturation]) == []
    assert limits_from_readings(plant, [recording], [], []) == []


@pytest.mark.parametrize("behind", [False, True])
def test_clipped_noise_is_no_further_gap(behind: bool) -> None:
    std, seed, samples = 4e-3, 11, 2000
    recording = recorded({}, seed, samples, std)
    e = noise(samples, 0.0, std, seed + 1)
    level = recording.outputs - e
    limit = float(level[:, 0].quantile(0.7))
    limits = torch.tensor([limit, math.inf, math.inf], dtype=torch.float64)
    reading = torch.minimum((torch.minimum(level, limits) if behind else level) + e, limits)
    library = ("sensor_saturation", "sensor_bias", "sensor_curvature", "pump_gain@Q1")
    answer = diagnose(nominal_plant(), replace(recording, outputs=reading), settings=Settings(library))
    assert answer.verdict == "named"
    assert [(c.effect, c.location, c.parameters["limit"].value) for c in answer.causes] == [
        ("sensor_saturation", "h1", pytest.approx(limit, rel=1e-9))
    ]
    assert answer.noise["h1"]["std"] == pytest.approx(std, rel=0.08)
    known = replace(
        nominal_plant(), sensors=tuple(replace(s, high=limit) if s.name == "h1" else s for s in nominal_plant().sensors)
    )
    assert diagnose(known, replace(recording, outputs=reading), settings=Settings(library)).verdict == "no_gap"


def test_the_noise_that_a_limit_clips_is_that_of_a_reading_and_not_of_a_mean_of_readings() -> None:
    """Rows of two readings each, and a plugged pipe that the fit without effects does not have: it predicts the level
    wrongly, by centimetres."""
    std, seed, samples = 4e-3, 11, 2000
    recording = recorded({"P13.plugging.size": 0.5}, seed, samples, std)
    e = noise(samples, 0.0, std, seed + 1)
    level = recording.outputs - e
    limit = float(level[:, 0].quantile(0.7))
    limits = torch.tensor([limit, math.inf, math.inf], dtype=torch.float64)
    reading = torch.minimum(torch.minimum(level, limits) + e, limits)
    settings = Settings(("sensor_saturation", "plugging"), step=2.0)
    data = problem_of(nominal_plant(), [replace(recording, outputs=reading)], [], settings).data
    fitter, _, _ = recalibrate(data)
    (clipped,) = (p for p in fitter.data.nominal_effects if p.effect.name == "sensor_saturation")
    assert clipped.values is not None
    assert clipped.values["noise"] == pytest.approx(std, rel=0.1)
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in clipped.values.items()}
    bias = float(clipping_bias(torch.tensor(1.0, dtype=torch.float64), values))
    assert bias == pytest.approx(std / math.sqrt(2.0 * math.pi), rel=0.1), "of readings far beyond the limit"


def test_the_last_bits_of_readings_change_nothing() -> None:
    """They depend on the unit in which a file holds the readings. One sensor is clipped here, one rounds."""
    recording = recorded({}, 12, 1000, 1e-3)
    level = recording.outputs
    limit = float(level[:, 0].quantile(0.8))
    held = torch.stack([level[:, 0].clamp(max=limit), level[:, 1], (level[:, 2] / 0.004).round() * 0.004], dim=1)
    library = ("sensor_saturation", "sensor_quantization", "sensor_bias", "pump_gain@Q1")
    up = torch.rand(held.shape, generator=torch.Generator().manual_seed(1)) < 0.5
    in_another_unit = torch.nextafter(held, torch.where(up, 1.0, 0.0).to(held))
    answers = [
        diagnose(nominal_plant(), replace(recording, outputs=readings), settings=Settings(library)).to_dict()
        for readings in (held, in_another_unit)
    ]
    assert {(c["effect"], c["location"]) for c in answers[0]["causes"]} == {
        ("sensor_saturation", "h1"),
        ("sensor_quantization", "h3"),
    }
    assert answers[0] == answers[1]
