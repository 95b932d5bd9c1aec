"""White and correlated residuals, and what a fit concludes from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torch import Tensor

import fdi_torch
from fdi_torch import cli
from fdi_torch.cli.explained import exit_code
from fdi_torch.estimate.misfit import LEAST_SHARE
from fdi_torch.estimate.whiteness import correlated_share, correlation_inflation, ljung_box
from fdi_torch.jobs.train import TrainResult
from fdi_torch.report.material import gather
from fdi_torch.report.verdict import headline
from tests.test_rival_faults import BENCH, SUSPECTED

RECORDED = BENCH | {"tolerances": {"*.discharge_coefficient": "10 %", "Q.gain": "5 %"}}
STEPS = {0: 2.4, 240: 3.6, 600: 2.1, 900: 3.3, 1200: 1.8, 1500: 3.7, 1800: 2.7}  # s: l/min


def noise(samples: int, channels: int, correlation: float, seed: int) -> Tensor:
    """A stationary AR(1) process of unit variance, (samples, channels)."""
    white = np.random.default_rng(seed).standard_normal((samples, channels))
    process = white.copy()
    for k in range(1, samples):
        process[k] = correlation * process[k - 1] + np.sqrt(1.0 - correlation**2) * white[k]
    return torch.from_numpy(process)


@pytest.mark.parametrize("samples", [60, 1000])
@pytest.mark.parametrize("share", [1.0, 0.8])
def test_white_residuals_are_seldom_called_correlated(samples: int, share: float) -> None:
    """share: of the residuals that are not masked. The statistic has heavier tails than chi-square in short records."""
    white = noise(samples, 10_000, 0.0, seed=1)
    mask = torch.rand(white.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64) < share
    p = ljung_box(white, mask.to(white))
    assert float((p < 0.05).double().mean()) == pytest.approx(0.05, abs=0.01)
    assert float((p < 0.001).double().mean()) < 0.004


def test_correlated_residuals_are_not_white_and_their_share_is_that_of_the_slow_part() -> None:
    mixed = np.sqrt(0.7) * noise(1000, 50, 0.0, seed=3) + np.sqrt(0.3) * noise(1000, 50, 0.98, seed=4)
    weight = torch.ones_like(mixed)
    assert float(ljung_box(mixed, weight).max()) < 1e-6
    assert float(correlated_share(mixed, weight).mean()) == pytest.approx(0.3, abs=0.05)


@pytest.mark.parametrize(("slow", "correlation"), [(1.0, 0.6), (0.36, 0.95)])
def test_the_inflation_is_the_spectrum_at_frequency_zero(slow: float, correlation: float) -> None:
    """Of an AR(1) process of the variance `slow` beside white noise; its integrated time is (1 + a) / (1 - a)."""
    white, process = noise(4000, 40, 0.0, seed=5), noise(4000, 40, correlation, seed=6)
    mixed = np.sqrt(1.0 - slow) * white + np.sqrt(slow) * process
    weight, flags = torch.ones_like(mixed), torch.ones(40, dtype=torch.bool)
    expected = 1.0 - slow + slow * (1.0 + correlation) / (1.0 - correlation)
    assert float(correlation_inflation(mixed, weight, flags).median()) == pytest.approx(expected, rel=0.15)
    assert correlation_inflation(white, weight, ~flags).median() == 1.0


def fitted(here: Path, area: str, tolerances: dict[str, str], leak: float = 0.0) -> TrainResult:
    """The fit of three suspected faults to a record of a rig whose tank B has another area than the plant file says."""
    rig = RECORDED | {"tanks": RECORDED["tanks"] | {"B": {"area": area, "height": "60 cm"}}}
    simulated = {
        "inputs": {"Q": {"steps": [[f"{time} s", f"{flow} l/min"] for time, flow in STEPS.items()]}},
        "duration": "2100 s",
        "sample_time": "2 s",
        "faults": {"A.leak": leak},
        "noise": {"std": {"hA": "0.7 mm", "hB": "0.7 mm"}},
    }
    Path("record.yaml").write_text(yaml.safe_dump({"plant": rig, "simulate": simulated, "output": {"name": "run"}}))
    assert cli.main(["simulate", "--config", "record.yaml", "--out", ".", "--quiet"]) == cli.DONE
    nominal = RECORDED | {"tolerances": RECORDED["tolerances"] | tolerances}
    keys = {"parameters": [*SUSPECTED]}
    job = {"plant": nominal, "recordings": [{"file": "run.csv"}], "estimate": keys, "output": {"folder": str(here)}}
    return fdi_torch.train(job)


def test_a_wrong_area_of_a_tank_is_no_established_leak(here: Path) -> None:
    """It is 11 % too small in the plant file: a leak explains most of the misfit, and the rest is correlated."""
    done = fitted(here, "225 cm^2", {})
    diagnosis = done.result.diagnosis
    assert diagnosis.misfit.ratio < diagnosis.misfit.limit  # the size of the residuals alone is no evidence
    assert diagnosis.claims and 0.5 < diagnosis.misfit.share < LEAST_SHARE
    assert diagnosis.kind == "not established" and exit_code(diagnosis.misfit) == cli.NOT_EXPLAINED
    assert "(residuals are correlated in time, the faults explain" in done.headline
    material = gather(fdi_torch.read_run(done.log), done.fitting.plant)
    assert headline(material).startswith(diagnosis.misfit.warning)
    assert "A.area and B.area" in done.exact_constants and "discharge" not in done.exact_constants


def test_a_tolerance_of_the_area_explains_the_recording(here: Path) -> None:
    done = fitted(here, "225 cm^2", {"B.area": "10 %"})
    assert done.result.diagnosis.kind == "no fault" and not done.result.diagnosis.misfit.correlated
    assert done.exact_constants.count("area") == 2  # A.area, and the example


def test_a_leak_that_explains_nearly_all_stands_beside_a_small_error_of_the_plant(here: Path) -> None:
    done = fitted(here, "214 cm^2", {}, leak=0.2)
    diagnosis = done.result.diagnosis
    assert [f.name for f in diagnosis.present] == ["A.leak.size"] and diagnosis.misfit.explained
    assert diagnosis.misfit.share > LEAST_SHARE
