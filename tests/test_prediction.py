"""Free runs of a plant file, and the joint refit of what it holds."""

from dataclasses import replace

import pytest
import torch

from fdi_torch.config.plant import load_plant
from fdi_torch.gap.prediction import predict
from fdi_torch.gap.refit import refit
from fdi_torch.plant.description import PlacedEffect, PlantDescription
from fdi_torch.recording import Recording

NOISE = 0.01  # V


def rig() -> PlantDescription:
    """Two cascaded tanks, the level of the upper one unseen, behind a pump that lags."""
    plant = load_plant("cascaded_tanks")
    return replace(plant, effects=(PlacedEffect("pump_lag", "pump", {"time_constant": 60.0}),))


def recording(plant: PlantDescription) -> Recording:
    """300 samples, 4 s apart, of the plant itself, with noise."""
    time = 4.0 * torch.arange(300, dtype=torch.float64)
    volts = 2.6 + 0.8 * torch.sin(time / 70.0) + 0.4 * torch.sin(time / 31.0)
    blank = Recording(
        time, volts.unsqueeze(1), torch.full((300, 1), 5.0).double(), ("u_pump",), ("y_lower_level",), ("V",), ("V",)
    )
    generator = torch.Generator().manual_seed(0)
    noise = NOISE * torch.randn(300, 1, dtype=torch.float64, generator=generator)
    return replace(blank, outputs=predict(plant, blank).readings + noise)


def test_the_free_run_of_the_right_plant_is_off_by_the_noise_and_finds_the_unseen_level() -> None:
    plant = rig()
    run = recording(plant)
    found = predict(plant, run)
    assert found.settled
    assert found.rmse["level"] == pytest.approx(NOISE, rel=0.15)
    assert predict(replace(plant, effects=()), run).rmse["level"] > 5 * NOISE


def test_only_the_first_samples_are_used() -> None:
    plant = rig()
    run = recording(plant)
    later = run.outputs.clone()
    later[60:] += 1.0
    moved = predict(plant, replace(run, outputs=later)).start_levels
    assert moved == pytest.approx(predict(plant, run).start_levels, rel=1e-9)


def test_nothing_to_start_from_is_said() -> None:
    plant = rig()
    with pytest.raises(ValueError, match="at least 1 sample"):
        predict(plant, recording(plant), start_samples=0)
    run = recording(plant).masked([(0.0, 300.0)])
    with pytest.raises(ValueError, match="among the first 50 samples, got none"):
        predict(plant, run)


def test_a_refit_finds_what_the_effects_are_and_loses_those_left_out() -> None:
    plant = rig()
    run = recording(plant)
    wrong = replace(plant, effects=(PlacedEffect("pump_lag", "pump", {"time_constant": 20.0}),))
    found = refit(wrong, run)
    assert found.rmse["level"] == pytest.approx(NOISE, rel=0.15)
    assert found.rmse["level"] < found.before["level"]
    assert predict(found.plant, run).rmse["level"] == pytest.approx(NOISE, rel=0.2)
    assert found.plant.effects[0].parameters["time_constant"] == pytest.approx(60.0, rel=0.1)
    assert refit(wrong, run, leave_out=["pump_lag"]).plant.effects == ()
