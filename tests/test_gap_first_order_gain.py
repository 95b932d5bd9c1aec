"""First-order gains of single regressors, against the regression on all of their columns."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.estimate.linear_parameters import without
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.diagnose import Settings, recalibrate
from fdi_torch.gap.localization import single_regressor_gain as promise
from fdi_torch.gap.localization.discrepancy_regression import DiscrepancyRegression
from fdi_torch.gap.localization.fine_positions import HALVINGS, around, best_parameters
from fdi_torch.gap.localization.predicted_levels import LevelFilter
from fdi_torch.gap.localization.regressor_families import Breakpoints, Pulses, Relays
from fdi_torch.gap.localization.regressors import relay_thresholds
from fdi_torch.gap.marginal_likelihood import with_estimated_noise
from fdi_torch.gap.problem import problem_of
from fdi_torch.plant.effect import Placement
from tests.test_gap import nominal_plant, recorded

PLACES = ("Q1", "T1", "P13", "OUT2", "T1-T3", "h2")


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "with a lag of a sensor"])
def surveyed(request: pytest.FixtureRequest) -> tuple[DiscrepancyRegression, Fitter, Fit]:
    case = problem_of(nominal_plant(), (recorded({"Q1.pump_lag.time_constant": 8.0}, seed=3),), (), Settings())
    fitter, null, _ = recalibrate(case.data)
    under, _ = with_estimated_noise(fitter, null)
    if request.param:
        lag = Candidate((Placement(effect("sensor_lag"), "h2"),), ({"h2.sensor_lag.time_constant": 3.0},))
        null = under.fit(lag, null)
    return DiscrepancyRegression(under, null, (1.0 / 60.0,), level_filter(under)), under, null


def level_filter(under: Fitter) -> LevelFilter:
    """The filter of a fitter."""
    assert under.whitening is not None
    return LevelFilter(under.whitening.noise)


def gain_at(survey: DiscrepancyRegression, under: Fitter, null: Fit, place: str) -> float:
    (gain,) = promise.SingleRegressorGains(survey, [under], torch.Generator().manual_seed(5)).at(place)
    return gain.net


def products(
    surveyed: tuple[DiscrepancyRegression, Fitter, Fit], place: str, monkeypatch: pytest.MonkeyPatch
) -> tuple[Tensor, Tensor]:
    """Scores and strengths."""
    survey, under, null = surveyed
    found: list[tuple[Tensor, Tensor]] = []
    monkeypatch.setattr(promise, "gains_of", lambda *p: found.append(p) or p[0])
    gain_at(survey, under, null, place)
    return found[0]


@pytest.mark.parametrize("place", PLACES)
def test_products_are_those_of_the_columns(
    place: str, surveyed: tuple[DiscrepancyRegression, Fitter, Fit], monkeypatch: pytest.MonkeyPatch
) -> None:
    survey, under, null = surveyed
    own = survey.of(place)
    scale, pull, off = under.priors(null.space, null.theta)
    rows = torch.cat([(under.white(own.linearised)[1][0] * scale).flatten(0, 1), torch.diag(pull + 1e-9)])
    basis = torch.linalg.qr(rows)[0]
    residual = torch.cat([under.white(own.linearised)[0][0].flatten(), -off])
    columns = under.whiten(own.columns[torch.ones(len(own.columns), dtype=torch.bool)]).flatten(0, 1)
    columns = torch.cat([columns, columns.new_zeros(len(pull), columns.shape[1])])
    columns -= basis @ (basis.T @ columns)
    scores, strengths = products(surveyed, place, monkeypatch)
    size = torch.linalg.vector_norm(columns, dim=0)
    score = (columns.T @ (residual - basis @ (basis.T @ residual))) / size
    live = size > 1e-3 * size.max()
    torch.testing.assert_close((scores / size)[live], score[live], rtol=1e-6, atol=1e-6 * float(score.abs().max()))
    # The root of a mean of squares of N signs has a standard deviation of 1 / sqrt(2 N) of itself.
    share = strengths.sqrt()[live] / size[live]
    assert float((share - 1.0).abs().max()) < 6.0 / (2.0 * promise.SIGNS) ** 0.5
    assert float(share.mean()) == pytest.approx(1.0, abs=0.15)


def test_the_place_of_the_cause_has_the_largest_first_order_gain(
    surveyed: tuple[DiscrepancyRegression, Fitter, Fit],
) -> None:
    survey, under, null = surveyed
    assert max(PLACES, key=lambda place: gain_at(survey, under, null, place)) == "Q1"


def test_random_flows_that_the_parameters_cannot_explain_promise_nothing_at_a_sound_pipe() -> None:
    """Levels that are predicted from earlier readings are then far from those of a free run, and so are the slopes by
    the constants."""
    recording = recorded({}, seed=3)
    assert recording.inputs is not None
    generator = torch.Generator().manual_seed(8)
    held = torch.randn(len(recording.inputs) // 40 + 1, 2, generator=generator, dtype=torch.float64)
    moved = recording.inputs + 1.5e-5 * held.repeat_interleave(40, dim=0)[: len(recording.inputs)]
    real = replace(recorded({}, seed=3, inputs=moved), inputs=recording.inputs)
    case = problem_of(nominal_plant(), (real,), (), Settings())
    fitter, null, _ = recalibrate(case.data)
    under, _ = with_estimated_noise(fitter, null)
    survey = DiscrepancyRegression(under, null, (), level_filter(under))
    assert max(gain_at(survey, under, null, place) for place in ("P13", "P32", "OUT2")) < 10.0


def test_a_step_between_two_nodes_is_expected_to_gain_what_it_does() -> None:
    """A jump of a sensor, which random flows into its tank explain except for a few samples: the grid misses those."""
    recording = recorded({}, seed=3)
    readings = recording.outputs.clone()
    readings[404:, 2] -= 0.0065
    case = problem_of(nominal_plant(), (replace(recording, outputs=readings),), (), Settings())
    fitter, null, _ = recalibrate(case.data)
    under, _ = with_estimated_noise(fitter, null)
    survey = DiscrepancyRegression(under, null, (), level_filter(under))
    step = torch.zeros_like(readings)
    step[404:, 2] = 1.0
    basis = promise.parameter_basis(under, null, survey.at("h3")[1])
    white = without(basis, under.whiten(step.unsqueeze(-1)).flatten(0, 1))
    score = white.T @ without(basis, promise.whitened_residual(under, null, survey.at("h3")[1]))
    gain = 0.5 * float(score.square() / white.square().sum())
    assert gain_at(survey, under, null, "h3") == pytest.approx(gain, rel=0.3)


@pytest.mark.parametrize("jump", [False, True])
def test_products_of_all_breakpoints_are_those_of_each_function(jump: bool) -> None:
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(50, generator=generator, dtype=torch.float64)
    x[10:20] = x[3]  # a signal that stands still at a breakpoint
    factor, weights = (torch.randn(n, 50, generator=generator, dtype=torch.float64) for n in (1, 3))
    at = torch.cat([x[:5], torch.linspace(-3.0, 3.0, 20, dtype=torch.float64)])
    family = Breakpoints(x, factor[0], at, jump)
    functions = torch.stack([(x >= c) * factor[0] if jump else (x - c).clamp(min=0.0) * factor[0] for c in at])
    torch.testing.assert_close(family.products(weights), functions @ weights.T)
    torch.testing.assert_close(torch.stack([family.function(i) for i in range(len(at))]), functions)


def test_products_of_relays_are_those_of_each_function() -> None:
    generator = torch.Generator().manual_seed(2)
    x, factor = (torch.randn(60, generator=generator, dtype=torch.float64) for _ in range(2))
    weights = torch.randn(3, 60, generator=generator, dtype=torch.float64)
    family = Relays(x, factor, relay_thresholds((-1.0, 1.0), 5))
    functions = torch.stack([family.function(i) for i in range(len(family.thresholds))])
    torch.testing.assert_close(family.products(weights), functions @ weights.T)
    torch.testing.assert_close(family.functions_at(family.thresholds), functions)


def test_products_of_pulses_are_those_of_each_function() -> None:
    generator = torch.Generator().manual_seed(2)
    time = 100.0 * torch.rand(60, generator=generator, dtype=torch.float64).sort().values
    factor, weights = (torch.randn(n, 60, generator=generator, dtype=torch.float64) for n in (1, 3))
    family = Pulses(time, factor[0], torch.tensor([0.03, 0.11], dtype=torch.float64))
    functions = torch.stack([family.function(i) for i in range(len(family))])
    torch.testing.assert_close(family.products(weights), functions @ weights.T)
    one = family.functions_at(torch.tensor([[0.05, 0.25, 0.5]], dtype=torch.float64))[0]
    assert one.equal(torch.where((time % 20.0 >= 5.0) & (time % 20.0 < 15.0), factor[0], 0.0))
    assert family.products(weights).shape == (len(family), 3)
    assert Pulses(time, factor[0], time[:0]).products(weights).shape == (0, 3)


def test_parameters_are_moved_to_the_largest_gain_and_not_along_a_plateau() -> None:
    start, peak = torch.tensor([0.2, 0.5], dtype=torch.float64), torch.tensor([0.51, 0.94], dtype=torch.float64)
    spacing = torch.tensor([0.1, 0.2], dtype=torch.float64)

    def anything(tried: Tensor) -> Tensor:
        return tried[:, 0] > -torch.inf

    found = best_parameters(lambda tried: -1e5 * (tried - peak).square().sum(dim=1), start, spacing, anything)
    assert ((found - peak).abs() <= spacing / 2.0**HALVINGS).all()
    assert best_parameters(lambda tried: tried.new_ones(len(tried)), start, spacing, anything).equal(start)
    below = best_parameters(lambda tried: 1e4 * tried[:, 1], start, spacing, lambda tried: tried[:, 1] < 0.95)
    assert 0.93 < float(below[1]) < 0.95
    relays = Relays(start, start, relay_thresholds((-1.0, 1.0), 5))
    tried = around(torch.tensor([-0.8, -0.4], dtype=torch.float64), torch.full((2,), 0.5, dtype=torch.float64))
    assert len(tried) == 9 and relays.possible(tried).sum() == 6
