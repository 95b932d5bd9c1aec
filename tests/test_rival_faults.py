"""Suspected faults of which one is certain, although the readings do not tell which."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

import fdi_torch
from fdi_torch.cli.screen import Screen
from fdi_torch.cli.train import as_json, show
from fdi_torch.jobs.train import TrainResult
from fdi_torch.report.material import gather
from fdi_torch.report.page import page, report_of
from fdi_torch.report.verdict import headline

BENCH: dict[str, Any] = {
    "name": "bench",
    "tanks": {"A": {"area": "200 cm^2", "height": "60 cm"}, "B": {"area": "200 cm^2", "height": "60 cm"}},
    "pipes": {
        "link": {"source": "A", "target": "B", "area": "0.6 cm^2", "discharge_coefficient": 0.6},
        "drain": {"source": "B", "target": "outside", "area": "0.5 cm^2", "discharge_coefficient": 0.6},
    },
    "pumps": {"Q": {"target": "A", "max_flow": "6 l/min"}},
    "sensors": {"hA": {"tank": "A"}, "hB": {"tank": "B"}},
    "tolerances": {"*.discharge_coefficient": "3 %"},
}
FINE = {"xatol": 1e-4, "fatol": 1e-6, "maxiter": 4000, "maxfev": 4000}
SUSPECTED = ("A.leak", "B.leak", "link.plugging")


def trained(folder: Path, seed: int, leak: float, samples: int = 30) -> TrainResult:
    """The fit of three suspected faults to a short record from rest, which separates them badly."""
    simulated = {
        "inputs": {"Q": "3 l/min"},
        "duration": f"{samples - 1} s",
        "sample_time": "1 s",
        "faults": {"A.leak": leak},
        "noise": {"std": {"hA": "1 mm", "hB": "1 mm"}},
    }
    keys = {"parameters": [*SUSPECTED], "calibrate": ["*.discharge_coefficient"]}
    job = {"plant": BENCH, "simulate": simulated, "estimate": keys, "seed": seed, "output": {"folder": str(folder)}}
    return fdi_torch.train(job)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_leak_that_collinear_faults_hide_is_no_absence_of_faults(tmp_path: Path, seed: int) -> None:
    """Each of the three may be nominal if the others are not, but not all at once."""
    diagnosis = trained(tmp_path, seed, 0.2).result.diagnosis
    assert not diagnosis.present and diagnosis.kind == "fault not isolated"
    rivals = diagnosis.rivals
    assert rivals is not None and "A.leak.size" in rivals.names and rivals.probability > 0.999
    first = rivals.explanations[0]
    assert first.names == ("A.leak.size",) and first.probability > 0.5
    assert first.value[0] == pytest.approx(0.2, abs=3.5 * first.std[0]) and first.std[0] < 0.04
    assert [each.names for each in rivals.explanations[1:]] == [("B.leak.size", "link.plugging.size")]
    assert sum(each.probability for each in rivals.explanations) == pytest.approx(1.0, abs=0.02)


def test_the_statistic_is_the_rise_of_the_misfit_without_the_faults(tmp_path: Path) -> None:
    """Of a fit of the constants alone to the same readings, its noise being that of the fit with the faults."""
    done = trained(tmp_path, 1, 0.2)
    rivals, likelihood, space = done.result.diagnosis.rivals, done.result.likelihood, done.fitting.space
    assert rivals is not None and {*rivals.names} == {f"{name}.size" for name in SUSPECTED}

    def cost(faultless: np.ndarray) -> float:
        theta = torch.cat([torch.zeros(3, dtype=torch.float64), torch.from_numpy(faultless)])
        return float(likelihood.cost(theta[None, None], torch.zeros(1, dtype=torch.int64)))

    scale = done.result.estimate.std[3:].numpy()
    start = space.nominal()[3:].numpy()
    best = minimize(lambda x: cost(start + scale * x), np.zeros(len(start)), method="Nelder-Mead", options=FINE)
    assert best.success
    full = float(likelihood.cost(done.result.estimate.value[None, None], torch.zeros(1, dtype=torch.int64)))
    assert rivals.chi_square == pytest.approx(2.0 * (best.fun - full), rel=1e-3)


def test_terminal_page_log_and_json_name_the_rivals_in_the_same_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = trained(tmp_path, 1, 0.2)
    rivals = done.result.diagnosis.rivals
    assert rivals is not None
    assert done.headline == f"fault not isolated: {rivals.sized_rivals}"
    show(done, Screen())
    text = capsys.readouterr().out
    assert f"fault not isolated: {rivals.rivals}\n" in text and "no suspected fault" not in text
    assert all(f"- {sentence}\n" in text for sentence in rivals.sentences)
    material = gather(fdi_torch.read_run(done.log), None)
    assert headline(material) == done.headline[:1].upper() + done.headline[1:]
    html = page([report_of(material)])
    assert html.count("not isolated</span>") == len(rivals.names)
    diagnosis = as_json(done)["diagnosis"]
    assert isinstance(diagnosis, dict) and diagnosis["rivals"] == rivals and diagnosis["kind"] == "fault not isolated"


@pytest.mark.parametrize("seed", range(1, 6))
def test_without_a_fault_none_is_claimed(tmp_path: Path, seed: int) -> None:
    assert trained(tmp_path, seed, 0.0).result.diagnosis.kind == "no fault"
