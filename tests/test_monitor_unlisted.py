"""Causes that are not on the list of faults: told as such by the posterior, and never by the name of a listed fault."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import pytest
import torch

from fdi_torch.effects import build_network, placements_for
from fdi_torch.effects.usual_faults import usual_faults
from fdi_torch.estimate.evidence import ODDS
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.hypothesis import UNLISTED, Hypothesis, HypothesisFit, with_unlisted_as_one
from fdi_torch.monitor.hypothesis_fit import Prior
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.samples import samples_of_recording
from fdi_torch.parameters import ParameterSpace
from tests.test_monitor import NAMES, PLANT, recorded

ONSET, END, LEARN = 700.0, 1200, 600.0
USUAL = usual_faults(PLANT)
RIG = build_network(PLANT, placements_for(USUAL))
ALL = ParameterSpace(RIG.constants[name] for name in USUAL)


def stairs() -> torch.Tensor:
    """Commands of both pumps in steps of 200 and 250 s, (END, 2) m^3/s."""
    draw, time = torch.Generator().manual_seed(20261331), torch.arange(END)
    heights = 40e-6 + 20e-6 * torch.rand(2, 6, generator=draw, dtype=torch.float64)
    return torch.stack([heights[0, time // 200], heights[1, time // 250]], dim=1)


@lru_cache
def events_with(fault: str, size: float, listed: tuple[str, ...] = tuple(NAMES)) -> tuple[Event, ...]:
    """What a monitor with these suspects says about a fault that occurs at ONSET."""
    truth = ALL.vector({fault: size})
    run = recorded(lambda t: truth if t >= ONSET else ALL.nominal(), END, RIG, ALL, seed=5, inputs=stairs())
    recording = PLANT.recording(run.time, run.inputs, run.readings)
    prepared = prepare_monitor(PLANT, fault_free_part(recording, 0.0, LEARN), listed)
    samples, monitor = samples_of_recording(recording, PLANT), prepared.monitor
    state = monitor.start(samples, prepared.believed, learning_until=LEARN)
    state, events = monitor.advance(state, samples.segment(1, END))
    return (*events, *monitor.close(state))


@pytest.mark.parametrize(
    ("fault", "size"),
    [
        ("h2.sensor_bias.bias", -0.02),
        ("Q1.pump_gain.factor", 0.9),
        ("T2.leak.size", 0.1),
    ],
)
def test_a_fault_that_is_not_on_the_list_is_told_as_such(fault: str, size: float) -> None:
    """Without such causes: a pump's gain with a bias, a leak of T1, and a pump's gain."""
    events = events_with(fault, size)
    answers = [e for e in events if e.explanations and e.kind not in ("followed", "summary")]
    assert answers and not any(e.kind == "isolated" for e in events)
    last = answers[-1]
    assert last.kind == "cannot tell" and last.explanations[0].unlisted and "not on the list" in last.text
    assert sum(e.kind == "alarm" for e in events) <= 3
    summaries = [e.text for e in events if e.kind == "summary" and "cannot tell" in e.text]
    assert summaries and all("cannot tell: a cause that is not on the list" in text for text in summaries)


@pytest.mark.parametrize(
    ("fault", "size"), [("T1.leak.size", 0.1), ("h3.sensor_bias.bias", 0.02), ("P13.plugging.size", 0.15)]
)
def test_a_fault_of_the_list_is_isolated(fault: str, size: float) -> None:
    answers = [e for e in events_with(fault, size) if e.explanations and e.kind != "summary"]
    assert all(e.faults == (fault,) for e in answers)
    assert str(answers[-1].state) == "isolated"


def test_a_list_of_all_usual_faults_leaves_no_other_cause() -> None:
    assert not any(x.unlisted for e in events_with("T1.leak.size", 0.1, ()) for x in e.explanations)


def test_all_causes_that_are_not_on_the_list_have_a_fifth_of_the_odds_of_the_list() -> None:
    prior = Prior(("T1.leak.size", "T2.leak.size", "T3.leak.size"), 4, unlisted=(2,), unlisted_changes=2)
    one, other = (math.exp(prior(Hypothesis((column,)))) for column in (0, 2))
    assert 4 * one == pytest.approx(ODDS.effect) and 2 * other == pytest.approx(ODDS.unknown)


def fitted(column: int, misfit: float, probability: float, incipient: bool = False) -> HypothesisFit:
    zeros = torch.zeros(4, dtype=torch.float64)
    h = Hypothesis((column,), incipient)
    return HypothesisFit(h, zeros, zeros, 0.0, 1.0, 0.0, misfit, 1.0, 2.0, probability=probability)


def test_causes_that_are_not_on_the_list_are_one_explanation() -> None:
    fits = [fitted(0, 10.0, 0.4), fitted(2, 10.5, 0.3), fitted(3, 11.0, 0.2), fitted(1, 12.0, 0.1)]
    first, *rest = with_unlisted_as_one(fits, (2, 3))
    assert first.hypothesis == UNLISTED and first.probability == pytest.approx(0.5)
    assert [f.hypothesis.columns for f in rest] == [(0,), (1,)]
    growing = [*fits[:3], fitted(0, 12.0, 0.2, incipient=True)]
    assert with_unlisted_as_one(growing, (2, 3))[0].hypothesis.columns == (0,), "sudden and growing are one"


def test_a_twin_of_a_listed_fault_is_that_fault() -> None:
    fits = [fitted(0, 10.0, 0.6), fitted(2, 10.0, 0.2), replace(fitted(3, 11.0, 0.2), at_bound=(3,))]
    both = with_unlisted_as_one(fits, (2, 3))
    assert [f.probability for f in both] == pytest.approx([0.75, 0.25]) and both[1].at_bound == ()
    [alone] = with_unlisted_as_one(fits[:2], (2, 3))
    assert alone.hypothesis.columns == (0,) and alone.probability == pytest.approx(1.0)
