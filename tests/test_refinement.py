"""Where only a combination of parameters is determined, the estimate is the equally good point nearest to nominal."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import fdi_torch
from fdi_torch.cli import DONE, main
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import Linearisation
from fdi_torch.estimate.refinement import nearest_to_nominal
from fdi_torch.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace(Parameter(name, "1", 0.0, -3.0, 0.95) for name in ("a", "b"))
LOW, HIGH = SPACE.low(), SPACE.high()


def product(theta: Tensor, lanes: Tensor) -> Linearisation:
    """exp(a) (1 - b), measured as 1.1 with an error of 0.001."""
    a, b = theta.unbind(-1)
    residual = (torch.exp(a) * (1.0 - b) - 1.1) / 1e-3
    slopes = torch.stack([torch.exp(a) * (1.0 - b), -torch.exp(a)], dim=-1) / 1e-3
    return Linearisation(0.5 * residual**2, slopes * residual[:, None], slopes[:, :, None] * slopes[:, None, :])


@pytest.mark.parametrize("b", [0.9, -2.5, 0.3])
def test_the_end_of_a_curved_valley_does_not_depend_on_its_start(b: float) -> None:
    problem: Any = SimpleNamespace(space=SPACE, linearise=product)
    start = torch.tensor([[1.1 / (1.0 - b), b]], dtype=torch.float64)
    start[:, 0].log_()
    there = levenberg_marquardt(product, start, LOW, HIGH)
    found = nearest_to_nominal(problem, there, LOW, HIGH, RefineSettings())
    assert found.cost.item() < 1e-2
    # ln(1.1) is shared by both, which are of equal influence at nominal.
    assert found.theta[0].tolist() == pytest.approx([0.5 * 0.0953, -0.5 * 0.0953], abs=0.02)
    uncertainty = certainty(found.curvature[0])
    assert float((uncertainty.null @ (found.theta[0] / uncertainty.scale)).abs().max()) < 0.04 / float(
        uncertainty.scale.min()
    )


def test_a_determined_optimum_stays() -> None:
    def both(theta: Tensor, lanes: Tensor) -> Linearisation:
        off = theta - torch.tensor([0.5, -0.5], dtype=torch.float64)
        one = torch.eye(2, dtype=torch.float64).expand(len(theta), 2, 2)
        return Linearisation(0.5 * off.square().sum(-1), off, one)

    there = levenberg_marquardt(both, torch.zeros(1, 2, dtype=torch.float64), LOW, HIGH)
    problem: Any = SimpleNamespace(space=SPACE, linearise=both)
    assert nearest_to_nominal(problem, there, LOW, HIGH, RefineSettings()) is there


RIG = """
tanks:
  T1: {area: 154 cm^2, height: 50 cm, start_level: 30 cm}
  T2: {area: 154 cm^2, height: 50 cm, start_level: 15 cm}
pipes:
  link: {source: T1, target: T2, area: 0.5 cm^2, discharge_coefficient: 0.6}
  out: {source: T2, target: outside, area: 0.55 cm^2, discharge_coefficient: 0.6}
pumps: {Q: {target: T1, max_flow: 100 cm^3/s}}
sensors: {h1: {tank: T1}, h2: {tank: T2}}
tolerances: {"*.discharge_coefficient": 3 %}
"""
SIMULATED = """
plant: rig.yaml
simulate:
  inputs: {Q: {steps: [[0 s, 33 cm^3/s], [150 s, 57 cm^3/s], [300 s, 23 cm^3/s], [450 s, 47 cm^3/s]]}}
  duration: 600 s
  faults: {T1.leak: 0.2, out.plugging: -0.033}
  noise: {std: {h1: 0.5 mm, h2: 0.5 mm}}
output: {name: recorded}
"""


def test_a_constant_within_its_tolerance_is_no_fault_of_a_pair_that_is_determined_jointly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A leak at the floor and a plugged drain are one thing. Next to the bound of both, the drain's coefficient has an
    eighth of its influence, and an error of one tolerance would pass for a fault at nine standard errors."""
    monkeypatch.chdir(tmp_path)
    Path("rig.yaml").write_text(RIG)
    Path("simulated.yaml").write_text(SIMULATED)
    assert main(["simulate", "--config", "simulated.yaml", "--out", ".", "--quiet"]) == DONE
    suspects = ["T1.leak", "T2.leak", "link.plugging", "out.plugging"]
    run = {"plant": "rig.yaml", "recordings": [{"file": "recorded.csv"}], "estimate": {"parameters": suspects}}
    done = fdi_torch.train({**run, "output": {"folder": str(tmp_path)}})
    estimate = done.result.estimate
    value, (combination,) = dict(zip(estimate.names, estimate.value.tolist(), strict=True)), estimate.combinations
    # Both have the same influence, so that each takes half of the deviation.
    assert value["T2.leak.size"] == pytest.approx(-value["out.plugging.size"], abs=0.01)
    assert combination.std > 0.02 and abs(combination.value) < 3.0 * combination.std
    assert done.result.diagnosis.statement == "single fault: leak at T1"


def test_a_constant_far_outside_its_tolerance_is_estimated_there(tmp_path: Path) -> None:
    """An outlet 21 % below the plant file, seven standard deviations of its tolerance: the readings deny the prior."""
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "run.yaml").write_text(SIMULATED.replace("out.plugging: -0.033", "out.discharge_coefficient: 0.474"))
    recording = fdi_torch.simulate(fdi_torch.load_run(tmp_path / "run.yaml"))
    found = fdi_torch.train(tmp_path / "rig.yaml", recording, ["T1.leak"], output={"folder": str(tmp_path)}).estimate
    for name, truth in (("out.discharge_coefficient", 0.474), ("T1.leak.size", 0.2)):
        k = found.names.index(name)
        assert abs(float(found.value[k]) - truth) < 3.5 * float(found.std[k])
