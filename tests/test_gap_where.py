"""Where a gap lies: the forms, their evidence, the trajectory that was read, and the place of what has no name."""

from __future__ import annotations

import pytest
import torch

from fdi_torch.gap.case import case_of
from fdi_torch.gap.diagnose import Settings, _recalibrated, diagnose
from fdi_torch.gap.where.components import balance_of
from fdi_torch.gap.where.followed import between, smoothed
from fdi_torch.gap.where.forms import bends, faded, jerked, lagged, relays, slewed, stuck, switched
from fdi_torch.gap.where.sparse import sparse
from fdi_torch.gap.where.suspects import parted, suspects
from tests.test_gap import believed, recorded


def test_a_straight_line_is_not_changed_by_smoothing_and_gaps_are_bridged() -> None:
    line = 0.3 + 0.01 * torch.arange(60, dtype=torch.float64)
    mask = torch.ones(60, dtype=torch.bool)
    mask[20:24] = False
    hidden = torch.where(mask, line, torch.nan)
    assert smoothed(hidden, mask) == pytest.approx(line, abs=1e-12)


def test_values_between_samples_lie_on_the_line_and_stay_beyond_the_ends() -> None:
    at, times = torch.tensor([-1.0, 0.5, 3.0, 9.0]), torch.tensor([0.0, 1.0, 4.0])
    assert between(at, times, torch.tensor([0.0, 2.0, 5.0])).tolist() == [0.0, 1.0, 4.0, 5.0]


def test_forms_with_memory_are_what_their_equations_say() -> None:
    x, step = torch.tensor([0.0, 1.0, 1.0, 1.0], dtype=torch.float64), torch.full((4,), 2.0, dtype=torch.float64)
    decay = torch.exp(torch.tensor(-0.5, dtype=torch.float64))
    assert lagged(x, step, 4.0) == pytest.approx(torch.stack([0 * decay, 1 - decay, 1 - decay**2, 1 - decay**3]))
    assert faded(torch.diff(x, prepend=x[:1]), step, 4.0) == pytest.approx(
        torch.stack([0 * decay, decay**0, decay, decay**2])
    )
    assert stuck(torch.tensor([0.0, 0.5, 2.0, 1.5, 0.0]), torch.tensor([[1.0], [0.25]])).tolist() == [
        [0.0, 0.0, 1.0, 1.0, 1.0],
        [0.0, 0.25, 1.75, 1.75, 0.25],
    ]
    assert slewed(torch.tensor([0.0, 5.0, 5.0, 1.0]), step, 1.0).tolist() == [0.0, 2.0, 4.0, 2.0]


def test_what_switches_stays_between_its_thresholds_as_it_was() -> None:
    x = torch.tensor([0.0, 0.5, 0.9, 0.5, 0.1, 0.5])
    assert switched(x, 0.2, 0.8).tolist() == [0.0, 0.0, 1.0, 1.0, 0.0, 0.0]
    assert jerked(x, 0.45).tolist() == pytest.approx([0.0, 0.5, 0.5, 0.5, 0.5, 0.5])
    assert [low for low, _ in relays(x, (0.0, 1.0), 3)] == pytest.approx([1 / 6, 1 / 6, 0.5])


def test_bends_span_every_piecewise_linear_function_of_their_values() -> None:
    x = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    basis = torch.stack(bends(x, (0.0, 1.0), 5), dim=1)
    kinked = (x - 0.25).abs() - 2.0 * (x - 0.75).clamp(min=0.0)
    found = torch.linalg.lstsq(basis, kinked.unsqueeze(1)).solution
    assert (basis @ found).squeeze(1) == pytest.approx(kinked, abs=1e-10)


def test_the_forms_that_made_a_signal_have_more_evidence_than_as_many_others() -> None:
    generator = torch.Generator().manual_seed(2)
    true, other = (torch.randn(400, 30, generator=generator, dtype=torch.float64) for _ in range(2))
    noise = torch.randn(400, generator=generator, dtype=torch.float64)
    signal = 3.0 * true[:, 4] - 2.0 * true[:, 11] + noise
    both = torch.stack([true, other])
    found = sparse(both.mT @ both, (both.mT @ signal.unsqueeze(-1)).squeeze(-1), 1.0, 40)
    assert float(found.evidence[0] - found.evidence[1]) > 1000.0
    least_squares = torch.linalg.lstsq(true[:, [4, 11]], signal.unsqueeze(1)).solution
    closed = float(signal @ signal - ((signal - (true[:, [4, 11]] @ least_squares).squeeze(1)) ** 2).sum())
    assert float(found.closes[0]) == pytest.approx(closed, rel=5e-3)
    assert 1.9 < float(found.needs[0]) < 10.0 < float(found.needs[1]), "two did it, and others need many to come near"


def test_a_sluggish_pump_is_told_from_its_tank_by_a_closer_look() -> None:
    """Both make one balance; coarse steps in time, at the tank, do nearly as well as the pump's own forms."""
    case = case_of(believed(), (recorded({"Q2.actuator_slew.slowness": 3e6}, 4),), (), Settings())
    fitter, null, _ = _recalibrated(case.subject)
    first = suspects(fitter, null, ("Q2", "T2", "OUT2"), waves=True, closely=True)
    found = parted(fitter, null, first)
    assert first[0].location == "T2"
    assert found[0].location == "Q2"
    assert sorted(s.location for s in found) == ["OUT2", "Q2", "T2"]


@pytest.mark.parametrize("values", [{"Q1.pump_lag.time_constant": 15.0}, {"h2.sensor_hysteresis.play": 0.02}])
def test_what_has_a_memory_and_no_name_is_unknown_at_its_place(values: dict[str, float]) -> None:
    answer = diagnose(believed(), recorded(values, 5), settings=Settings(leave_out=("pump_lag", "pump_delay")))
    assert answer.verdict == "unknown"
    place = next(iter(values)).partition(".")[0]
    assert answer.where[0][0] == place
    assert answer.posterior[0].unknown_at == place
    assert 0.5 < answer.posterior[0].probability < 0.95, "what has a name is never quite out of the question"
    assert sum(e.probability for e in answer.posterior) == pytest.approx(1.0, abs=1e-3)


def test_a_pump_and_an_outlet_have_a_part_in_one_balance_and_a_pipe_in_two() -> None:
    places = ("Q2", "T2", "OUT2", "P32", "T1-T2", "h2", "Q1")
    assert [balance_of(p, believed()) for p in places] == ["T2", "T2", "T2", None, None, None, "T1"]


def test_a_curvature_that_rounding_spoilt_harms_no_neighbour() -> None:
    columns = torch.randn(3, 20, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gram, score = columns.mT @ columns, torch.full((3, 6), 100.0, dtype=torch.float64)
    spoilt = gram.clone()
    spoilt[1, 0, 1] = spoilt[1, 1, 0] = 1.01 * torch.sqrt(gram[1, 0, 0] * gram[1, 1, 1])
    found, expected = sparse(spoilt, score, 1e-3, 20), sparse(gram, score, 1e-3, 20)
    assert bool(torch.isfinite(found.evidence).all())
    assert torch.equal(found.evidence[[0, 2]], expected.evidence[[0, 2]])
