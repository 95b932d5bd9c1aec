"""Which explanations the monitor weighs, and in which order it names them."""

from __future__ import annotations

from dataclasses import replace

import torch

from fdi_torch.monitor.hypothesis import Hypothesis, HypothesisFit, credible_set, merged
from fdi_torch.monitor.isolation import isolate
from tests.test_monitor import FAULTS, followed, monitor, recorded, step_to


def explanation(column: int, misfit: float, probability: float) -> HypothesisFit:
    zeros = torch.zeros(5, dtype=torch.float64)
    return HypothesisFit(Hypothesis((column,)), zeros, zeros, 0.0, 1.0, 0.0, misfit, 1.0, 2.0, probability=probability)


def test_explanations_that_no_reading_distinguishes_are_ranked_by_their_sum() -> None:
    fits = [
        explanation(0, 10.5, 0.44),
        explanation(1, 10.0, 0.30),
        explanation(2, 10.0, 0.22),
        explanation(3, 14.0, 0.04),
    ]
    assert [f.hypothesis.columns[0] for f in merged(fits)] == [1, 2, 0, 3]
    assert [f.hypothesis.columns[0] for f in credible_set(merged(fits), 0.95)] == [1, 2, 0]
    assert [f.hypothesis.columns[0] for f in credible_set(merged(fits), 0.25)] == [1, 2]


def test_every_fault_is_fitted_when_a_wrong_explanation_no_longer_holds() -> None:
    watch = monitor()
    state, _ = followed(watch, recorded(step_to("T3.leak.size", 0.05, 200.0), 320))
    assert state.change is not None
    fits = isolate(watch.observer, state.window(100.0), state.change.before, FAULTS, incipient=False, deepest=1)
    wrong = next(f for f in fits if f.hypothesis.columns == (3,))
    misled = replace(state, change=replace(state.change, explanations=(wrong,)))
    [event] = watch.alarms.on_threshold(misled)[1]
    assert event.kind in ("isolated", "revised") and event.faults == ("T3.leak.size",)
