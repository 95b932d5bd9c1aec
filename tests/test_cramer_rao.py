"""Standard errors at the true noise level against the bound, computed independently by central differences."""

from __future__ import annotations

import pytest
import torch
from rigs import PAPER_PARAMETERS, REST, constant_inputs, paper_network, three_tank

from fdi_torch.estimate.fitting import set_up
from fdi_torch.estimate.refinement import information_std
from fdi_torch.simulate.engine_choice import make_engine
from fdi_torch.simulate.experiment import lay_out

STEP = 0.05
# Standard deviations in 1e-6 at an SNR of 50 dB against the variance, 1001 samples, start levels known.
BOUNDS = {
    (0.3, 0.3, 0.5, 0.6, 1.0): (203, 174, 268, 539, 744),
    (0.1, 1.0, 0.0, 1.0, 1.0): (1001, 479, 1195, 2707, 1047),
    (0.1, 0.6, 0.0, 1.0, 1.0): (266, 351, 474, 1040, 1470),
    (0.1, 0.6, 0.5, 1.0, 1.0): (1276, 444, 1523, 2919, 1810),
    (0.1, 0.6, 0.5, 0.7, 1.0): (374, 622, 785, 666, 2277),
    (0.1, 0.6, 0.5, 0.7, 0.9): (371, 516, 701, 661, 1914),
}


@pytest.mark.parametrize("fault", BOUNDS)
def test_standard_errors_are_at_the_bound(fault: tuple[float, ...]) -> None:
    plant = three_tank(REST)
    network, space = paper_network(plant)
    recording = constant_inputs(plant, 1000.0)
    theta = torch.tensor([fault], dtype=torch.float64)
    clean = make_engine(network, space, lay_out(recording, plant.channels(), STEP)).readings(theta)[0]
    noise = clean.std(dim=0, correction=0) * 10.0 ** (-50.0 / 20.0)
    recording.outputs.copy_(clean)
    recording.mask.fill_(True)
    fitting = set_up(plant, [recording], PAPER_PARAMETERS, "equilibrium")
    std = 1e6 * information_std(fitting.problem(STEP).at_noise([noise]), theta)
    # The printed bounds are whole numbers, converged to half a per cent.
    assert torch.allclose(std, torch.tensor(BOUNDS[fault], dtype=torch.float64), rtol=0.01, atol=0.5)
