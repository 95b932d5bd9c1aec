"""Hypotheses with a discrepancy: without effects that they do not need, and with parameters that fit beside it."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import pytest
import torch

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import effect
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.cause_hypothesis import CauseHypothesis, causes_in_order
from fdi_torch.gap.diagnose import recalibrate
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.hypothesis_weights import HypothesisWeights
from fdi_torch.gap.localization.localized_discrepancy import Estimate, LocalizedDiscrepancy
from fdi_torch.gap.marginal_likelihood import log_evidence, log_prior, occam
from fdi_torch.gap.problem import DEFAULT_SETTINGS, problem_of
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.screening import options_of
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of
from tests.rigs import random_steps
from tests.test_gap_convergence import recorded

THREE_TANK = load_plant("three_tank")
GAIN, BIAS = Placement(effect("sensor_gain"), "h1"), Placement(effect("sensor_bias"), "h3")
CHOICES = 60


def hypothesis_of(fitter: Fitter, fit: Fit) -> CauseHypothesis:
    """A fit beside a discrepancy at a pipe that explains nothing."""
    nothing = fitter.data.readings.new_zeros(*fitter.data.readings.shape, 0)
    estimate = Estimate.beside(fitter, fit, fit.linearised, nothing, nothing.new_zeros(0))
    discrepancy = SimpleNamespace(location="P13", fit=fit, estimate=estimate)
    evidence = log_evidence(fitter, fit, CHOICES)
    explanation = SimpleNamespace(fit=fit, key=fit.key, log_evidence=evidence)
    return CauseHypothesis(
        cast(RankedExplanation, explanation),
        causes_in_order(fit),
        evidence,
        cast(LocalizedDiscrepancy, discrepancy),
    )


@pytest.fixture(scope="module")
def sound() -> tuple[Fitter, Fit]:
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), {}, seed=0)
    return recalibrate(problem_of(THREE_TANK, [recording], [], DEFAULT_SETTINGS).data)[:2]


def test_the_density_ratio_at_zero_is_the_ratio_of_evidences(sound: tuple[Fitter, Fit]) -> None:
    """Effects of no size on a sound rig, each alone, and both."""
    fitter, null = sound
    both = fitter.fit(Candidate((GAIN, BIAS), ({"h1.sensor_gain.factor": 1.01, "h3.sensor_bias.bias": 1e-3},)), null)
    pool = cast(ExplanationPool, SimpleNamespace(fitter=fitter, choices=CHOICES))
    h = hypothesis_of(fitter, both)
    fewer = {r.causes: r.weight for r in HypothesisWeights(pool, (), 1).without_small_effects(h)}
    for placements in [(GAIN,), (BIAS,), ()]:
        start = {k: v for k, v in both.effect_values.items() if any(k.startswith(p.prefix) for p in placements)}
        fit = fitter.fit(Candidate(placements, (start,)), null)
        expected = log_evidence(fitter, fit, CHOICES)
        assert fewer[causes_in_order(fit)] == pytest.approx(expected, abs=0.2)
        assert expected > h.weight + 3.0


def test_sizes_of_which_only_the_sum_is_known_cannot_both_be_zero() -> None:
    """A gain and a bias of one sensor: either alone may be nothing, both together are not."""
    offset = Placement(effect("sensor_bias"), "h1")
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), {"h1.sensor_gain.factor": 1.005}, seed=0)
    fitter, null, _ = recalibrate(problem_of(THREE_TANK, [recording], [], DEFAULT_SETTINGS).data)
    start = {"h1.sensor_gain.factor": 1.005, "h1.sensor_bias.bias": 1e-3}
    both = fitter.fit(Candidate((GAIN, offset), (start,)), null)
    pool = cast(ExplanationPool, SimpleNamespace(fitter=fitter, choices=CHOICES))
    fewer = {
        r.causes: r.weight for r in HypothesisWeights(pool, (), 1).without_small_effects(hypothesis_of(fitter, both))
    }
    for placements in [(GAIN,), (offset,), ()]:
        values = {k: v for k, v in start.items() if any(k.startswith(p.prefix) for p in placements)}
        fit = fitter.fit(Candidate(placements, (values,)), null)
        assert fewer[causes_in_order(fit)] == pytest.approx(log_evidence(fitter, fit, CHOICES), abs=0.5)


def test_parameters_of_which_the_readings_show_nothing_cost_nothing(sound: tuple[Fitter, Fit]) -> None:
    fitter, _ = sound
    space = fitter.engine(Candidate((GAIN,)), ["h1.sensor_gain.factor"]).space
    nothing = fitter.data.readings.new_zeros(*fitter.data.readings.shape, len(space))
    assert occam(fitter, space, space.nominal(), nothing) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("inflow", [0.0, 1e-7])
def test_the_evidence_of_an_effect_at_the_end_of_its_range_is_an_integral_over_that_range(inflow: float) -> None:
    """A leak cannot be negative: where water comes in, its size stays at zero."""
    blank, size = random_steps(THREE_TANK, 600.0), "T1.leak.size"
    recording = recorded(THREE_TANK, blank, {"T1.unmetered_flow.flow": inflow}, seed=1)
    fitter, null, _ = recalibrate(problem_of(THREE_TANK, [recording], [], DEFAULT_SETTINGS).data)
    leak = Placement(effect("leak"), "T1")
    fit = fitter.fit(Candidate((leak,), ({size: 0.0},)), null)
    assert fit.effect_values[size] == 0.0
    sizes = torch.linspace(0.0, 0.005, 41, dtype=torch.float64)
    fits = [fitter.fit(Candidate((leak,), ({size: x},)), null, held=(size,)) for x in sizes.tolist()]
    likelihood = torch.tensor([math.exp(-0.5 * (f.cost - null.cost)) for f in fits], dtype=torch.float64)
    mean = float(torch.trapezoid(likelihood, sizes))  # over a range of width one
    prior = log_prior(fit.key, CHOICES) - log_prior((), CHOICES)
    gain = log_evidence(fitter, fit, CHOICES) - log_evidence(fitter, null, CHOICES)
    assert gain == pytest.approx(math.log(mean) + prior, abs=0.02)


@pytest.mark.parametrize("mean", [0.4, -2.0, 5.0])
def test_the_density_of_an_estimate_is_that_of_a_normal_distribution_between_its_bounds(mean: float) -> None:
    estimate = Estimate(torch.tensor([mean]).double(), torch.tensor([[0.7**2]]).double())
    x = torch.linspace(-0.5, 1.5, 2001).double()
    density = [math.exp(estimate.log_density(0, value, (-0.5, 1.5))) for value in x.tolist()]
    assert torch.trapezoid(torch.tensor(density).double(), x) == pytest.approx(1.0, abs=1e-5)
    assert density[1500] / density[500] == pytest.approx(math.exp(((mean**2) - (1.0 - mean) ** 2) / (2 * 0.7**2)))


def test_a_size_that_cancels_with_its_ramp_is_compared_with_zero_at_that_ramp() -> None:
    """Alone it seems undetermined; the rate is known to 1 %."""
    covariance = torch.tensor([[1.0, 1.0 - 5e-5], [1.0 - 5e-5, 1.0]]).double()
    estimate = Estimate(torch.tensor([1.0, 1.0]).double(), covariance)
    assert estimate.log_density(0, 0.0, (-50.0, 50.0)) > -2.0
    expected = -0.5 / 1e-4 - math.log(0.01 * math.sqrt(2.0 * math.pi))
    assert estimate.log_density(0, 0.0, (-50.0, 50.0), held={1: 1.0}) == pytest.approx(expected, rel=1e-3)


def test_an_estimate_without_information_is_uniform_between_its_bounds() -> None:
    estimate = Estimate(torch.tensor([3.0]).double(), torch.tensor([[1e18]]).double())
    assert estimate.log_density(0, 0.0, (-0.5, 1.5)) == pytest.approx(-math.log(2.0), abs=1e-6)


def test_an_effect_that_the_readings_need_is_not_left_out() -> None:
    recording = recorded(THREE_TANK, random_steps(THREE_TANK, 600.0), {"h1.sensor_gain.factor": 1.05}, seed=0)
    fitter, null, _ = recalibrate(problem_of(THREE_TANK, [recording], [], DEFAULT_SETTINGS).data)
    h = hypothesis_of(fitter, fitter.fit(Candidate((GAIN,), ({"h1.sensor_gain.factor": 1.01},)), null))
    pool = cast(ExplanationPool, SimpleNamespace(fitter=fitter, choices=CHOICES))
    assert all(r.weight < h.weight - 20.0 for r in HypothesisWeights(pool, (), 1).without_small_effects(h))


@pytest.mark.parametrize(("second", "describes"), [("area_taper", False), ("unmetered_flow", True)])
def test_a_cross_section_is_no_error_of_the_law_of_a_leak(
    sound: tuple[Fitter, Fit], second: str, describes: bool
) -> None:
    fitter, null = sound
    leak, other = Placement(effect("leak"), "T2"), Placement(effect(second), "T2")
    size = other.effect.parameters("T2", THREE_TANK)[0]
    start = {"T2.leak.size": 0.1, other.full_name(size.name): 0.1 * size.high}
    both = RankedExplanation(
        fitter.fit(Candidate((leak, other), (start,)), null), fitter, StateNoise(torch.ones(3), 0.0, torch.ones(3)), 0.0
    )

    def without(_: RankedExplanation, cause: CauseName) -> RankedExplanation:
        (left,) = (p for p in (leak, other) if p.cause != cause)
        fit = fitter.fit(Candidate((left,), (both.fit.values_of([left]),)), null)
        return RankedExplanation(fit, fitter, both.noise, 0.0)

    pool = cast(ExplanationPool, SimpleNamespace(fitter=fitter, choices=CHOICES, refitted_without=without))
    options = options_of([leak, other], fitter, operating_range_of(fitter.data.recording, THREE_TANK))
    variants = HypothesisWeights(pool, options, 1).with_inexact_laws(
        CauseHypothesis(both, causes_in_order(both.fit), 0.0)
    )
    assert bool(variants) is describes


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_held_parameters_keep_their_values_and_the_others_are_fitted(sound: tuple[Fitter, Fit], factor: float) -> None:
    fitter, null = sound
    name = "h1.sensor_gain.factor"
    held = fitter.fit(Candidate((GAIN,), ({name: factor},)), null, held=(name,))
    assert held.values[name] == factor and held.converged
    moved = [n for n in null.space.names if abs(held.values[n] - null.values[n]) > 1e-3 * abs(null.values[n])]
    assert moved and held.cost > null.cost + 10.0


def test_the_order_in_which_effects_are_removed_does_not_depend_on_hashes() -> None:
    """Each refit begins where the last one ended, so that another order may end in another explanation."""
    key = frozenset((f"effect_{name}", "T1") for name in "dbaec")
    removed: list[CauseName] = []

    class Pool(ExplanationPool):
        def refitted_without(self, explanation: RankedExplanation, cause: CauseName) -> RankedExplanation:
            removed.append(cause)
            return explanation

    pool = Pool(None, None, 1)  # type: ignore[arg-type]
    pool.explanations[key] = SimpleNamespace(key=key, log_evidence=0.0)  # type: ignore[assignment]
    pool.exchange_effects(())
    assert removed == sorted(key)
