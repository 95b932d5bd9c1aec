"""Accuracy of the results: simulated levels over the whole range of faults, and noise-free estimates of the paper's
faults.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rigs import constant_inputs, paper_network, three_tank

from fdi_torch.config.run_file import load_run
from fdi_torch.jobs.train import train
from fdi_torch.simulate.engine_choice import make_engine
from fdi_torch.simulate.experiment import lay_out

CONFIGS = Path(__file__).parent.parent / "configs" / "paper"
REPORTED_STEP, FINE_STEP = 0.1, 0.01


@pytest.mark.slow
def test_worst_error_over_a_thousand_random_faults_is_below_ten_micrometres() -> None:
    plant = three_tank()
    network, space = paper_network(plant)
    recording = constant_inputs(plant, 1000.0)
    generator = torch.Generator().manual_seed(0)
    theta = torch.rand(1000, 5, generator=generator, dtype=torch.float64)
    theta[:, 1] = 2.0 * theta[:, 1] - 1.0
    coarse, fine = (
        make_engine(network, space, lay_out(recording, plant.channels(), step)).readings(theta)
        for step in (REPORTED_STEP, FINE_STEP)
    )
    assert float((coarse - fine).abs().max()) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", [f"table2_{k}d" for k in range(1, 6)])
def test_noise_free_faults_are_found_to_a_millionth(name: str, tmp_path: Path) -> None:
    done = train(load_run(CONFIGS / f"{name}.yaml", [f"output.folder={tmp_path}"]))
    truth = torch.tensor([done.truth[p.name] for p in done.fitting.space], dtype=torch.float64)
    assert float((done.result.estimate.value - truth).abs().max()) < 1e-6
    assert done.result.estimate.status == "converged"
    assert float(done.result.correlation.sum()) == pytest.approx(3.0, abs=1e-9)


@pytest.mark.parametrize("snr", [10, 50])
def test_noisy_faults_are_found_within_four_standard_errors(snr: int, tmp_path: Path) -> None:
    done = train(load_run(CONFIGS / f"table3_snr{snr}.yaml", [f"output.folder={tmp_path}"]))
    truth = torch.tensor([done.truth[p.name] for p in done.fitting.space], dtype=torch.float64)
    assert bool(((done.result.estimate.value - truth).abs() < 4.0 * done.result.estimate.std).all())
