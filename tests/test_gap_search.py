"""Structure search where constants hide single effects: two tanks, the upper level not measured."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch

from fdi_torch.cli.gap_text import next_steps
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, placements_for
from fdi_torch.gap.answer import Answer
from fdi_torch.gap.cause_hypothesis import CauseHypothesis, likeliest
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.hypothesis_search import HypothesisSearch
from fdi_torch.gap.localization.regressors import backlash
from fdi_torch.gap.problem import DEFAULT_SETTINGS, problem_of
from fdi_torch.gap.screening import options_of
from fdi_torch.gap.stage_progress import StageProgress
from fdi_torch.gap.trajectory_problem import first_lowest
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.recording import Recording
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.experiment import lay_out
from tests.rigs import blank_recording, random_steps
from tests.test_gap_convergence import recorded as recorded_by_reference

PLANT = load_plant(Path(__file__).parents[1] / "configs" / "real" / "cascaded_tanks_nominal.yaml")
LIBRARY = ("overflow", "sensor_curvature", "plugging", "flow_exponent", "area_taper", "internal_body", "leak")
STANDING = {
    "middle.discharge_coefficient": 0.682,
    "bottom.discharge_coefficient": 0.589,
    "level.gain": 62.023,
    "level.offset": 0.471,
    "upper.overflow.below_rim": 0.188,
    "upper.overflow.crest": 0.02,
    "upper.overflow.to_lower": 0.65,
    "level.sensor_curvature.bend": -0.012,
}
# What the library does not have: without its equations nothing fits to the noise.
MISSING = {"middle.laminar_flow.transition_head": 0.02, "pump.pump_lag.time_constant": 10.0}


def wandering(samples: int, seed: int) -> torch.Tensor:
    """(samples,) V every 4 s: many slow waves, as in the benchmark."""
    generator = random.Random(seed)
    time = 4.0 * torch.arange(samples, dtype=torch.float64)
    waves = torch.zeros(samples, dtype=torch.float64)
    for k in range(1, 40):
        turns = k / (4.0 * samples) * generator.uniform(0.8, 1.2) * time + generator.random()
        waves += torch.sin(2 * math.pi * turns) / (1 + (k / 12) ** 2)
    return (3.0 + 1.5 * waves / waves.std()).clamp(0.3, 6.5)


def recorded(values: dict[str, float], voltage: torch.Tensor) -> Recording:
    """Two tanks of which the lower one is read, in volts, with 15 mV of noise."""
    blank = blank_recording(PLANT, voltage.unsqueeze(1), 4.0 * torch.arange(len(voltage), dtype=torch.float64))
    network = build_network(PLANT, placements_for(values))
    space = ParameterSpace(network.constants[n] for n in values)
    engine = Collocation(network, space, lay_out(blank, PLANT.channels(), 4.0))
    theta = space.vector(values).unsqueeze(0)
    readings = engine.converge(theta).readings[0]
    noise = 0.015 * torch.randn(readings.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return replace(blank, outputs=readings + noise, mask=None)  # type: ignore[arg-type]


def test_permanent_effects_are_named_and_none_with_an_onset_though_constants_hide_them() -> None:
    """By what closes most first, from the recalibrated plant, it would be a leak and a plugging with an onset."""
    recording = recorded(STANDING | MISSING, wandering(1024, 4)[256:896])
    found = diagnose(PLANT, recording, settings=Settings(library=LIBRARY, most=2, named_only=True))
    assert ("overflow", "upper") in {(c.effect, c.location) for c in found.causes}
    assert not any("onset" in c.parameters for c in found.causes)


def test_an_unknown_verdict_suggests_the_next_step() -> None:
    unknown = Answer("unknown", 0.0, [("bottom", 0.99)], [], [], [], {}, {})
    assert any("--named-only" in step for step in next_steps(unknown, True, ("all",), None, "better.yaml"))
    sound = replace(unknown, verdict="no_gap")
    assert not any("--named-only" in step for step in next_steps(sound, True, ("all",), None, "better.yaml"))


@pytest.mark.slow
@pytest.mark.parametrize("plugged", [False, True])
def test_a_change_in_time_is_named_where_there_was_one(plugged: bool) -> None:
    """Beside an overflow, with laws that the library lacks: a drift would take up what they miss."""
    truth = {k: v for k, v in (STANDING | MISSING).items() if "curvature" not in k}
    truth |= {"bottom.plugging.size": 0.3, "bottom.plugging.onset": 1400.0} if plugged else {}
    recording = recorded(truth, wandering(1024, 4)[256:896])
    library = (*LIBRARY, "pump_oscillation", "coefficient_drift", "unmetered_flow")
    found = diagnose(PLANT, recording, settings=Settings(library=library, most=3, named_only=True))
    timed = {name for c in found.causes for name in c.parameters} & {"onset", "rate", "phase", "begin"}
    assert bool(timed) is plugged


def test_a_discrepancy_is_tried_at_other_places_beside_the_same_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    search = HypothesisSearch(cast(ExplanationPool, SimpleNamespace(progress=StageProgress())), (), ("T1", "OUT1"))
    explanation = SimpleNamespace()
    at_tank, at_outlet = (
        cast(
            CauseHypothesis,
            SimpleNamespace(weight=weight, explanation=explanation, all_causes=(), discrepancy=object(), unknown=None),
        )
        for weight in (3.0, 5.0)
    )
    tried = []

    def with_discrepancies(self: HypothesisSearch, explanation: object, at: object, best: object) -> list[object]:
        tried.append((explanation, at))
        return [at_tank, at_outlet]

    for name in ("_with_fewer_effects", "_with_more_effects"):
        monkeypatch.setattr(HypothesisSearch, name, lambda self, best: [])
    monkeypatch.setattr(HypothesisSearch, "_with_discrepancies", with_discrepancies)
    assert at_outlet in search._local_search(at_tank)
    assert tried == [(explanation, ("T1", "OUT1"))], "once for each explanation"


def test_a_discrepancy_is_tried_at_other_places_beside_the_effect_that_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The largest of two causes, a sensor that lags and a pump that stalls, may be taken for both."""
    lag = frozenset({("sensor_lag", "h1")})
    alone, lagging, slower = (
        SimpleNamespace(key=key, log_weight=weight) for key, weight in [(frozenset(), 1.0), (lag, 2.0), (lag, 0.0)]
    )
    pool = SimpleNamespace(explanations={0: alone, 1: slower, 2: lagging}, progress=StageProgress())
    search = HypothesisSearch(cast(ExplanationPool, pool), (), ("h1", "Q1"))
    best, moved = (
        cast(
            CauseHypothesis,
            SimpleNamespace(
                weight=weight,
                explanation=explanation,
                causes=tuple(explanation.key),
                all_causes=(),
                discrepancy=object(),
                unknown=SimpleNamespace(location=place),
                unknown_at=place,
            ),
        )
        for weight, explanation, place in [(3.0, alone, "h1"), (5.0, lagging, "Q1")]
    )

    def with_discrepancies(self: HypothesisSearch, explanation: object, at: object, best: object) -> list[object]:
        return [moved] if explanation is lagging else []

    for name in ("_with_fewer_effects", "_with_more_effects"):
        monkeypatch.setattr(HypothesisSearch, name, lambda self, best: [])
    monkeypatch.setattr(HypothesisSearch, "_fit_effects_at", lambda self, h, unknown: None)
    monkeypatch.setattr(HypothesisSearch, "_with_discrepancies", with_discrepancies)
    assert moved in search._local_search(best)


@pytest.mark.slow
def test_an_effect_that_random_flows_have_absorbed_is_found_beside_a_discrepancy() -> None:
    """A slack pump, which is not in the library, and an outlet that lies 6 mm lower."""
    plant = load_plant("three_tank")
    blank = random_steps(plant, 1200.0, seed=2)
    slack = blank.inputs.clone()
    slack[:, 0] = backlash(blank.inputs[:, 0], torch.tensor([[3e-6]], dtype=torch.float64))[0]
    recording = recorded_by_reference(plant, replace(blank, inputs=slack), {"OUT2.outlet_drop.drop": 0.006}, seed=0)
    problem = problem_of(plant, [replace(recording, inputs=blank.inputs)], [], DEFAULT_SETTINGS)
    fitter, null, _ = recalibrate(problem.data)
    placements = [p for p in problem.library if not p.effect.quantizes]
    options = options_of(placements, fitter, operating_range_of(recording, plant))
    pool = ExplanationPool(fitter, null, len(problem.library))
    search = HypothesisSearch(pool, options, ("Q1",))
    pump = likeliest(search._with_discrepancies(pool.evaluate(null), ["Q1"]))
    assert pump.all_causes == (("unknown", "Q1"),)
    assert pump.noise.intensity[1] > 3.0 * pump.noise.intensity[2], "a random flow in place of the outlet's"
    at_outlet = [h for h in search._with_more_effects(pump) if any(place == "OUT2" for _, place in h.causes)]
    assert likeliest(at_outlet).weight > pump.weight - 3.0


def test_of_descents_that_end_at_the_same_cost_the_first_is_taken() -> None:
    """An effect that shows nowhere has one chi-square at all its values; rounding must not choose among them."""
    cost = torch.tensor([910.0, math.nan, 899.88 + 2e-12, 899.88, 899.9], dtype=torch.float64)
    assert first_lowest(cost) == 2
    assert first_lowest(cost[:2]) == 0 and first_lowest(torch.tensor([math.nan, math.inf, 3.0])) == 2
    assert first_lowest(torch.tensor([math.nan, math.nan])) == 0, "no descent has ended at a cost"
