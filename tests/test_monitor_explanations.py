"""Which explanations the monitor weighs, in which order it names them, and with which noise model."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch

from fdi_torch.monitor.fault_recovery import recovery_is_observable
from fdi_torch.monitor.hypothesis import Hypothesis, HypothesisFit, credible_set, merged
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_state import MonitorState
from fdi_torch.monitor.state_update import LAW_ERROR, window_beside_faults
from tests.test_monitor import FAULTS, SPACE, followed, monitor, recorded, step_to


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


@lru_cache
def leaking() -> tuple[Monitor, MonitorState]:
    """After the isolation of a leak of T3."""
    watch = monitor()
    return watch, followed(watch, recorded(step_to("T3.leak.size", 0.05, 200.0), 320))[0]


def test_every_fault_is_fitted_when_a_wrong_explanation_no_longer_holds() -> None:
    watch, state = leaking()
    assert state.change is not None
    fits = isolate(watch.observer, state.window(100.0), state.change.before, FAULTS, incipient=False, deepest=1)
    wrong = next(f for f in fits if f.hypothesis.columns == (3,))
    misled = replace(state, change=replace(state.change, explanations=(wrong,)))
    [event] = watch.alarms.on_threshold(misled)[1]
    assert event.kind in ("isolated", "revised") and event.faults == ("T3.leak.size",)


def test_the_evidence_beside_a_known_fault_allows_for_the_error_of_its_law() -> None:
    watch, state = leaking()
    assert window_beside_faults(watch.observer, state, 250.0, state.healthy).std is None
    beside = window_beside_faults(watch.observer, state, 250.0, state.believed)
    effects = watch.observer.whitening.filter(state.fault_effects[:, 1])[-len(beside) :]
    assert beside.std is not None and float(effects[-1, 2].abs()) > 5.0
    assert torch.allclose(beside.std, torch.sqrt(1.0 + (LAW_ERROR * effects).square()))


def test_a_recovery_is_told_once_the_fault_would_have_shown_more_than_the_error_of_its_law() -> None:
    watch = monitor()
    state, events = followed(watch, recorded(step_to("T1.leak.size", 0.08, 150.0, 330.0), 400))
    assert "recovered" in {event.kind for event in events} and state.change is not None
    [track] = state.change.ended
    assert recovery_is_observable(watch.observer, state, state.change, track)
    just_now = replace(state.change.best, onset=state.now - 1.5)
    assert not recovery_is_observable(watch.observer, state, replace(state.change, explanations=(just_now,)), track)
    assert SPACE.names[track.column] == "T1.leak.size"
