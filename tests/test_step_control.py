"""Adaptive steps of each lane: accuracy, agreement of both engines, and independence of other lanes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from own_steps import OwnStepsEngine, accept_steps, next_step
from rigs import assert_lanes_stand_alone, constant_inputs, three_tank
from rigs import paper_network as rig
from torch import Tensor

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import EFFECTS, all_placements
from fdi_torch.estimate.fitting import set_up
from fdi_torch.estimate.refinement import HybridSettings, information_std, refine_to_convergence
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate import build
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine import Readings, gram_of
from fdi_torch.simulate.experiment import Experiment, lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.step_control import DIAGONAL, EMBEDDED, STAGES, StepControl
from fdi_torch.simulate.traced_engine import TracedEngine


def experiment(tolerance: float | None, step: float = 20.0, samples: int = 41) -> Experiment:
    """Pumps that switch each 100 s, samples each 20 s."""
    time = 20.0 * torch.arange(samples, dtype=torch.float64)
    flows = 90e-6 * torch.rand(41, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    nothing = torch.zeros(samples, 3, dtype=torch.float64)
    recording = three_tank().recording(time, flows[torch.arange(samples) // 5 * 5], nothing)
    return lay_out(recording, ("Q1", "Q2"), step, None if tolerance is None else own_steps(tolerance))


def own_steps(tolerance: float) -> StepControl:
    return StepControl.for_tolerance(tolerance, three_tank())


@pytest.fixture(scope="module")
def truth() -> Tensor:
    network, space = rig()
    levels = CompiledEngine(network, space, experiment(None, step=0.002)).levels(faults(space))
    assert levels.max() > 1.0, "no level reaches a rim"
    return levels


def faults(space: ParameterSpace, count: int = 100) -> Tensor:
    share = torch.rand(count, len(space), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return space.low() + (space.high().clamp(max=1.0) - space.low()) * share


@pytest.mark.parametrize("tolerance", [1e-6, 1e-7, 1e-8])
def test_levels_are_as_exact_as_asked_for(tolerance: float, truth: Tensor) -> None:
    network, space = rig()
    error = (CompiledEngine(network, space, experiment(tolerance)).levels(faults(space)) - truth).abs().amax((1, 2))
    assert float(error.max()) < 3.0 * tolerance
    assert float(error.median()) < tolerance


def test_a_fixed_step_whose_roots_are_as_sharp_is_no_better(truth: Tensor) -> None:
    network, space = rig()
    theta, tolerance = faults(space), 1e-6
    own = CompiledEngine(network, space, experiment(tolerance)).levels(theta)
    fixed = CompiledEngine(network, space, experiment(None, step=own_steps(tolerance).resolution)).levels(theta)
    assert float((own - truth).abs().max()) < 3.0 * float((fixed - truth).abs().max())


def test_both_engines_take_the_same_steps() -> None:
    network, space = rig()
    e, theta = experiment(1e-5, samples=7), faults(space, 8)  # the pumps switch once
    compiled, traced = CompiledEngine(network, space, e), OwnStepsEngine(network, space, e)
    levels = traced.levels(theta)
    assert float((compiled.levels(theta) - levels).abs().max()) < 1e-10 * float(levels.max())
    readings, jacobian = compiled.linearise(theta)
    other = traced.linearise(theta)
    torch.testing.assert_close(readings, other[0], rtol=0, atol=1e-10)
    # Slopes next to equal levels magnify a last bit of the levels some thousand times; other steps change them by 3e-3.
    torch.testing.assert_close(jacobian, other[1], rtol=1e-7, atol=1e-7 * float(jacobian.abs().max()))


def test_slopes_are_those_of_fine_steps() -> None:
    network, space = rig()
    theta, own = faults(space, 40), experiment(1e-8)
    fine = replace(experiment(None, step=0.005), resolution=own.resolution)
    truth = CompiledEngine(network, space, fine).linearise(theta)[1]
    found = CompiledEngine(network, space, own).linearise(theta)[1]
    error = (found - truth).abs().amax((1, 2, 3)) / truth.abs().amax((1, 2, 3))
    assert float(error.median()) < 2e-4
    assert float(error.max()) < 1e-2


def test_a_lane_depends_on_no_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    network, space = rig()
    e, theta = experiment(1e-6), faults(space, 70)
    engine = CompiledEngine(network, space, e)
    data = Readings(torch.rand(41, 3).double(), torch.ones(41, 3).double())
    for run in (engine.levels, lambda t: engine.linearise(t)[1], lambda t: engine.gram(t, data)):
        assert_lanes_stand_alone(run, theta, monkeypatch)


def test_sums_are_those_of_readings_and_jacobian() -> None:
    network, space = rig()
    engine, theta = CompiledEngine(network, space, experiment(1e-6)), faults(space, 20)
    data = Readings(torch.rand(41, 3).double(), torch.ones(41, 3).double())
    expected = gram_of(*engine.linearise(theta), data)
    torch.testing.assert_close(engine.gram(theta, data), expected, rtol=1e-10, atol=0)


def test_every_effect_keeps_its_meaning() -> None:
    """All effects in one plant: memories and delays live on the grid's steps, flows on each lane's own."""
    plant = load_plant("three_tank")
    network = TankNetwork(plant, [p for effect in EFFECTS for p in all_placements(plant, [effect])[:1]])
    names = [n for n in network.constants.names if n.count(".") == 2]
    space = ParameterSpace(network.constants[n] for n in names)
    theta = space.nominal().expand(2, -1)
    own = experiment(1e-7)
    fine = replace(experiment(None, step=0.01), resolution=own.resolution)
    levels = CompiledEngine(network, space, fine).levels(theta)
    assert float((CompiledEngine(network, space, own).levels(theta) - levels).abs().max()) < 1e-5
    short = experiment(1e-7, samples=7)
    traced = OwnStepsEngine(network, space, short).levels(theta)
    torch.testing.assert_close(CompiledEngine(network, space, short).levels(theta), traced, rtol=0, atol=1e-10)


def test_the_implicit_method_satisfies_its_order_conditions() -> None:
    """ESDIRK4(3)6L[2]SA: c by Kennedy and Carpenter (2003); sum b c^k = 1 / (k + 1) up to order 4, embedded up to 3."""
    rows = [(0.0,), *((*row, DIAGONAL) for row in STAGES)]
    c = [sum(row) for row in rows]
    assert c == pytest.approx([0.0, 1 / 2, 83 / 250, 31 / 50, 17 / 20, 1.0], abs=1e-14)
    for weights, order in ((rows[-1], 4), (EMBEDDED, 3)):
        moments = [sum(b * x**k for b, x in zip(weights, c, strict=True)) for k in range(order)]
        assert moments == pytest.approx([1 / (k + 1) for k in range(order)], abs=1e-14)
        # sum b a c = 1 / 6
        inner = [sum(a * x for a, x in zip(row, c, strict=False)) for row in rows]
        assert sum(b * x for b, x in zip(weights, inner, strict=True)) == pytest.approx(1 / 6, abs=1e-14)


def test_the_errors_of_a_hundred_steps_add_up_to_the_tolerance() -> None:
    assert 100.0 * StepControl.for_tolerance(1e-6, three_tank()).tolerance == pytest.approx(1e-6)


def test_the_control_by_hand() -> None:
    n = torch.tensor
    assert next_step(n([0.0, 6.0, 7.5, 10.0]), n([4.0, 4.0, 4.0, 4.0]), n(10.0)).tolist() == [4.0, 4.0, 2.5, 10.0]
    assert next_step(n([4.0]), n([4.0]), n(10.0)).tolist() == [3.0], "two of 3 s, rather than 4 s and 2 s"
    cases = {  # own step, error, gone, pace -> kept, how far, pace
        "small error": (1.0, 0.01, 0.0, 1.0, True, 1.0, 0.9 * 100**0.25),
        "none": (1.0, 0.0, 0.0, 1.0, True, 1.0, 3.0),
        "large error": (1.0, 16.0, 0.0, 1.0, False, 0.0, 0.45),
        "no solution": (1.0, torch.inf, 0.0, 1.0, False, 0.0, 0.1),
        "no number": (1.0, torch.nan, 0.0, 1.0, True, 1.0, 3.0),
        "shortest": (0.1, 1e6, 0.0, 0.1, True, 0.1, 0.1),
        "there already": (1.0, 100.0, 10.0, 1.0, False, 10.0, 1.0),
        "cut short by the grid": (0.5, 0.4, 9.5, 2.0, True, 10.0, 2.0),
    }
    columns = [torch.tensor(c, dtype=torch.float64) for c in zip(*(case[:4] for case in cases.values()), strict=True)]
    own, error, gone, pace = columns
    kept, after, paces = accept_steps(own, error, gone, pace, n(10.0), 0.1)
    for i, (name, case) in enumerate(cases.items()):
        assert (bool(kept[i]), float(after[i])) == case[4:6], name
        assert float(paces[i]) == pytest.approx(case[6]), name


def test_misuse_is_named() -> None:
    network, space = rig()
    with pytest.raises(ValueError, match=r"expected a tolerance above the rounding of levels .*, got 0 m"):
        experiment(0.0)
    for engine in (ReferenceEngine, TracedEngine):
        message = f"expected the same steps for all lanes in the {engine.name} engine, got adaptive steps"
        with pytest.raises(ValueError, match=message):
            engine(network, space, experiment(1e-6))


def test_a_long_recording_is_fitted_in_own_steps_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = three_tank()
    recording = constant_inputs(plant, 400.0, 10.0)
    network, space = rig(plant)
    exact = CompiledEngine(network, space, lay_out(recording, plant.channels(), 0.05))
    noise = 1e-3 * torch.randn(41, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    theta = torch.tensor([0.3, 0.4, 0.2, 0.7, 0.9], dtype=torch.float64)
    read = replace(recording, outputs=exact.readings(theta) + noise, mask=torch.ones(41, 3, dtype=torch.bool))
    fitting = set_up(plant, [read], list(space), "equilibrium")

    def fitted() -> tuple[Tensor, Tensor]:
        low, high = fitting.space.low().clamp(min=-1.0), fitting.space.high().clamp(max=1.0)
        found, _ = refine_to_convergence(fitting, HybridSettings(), theta[None], low, high, 0.2, None)
        return found.theta[0], information_std(fitting.problem(0.05), found.theta)

    with monkeypatch.context() as fixed_steps:
        fixed_steps.setattr("fdi_torch.estimate.fitting.OWN_STEP_COST", torch.inf)
        assert not fitting.takes_own_steps(0.1)
        expected, std = fitted()
    assert fitting.takes_own_steps(0.1) and not fitting.takes_own_steps(1.0)
    assert not replace(fitting, engine="traced").takes_own_steps(0.1), "only the compiled engine takes them"
    with monkeypatch.context() as without:
        without.setattr(build, "find_compiler", lambda: None)
        assert not fitting.takes_own_steps(0.1)
    found, own_std = fitted()
    assert float(((found - expected).abs() / std).max()) < 0.1
    torch.testing.assert_close(own_std, std, rtol=1e-2, atol=0)
