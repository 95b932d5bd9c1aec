"""Limits of a sensor that the values themselves tell."""

import pytest
import torch

from fdi_torch.config.plant import load_plant
from fdi_torch.effects import place
from fdi_torch.gap.limits import limits_of, told_limits
from fdi_torch.recording import Recording


def noisy(count: int = 400) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    wave = 5.0 + 4.0 * torch.sin(torch.arange(count, dtype=torch.float64) / 30.0)
    return wave + 0.02 * torch.randn(count, dtype=torch.float64, generator=generator)


def test_readings_that_stand_still_at_an_end_tell_the_limit() -> None:
    assert limits_of(noisy()) == {}
    assert limits_of(noisy().clamp(max=8.0)) == {"sensor_saturation": 8.0}
    assert limits_of(noisy().clamp(2.0, 8.0)) == {"sensor_saturation": 8.0, "sensor_floor": 2.0}


def test_a_channel_at_rest_or_rounded_coarsely_tells_no_limit() -> None:
    assert limits_of((noisy() / 0.5).round() * 0.5) == {}
    assert limits_of(torch.cat([torch.zeros(200), torch.ones(200)]).double()) == {}


def test_a_limit_that_the_plant_has_already_or_that_is_not_searched_is_not_told() -> None:
    plant = load_plant("quadruple_tank")
    sensor = plant.sensors[0]
    values = noisy().clamp(max=8.0).unsqueeze(1)
    time = torch.arange(len(values), dtype=torch.float64)
    recording = Recording(time, values[:, :0], values, (), (sensor.column,), (), (sensor.unit,))
    saturation = place("sensor_saturation", sensor.name)
    (told,) = told_limits(plant, recording, [], [saturation])
    assert told.prefix == saturation.prefix
    assert told.values == {"limit": pytest.approx(8.0)}
    assert told_limits(plant, recording, [saturation], [saturation]) == []
    assert told_limits(plant, recording, [], []) == []
