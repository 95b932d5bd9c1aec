"""Starts of a candidate compete in a problem in which all parameters of the fit before follow linearly."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import effect
from fdi_torch.estimate.linearisation import Linearisation
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.diagnose import recalibrate
from fdi_torch.gap.problem import DEFAULT_SETTINGS, problem_of
from fdi_torch.gap.start_choice import Start, _Projected, likeliest_starts
from fdi_torch.plant.effect import Placement
from fdi_torch.simulate.collocation import Collocation
from tests.rigs import random_steps
from tests.test_gap_convergence import recorded

THREE_TANK = load_plant("three_tank")
ONSET, SIZE = "T1.leak.onset", "T1.leak.size"
LEAK = Placement(effect("leak"), "T1")


@pytest.fixture(scope="module")
def sound() -> tuple[Fitter, Fit]:
    """A recording with a leak from 250 s on, and the plant recalibrated to it."""
    truth = {SIZE: 0.3, ONSET: 250.0}
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), truth, seed=0)
    return recalibrate(problem_of(THREE_TANK, [recording], [], DEFAULT_SETTINGS).data)[:2]


def test_the_best_of_many_starts_is_found_by_one_descent_of_the_whole_problem(
    sound: tuple[Fitter, Fit], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Starts with an onset, and one without."""
    fitter, null = sound
    starts: tuple[dict[str, float], ...] = tuple({SIZE: 0.2, ONSET: t} for t in (50.0, 150.0, 240.0, 450.0))
    starts += ({SIZE: 0.2},)
    alone = [fitter.fit(Candidate((LEAK,), (start,)), null).cost for start in starts]
    lanes: list[int] = []
    linearise = Collocation.linearise

    def counted(self: Collocation, theta: Tensor, levels: Tensor) -> object:
        lanes.extend([len(theta)] if self.by == self.space.names else [])
        return linearise(self, theta, levels)

    monkeypatch.setattr(Collocation, "linearise", counted)
    together = fitter.fit(Candidate((LEAK,), starts), null)
    assert together.converged and set(lanes) == {1}
    assert together.cost < min(alone) + 0.5 < max(alone)
    assert together.values[ONSET] == pytest.approx(250.0, abs=5.0)


def test_a_start_with_other_values_of_the_shared_parameters_is_kept(sound: tuple[Fitter, Fit]) -> None:
    fitter, null = sound
    constant = null.space.names[0]
    starts = [Start((SIZE,), {SIZE: size}) for size in (0.1, 0.2)]
    apart = Start((SIZE,), {SIZE: 0.3, constant: 1.01 * null.values[constant]})
    engine = fitter.engine(Candidate((LEAK,)), [SIZE], [SIZE])
    found = likeliest_starts(fitter, null, engine, [*starts, apart], torch.inf)
    assert len(found) == 2 and found[1] is apart
    assert likeliest_starts(fitter, null, engine, [starts[0], apart], torch.inf) == [starts[0], apart]


def test_the_projected_chi_square_is_the_minimum_over_the_linear_parameters(sound: tuple[Fitter, Fit]) -> None:
    fitter, null = sound
    which = torch.arange(len(null.space))
    projected = _Projected.of(fitter, null, which)
    readings = null.linearised.readings + 1e-3 * torch.sin(torch.arange(len(fitter.data.mask)) / 30.0)[:, None]
    residual, jacobian = fitter.residual(readings), fitter.whiten(null.linearised.jacobian)[0]
    scale, weight, deviation = fitter.priors(null.space, null.theta)
    rows = torch.cat([(jacobian * scale).flatten(0, 1), torch.diag(weight)])
    target = torch.cat([residual.flatten(), -deviation])
    change = torch.linalg.lstsq(rows, target[:, None]).solution[:, 0]
    engine = fitter.engine(Candidate((LEAK,)), [SIZE], [SIZE])
    none = engine.space.__class__()
    chi_square = projected.chi_square(none, null.theta.new_zeros(1, 0), residual)
    assert chi_square.item() == pytest.approx(float((target - rows @ change).square().sum()), rel=1e-9)
    assert projected.change(residual).tolist() == pytest.approx(change.tolist(), rel=1e-6, abs=1e-6)


def test_the_reduced_gradient_is_that_of_the_reduced_chi_square(sound: tuple[Fitter, Fit]) -> None:
    fitter, null = sound
    engine = fitter.engine(Candidate((LEAK,)), [SIZE], [SIZE])
    projected = _Projected.of(fitter, null, torch.arange(len(null.space)))
    space = engine.space.__class__([engine.space[SIZE]])

    def model(size: float) -> Linearisation:
        full = engine.space.vector({**null.values, SIZE: size})[None]
        linearised = engine.linearise(full, null.linearised.levels)
        for _ in range(4):
            linearised = engine.linearise(full, linearised.levels)
        white, scale = projected.white(linearised), fitter.box(space)[2]
        cost, descent, curvature = projected.normal(space, torch.tensor([[size]]).double(), *white, scale)
        again = projected.chi_square(space, torch.tensor([[size]]).double(), projected.residual(linearised.readings))
        assert cost.item() == pytest.approx(again.item(), rel=1e-10)
        return Linearisation(0.5 * cost, -descent / scale, curvature / scale**2)

    step = 1e-5
    slope = (model(0.1 + step).cost - model(0.1 - step).cost) / (2.0 * step)
    assert model(0.1).gradient.item() == pytest.approx(slope.item(), rel=1e-4)
