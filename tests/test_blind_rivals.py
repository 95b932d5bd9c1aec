"""Rivals that regress equation errors, on rigs whose gap is plain."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.blind_rivals.equation_errors import BLOCK, equation_errors
from benchmarks.blind_rivals.regression_baselines import (
    f_test,
    gaussian_process,
    noise_of,
    sparse_regression,
    split_f_test,
)
from fdi_torch.blind.conditions import asked_of_pumps, levels_at_rest
from fdi_torch.blind.deviation import Deviation
from fdi_torch.blind.inputs import commanded
from fdi_torch.blind.networks import with_unmeasured
from fdi_torch.blind.plants import three_tank
from fdi_torch.blind.simulator import Drive, HiddenRigs, simulate
from fdi_torch.recording import Recording

RIG = three_tank()
NOISE = 5e-4
GAIN = Deviation("pump_gain", "Q1", "scaled", {"gain": 0.9})
FLUTTER = Deviation("unknown", "OUT2", "fluttering", {"loss": 0.3, "period": 400.0})


def recorded(*off: Deviation, noise: float = NOISE) -> Recording:
    rng = np.random.default_rng(4)
    commands = commanded(RIG, rng, 2401)
    drive = Drive(asked_of_pumps(RIG.plant, commands), levels_at_rest(RIG))
    levels = simulate(HiddenRigs([RIG.plant], [off]), [drive], 0.25)[0].levels
    time, readings = torch.arange(2401, dtype=torch.float64), levels + noise * rng.normal(size=levels.shape)
    return RIG.plant.recording(time, torch.tensor(commands * 1e-6), torch.tensor(readings))


@pytest.fixture(scope="module")
def recordings() -> dict[str, Recording]:
    return {"null": recorded(), "gain": recorded(GAIN), "flutter": recorded(FLUTTER)}


def test_without_noise_and_gap_the_balances_close() -> None:
    errors = equation_errors(RIG.plant, recorded(noise=0.0))
    volumes = RIG.input_high * 90e-6 * BLOCK
    assert np.abs(errors.y).max() < 5e-3 * volumes


def test_a_column_times_its_size_is_the_equation_error() -> None:
    errors = equation_errors(RIG.plant, recorded(GAIN, noise=0.0))
    expected = -0.1 * errors.columns["pump_gain", "Q1"]
    np.testing.assert_allclose(errors.y, expected, atol=2e-2 * np.abs(expected).max())


def test_noise_is_told_by_second_differences() -> None:
    white = np.random.default_rng(5).normal(size=(20_001, 2)) * [1.0, 3.0]
    np.testing.assert_allclose(noise_of(np.diff(white, axis=0)), math.sqrt(2) * np.array([1.0, 3.0]), rtol=0.03)


def test_tanks_beside_an_unmeasured_one_have_no_balance(recordings: dict[str, Recording]) -> None:
    read = recordings["null"]
    fewer = replace(
        read, outputs=read.outputs[:, :2], mask=read.mask[:, :2], output_names=("h1", "h2"), output_units=("m", "m")
    )
    plant = replace(RIG.plant, sensors=RIG.plant.sensors[:2])
    assert not np.isfinite(equation_errors(plant, fewer).y).any(axis=0)[[0, 2]].any()
    assert len(with_unmeasured(RIG, 1 / 3, np.random.default_rng(0)).plant.sensors) == 2


def test_an_f_test_of_nothing_explained_is_no_evidence() -> None:
    # The tabled 5 % point of F(1, 10) is 4.9646.
    assert f_test(4.9646, 10.0, 1, 11) == pytest.approx(0.05, abs=1e-5)
    assert f_test(1.0, 1.0, 3, 3) == f_test(1.0, 0.0, 1, 10) == 1.0


@pytest.mark.parametrize("rival", [split_f_test, sparse_regression, gaussian_process])
def test_a_rig_without_a_gap_has_none(rival, recordings: dict[str, Recording]) -> None:  # type: ignore[no-untyped-def]
    assert rival(RIG.plant, recordings["null"], recordings["null"])["verdict"] == "no_gap"


@pytest.mark.parametrize("rival", [split_f_test, sparse_regression])
def test_a_weak_pump_is_named(rival, recordings: dict[str, Recording]) -> None:  # type: ignore[no-untyped-def]
    answer = rival(RIG.plant, recordings["gain"], recordings["gain"])
    assert {"effect": "pump_gain", "location": "Q1"} in answer["causes"]
    denied = rival(RIG.plant, recordings["gain"], recordings["gain"], leave_out=("pump_gain",))
    assert "pump_gain" not in {cause["effect"] for cause in denied["causes"]}


def test_a_flow_that_swings_is_placed(recordings: dict[str, Recording]) -> None:
    answer = gaussian_process(RIG.plant, recordings["flutter"], recordings["flutter"])
    assert answer["verdict"] == "unknown" and answer["causes"] == []
    assert answer["where"][0]["location"] in ("OUT2", "T2", "Q2")  # one balance
