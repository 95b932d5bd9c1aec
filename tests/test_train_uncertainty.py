"""Profiles and draws that a run file asks for, in the result, the log and ArviZ."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import fdi_torch
from fdi_torch import load_plant
from fdi_torch.cli.screen import Screen
from fdi_torch.cli.train import show
from fdi_torch.config.problems import ConfigError
from fdi_torch.logbook.signals import arrays
from fdi_torch.report.material import gather
from fdi_torch.report.page import page, report_of
from fdi_torch.report.verdict import headline

SIMULATED = {
    "inputs": {"Q1": "50 cm^3/s", "Q2": "50 cm^3/s"},
    "duration": "300 s",
    "sample_time": "3 s",
    "faults": {"T1.leak": 0.3, "P13.openness": 1.0},
    "noise": {"snr_db": 30, "definition": "variance"},
}


def run(folder: Path, **estimate: object) -> dict[str, object]:
    keys = {"parameters": ["T1.leak", "P13.openness"], **estimate}
    return {"plant": "three_tank", "simulate": SIMULATED, "estimate": keys, "output": {"folder": str(folder)}}


def test_profiles_and_draws_of_a_run_agree_with_its_standard_errors(tmp_path: Path) -> None:
    pytest.importorskip("emcee")
    done = fdi_torch.train(run(tmp_path, profile=["T1.leak"], draws=200, step={"refine": "1 s"}))
    estimate, draws = done.result.estimate, done.result.estimate.draws
    low, high = (float(limit[0]) for limit in estimate.interval())
    profile = done.profiles[0]
    std = float(estimate.std[0])
    assert profile.name == "T1.leak.size" and not profile.warnings
    # The leak is well determined, so that the likelihood is nearly normal.
    assert (profile.low, profile.high) == pytest.approx((low, high), abs=0.1 * std)
    assert draws is not None and draws.converged and draws.values.shape[-1] == 2
    assert float(draws.values[..., 0].std()) == pytest.approx(std, rel=0.25)
    assert float(draws.values[..., 1].max()) <= 1.0
    tree = done.to_arviz()
    labelled = draws.to_xarray()
    assert labelled.sizes == {"chain": draws.values.shape[0], "draw": draws.values.shape[1]}
    assert labelled["T1.leak.size"].values.mean() == pytest.approx(float(draws.values[..., 0].mean()), rel=1e-12)
    assert tree["posterior"]["T1.leak.size"].shape == draws.values.shape[:2]
    assert tree["observed_data"]["h1"].shape == (101,)
    total = sum(tree["log_likelihood"][name].sum(f"{name}_sample") for name in ("h1", "h2", "h3"))
    difference = torch.from_numpy(total.values) - draws.log_posterior
    # The same up to a constant, since the priors are flat.
    assert float(difference.max() - difference.min()) < 1e-6
    assert arrays(fdi_torch.read_run(done.log))["draws"].shape == tuple(draws.values.shape)


def test_a_name_that_is_not_estimated_cannot_be_profiled(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"estimate\.profile: expected an estimated parameter"):
        fdi_torch.train(run(tmp_path, profile=["T3.leak"]))


def test_an_estimate_without_draws_says_how_to_get_them(tmp_path: Path) -> None:
    done = fdi_torch.train(run(tmp_path))
    with pytest.raises(ValueError, match=r"estimate\.draws"):
        done.result.estimate.to_arviz()
    assert done.profile("P13.openness.size")[0].ends == ("high",)


def test_cma_es_in_a_run_file_finds_the_same_estimate(tmp_path: Path) -> None:
    shade, cma = (fdi_torch.train(run(tmp_path, search={"strategy": s})).result for s in ("l-shade", "cma_es"))
    assert cma.search.evaluations < shade.search.evaluations
    torch.testing.assert_close(
        cma.estimate.value, shade.estimate.value, rtol=0, atol=1e-2 * float(shade.estimate.std.min())
    )


def test_faults_that_are_not_isolated_are_present_in_their_combination(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A leak of T2 and a plugging of its outlet act through the same sqrt(2 g h): only their difference is seen."""
    simulated = SIMULATED | {"faults": {"T2.leak": 0.2}, "noise": {"std": {f"h{k}": "1 mm" for k in (1, 2, 3)}}}
    estimated = {"parameters": ["T1.leak", "T2.leak", "OUT2.plugging"]}
    done = fdi_torch.train(run(tmp_path, **estimated) | {"simulate": simulated})
    (combination,) = done.result.estimate.combinations
    assert combination.parameters == ("T2.leak.size", "OUT2.plugging.size")
    assert combination.coefficients == pytest.approx((1.0, -1.0), abs=1e-5)
    assert combination.value == pytest.approx(0.2, abs=3.0 * combination.std) and combination.std < 0.05
    assert done.result.diagnosis.not_isolated == (combination,)
    assert done.headline.startswith("fault not isolated: leak at T2 or plugging at OUT2 (T2.leak.size - OUT2.plug")
    material = gather(fdi_torch.read_run(done.log), load_plant("three_tank"))
    assert headline(material).startswith("Fault not isolated: leak at T2 or plugging at OUT2 (T2.leak.size - OUT2.plug")
    html = page([report_of(material)])
    assert html.count("not isolated</span>") == 2 and "not determined" in html
    show(done, Screen())
    rows = capsys.readouterr().out
    assert " inf" not in rows and f"\n{combination.formula} " in rows
