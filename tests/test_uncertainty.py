"""Standard errors against linear regression in closed form; what is not determined is named, in any units."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from fdi_torch.estimate.combinations import Combination
from fdi_torch.estimate.fitting import set_up
from fdi_torch.estimate.hybrid import search_box
from fdi_torch.estimate.information import (
    certainty,
    determined_combinations,
    fisher_information,
)
from fdi_torch.estimate.linearisation import STALLED, unfinished
from fdi_torch.estimate.refinement import status_of
from fdi_torch.estimate.uncertainty import make_estimate, parameters_at_bounds
from fdi_torch.parameters import Parameter, ParameterSpace
from tests.rigs import constant_inputs, three_tank

DOUBLE = torch.float64
TIME = torch.linspace(0.0, 10.0, 51, dtype=DOUBLE)
SIGMA = torch.tensor([0.3], dtype=DOUBLE)


def line(units: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """Jacobian (S, 1, 2) of y = a + b t, with a and b in other units."""
    return torch.stack((torch.ones_like(TIME) / units[0], TIME / units[1]), -1)[:, None]


def space(*names: str) -> ParameterSpace:
    return ParameterSpace(Parameter(name, "1", 0.5, 0.0, 1.0) for name in names)


def columns(*signals: Tensor) -> Tensor:
    """Information of one channel with unit noise and these sensitivities."""
    return fisher_information(torch.stack(signals, -1)[:, None], torch.ones(1, dtype=DOUBLE))


def test_straight_line_has_the_textbook_standard_errors() -> None:
    """var b = sigma^2 / S_tt, var a = sigma^2 (1/n + mean^2 / S_tt), cov = -mean sigma^2 / S_tt."""
    mean, n = TIME.mean(), len(TIME)
    s_tt = ((TIME - mean) ** 2).sum()
    sure = certainty(fisher_information(line(), SIGMA))
    expected = SIGMA**2 * torch.stack((1 / n + mean**2 / s_tt, -mean / s_tt, -mean / s_tt, 1 / s_tt)).reshape(2, 2)
    torch.testing.assert_close(sure.covariance, expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(sure.std, expected.diagonal().sqrt(), rtol=1e-12, atol=0)


def test_estimates_of_many_noisy_lines_scatter_as_the_bound_says() -> None:
    generator = torch.Generator().manual_seed(0)
    noise = SIGMA * torch.randn(20_000, 51, dtype=DOUBLE, generator=generator)
    fitted = torch.linalg.lstsq(line()[:, 0], noise.mT).solution
    bound = certainty(fisher_information(line(), SIGMA)).std
    torch.testing.assert_close(fitted.std(-1), bound, rtol=0.02, atol=0)


def test_units_change_standard_errors_by_their_factor_only() -> None:
    units = (1e-9, 1e8)
    scaled = certainty(fisher_information(line(units), SIGMA))
    plain = certainty(fisher_information(line(), SIGMA))
    torch.testing.assert_close(scaled.std / torch.tensor(units, dtype=DOUBLE), plain.std, rtol=1e-12, atol=0)


def test_further_channels_count_by_their_noise() -> None:
    both = fisher_information(line().expand(-1, 2, -1), torch.tensor([0.3, 0.6], dtype=DOUBLE))
    torch.testing.assert_close(both, 1.25 * fisher_information(line(), SIGMA))


def test_held_parameter_leaves_the_others_as_if_it_were_known() -> None:
    sure = certainty(fisher_information(line(), SIGMA), held=torch.tensor([True, False]))
    assert sure.std[0] == 0.0
    torch.testing.assert_close(sure.std[1], SIGMA[0] / (TIME**2).sum().sqrt(), rtol=1e-12, atol=0)


def test_certainty_keeps_its_bits_in_any_batch() -> None:
    factor = torch.randn(40, 7, 7, dtype=DOUBLE, generator=torch.Generator().manual_seed(1))
    factor[::3, :, 2] = factor[::3, :, 5]
    information = factor.mT @ factor
    together = certainty(information)
    assert torch.isinf(together.std[::3][:, [2, 5]]).all()
    for i in range(40):
        alone = certainty(information[i])
        assert torch.equal(alone.covariance.nan_to_num(-7.0), together.covariance[i].nan_to_num(-7.0))


def test_batch_members_with_and_without_trouble_stay_apart() -> None:
    good = fisher_information(line(), SIGMA)
    batch = torch.stack((good, torch.full_like(good, math.nan), torch.zeros_like(good), good))
    sure = certainty(batch)
    assert torch.equal(sure.std[0], certainty(good).std) and torch.equal(sure.std[3], sure.std[0])
    assert torch.isinf(sure.std[1:3]).all()


@pytest.mark.parametrize("factor", [1.0, 1e-7, 1e6])
def test_collinear_pair_is_named_with_the_combination_that_is_determined(factor: float) -> None:
    """Sensitivities s and 0.8 s: only a + 0.8 b is known, whatever the size of s; c is known by itself."""
    signal = factor * torch.sin(TIME)
    other = torch.cos(TIME) - signal * (signal @ torch.cos(TIME)) / (signal @ signal)
    estimate = make_estimate(
        space("P13.plugging", "T2.area", "T1.leak.size"),
        torch.tensor([0.2, 0.4, 0.3], dtype=DOUBLE),
        columns(signal, other, 0.8 * signal),
    )
    named = "of P13.plugging and T1.leak.size, only P13.plugging + 0.8 T1.leak.size is determined"
    assert estimate.undetermined[0] == named
    assert torch.isinf(estimate.std).tolist() == [True, False, True]
    assert estimate.std[1].item() == pytest.approx(1.0 / (other**2).sum().sqrt().item(), rel=1e-9)
    assert math.isinf(estimate.covariance[0, 0]) and math.isnan(estimate.covariance[0, 1])


def test_parameter_without_effect_and_a_group_of_three_are_told_apart() -> None:
    """e does nothing; a, b and c have sensitivities s, u and s + 2 u, so two combinations of the three are known."""
    s, u = torch.sin(TIME), torch.exp(-TIME)
    estimate = make_estimate(
        space("a", "b", "c", "d", "e"),
        torch.full((5,), 0.5, dtype=DOUBLE),
        columns(s, u, s + 2.0 * u, TIME, torch.zeros_like(TIME)),
    )
    assert estimate.undetermined == (
        "of a, b and c, only a + c and b + 2 c are determined",
        "e is not determined: the readings do not depend on it",
    )
    assert torch.isinf(estimate.std).tolist() == [True, True, True, False, True]


def test_a_parameter_with_a_small_part_in_an_undetermined_direction_is_undetermined() -> None:
    """The sensitivities s, u and s + 0.2 u: along (1, 0.2, -1) nothing changes, of which b is 2 %."""
    s, u = torch.sin(TIME), torch.exp(-TIME)
    information = columns(s / s.norm(), u / u.norm(), s / s.norm() + 0.2 * u / u.norm(), TIME)
    estimate = make_estimate(space("a", "b", "c", "d"), torch.full((4,), 0.5, dtype=DOUBLE), information)
    assert torch.isinf(estimate.std).tolist() == [True, True, True, False]


def test_a_search_covers_four_standard_deviations_of_a_prior_within_the_range() -> None:
    plant = replace(three_tank(), tolerances={"P13.discharge_coefficient": 0.03, "P32.area": 0.5})
    names = ["P13.discharge_coefficient", "P32.area", "T1.leak.size"]
    low, high = search_box(set_up(plant, [constant_inputs(plant, 10.0)], names, start=0.5))
    assert low.tolist() == pytest.approx([0.6 - 4 * 0.018, 0.06e-4, 0.0])
    assert high.tolist() == pytest.approx([0.6 + 4 * 0.018, 1.8e-4, 1.0])


@pytest.mark.parametrize(("errors", "status"), [(0.09, "converged"), (0.11, "stalled")])
def test_a_stalled_refinement_within_a_tenth_of_a_standard_error_has_converged(errors: float, status: str) -> None:
    """At x standard errors from the optimum, the log-likelihood is x^2 / 2 below its maximum."""
    one = torch.ones(1, dtype=DOUBLE)
    stopped = replace(
        unfinished(one[:, None], None), status=torch.tensor([STALLED]), newton_decrement=0.5 * errors**2 * one
    )
    assert status_of(stopped) == status


def test_determined_combinations_are_those_the_readings_depend_on() -> None:
    """Moving along the null space of random sensitivities in mixed units changes no determined combination."""
    generator = torch.Generator().manual_seed(2)
    signals = torch.randn(60, 3, dtype=DOUBLE, generator=generator) @ torch.randn(
        3, 5, dtype=DOUBLE, generator=generator
    )
    unit = 10.0 ** torch.arange(-4, 6, 2, dtype=DOUBLE)
    sure = certainty(columns(*(signals / unit).unbind(-1)))
    ((members, rows),) = determined_combinations(sure.null, sure.scale)
    assert members == [0, 1, 2, 3, 4] and rows.shape == (3, 5)
    plain = rows * unit / unit[:3, None]
    torch.testing.assert_close(plain[:, :3], torch.eye(3, dtype=DOUBLE), rtol=0, atol=1e-9)
    hidden = torch.linalg.svd(signals)[2][3:]
    torch.testing.assert_close(plain @ hidden.mT, torch.zeros(3, 2, dtype=DOUBLE), rtol=0, atol=1e-9)


def test_determined_combination_has_the_value_and_standard_error_of_a_fit_for_it_alone() -> None:
    """y = (a + k c) s + b u in mixed units equals y = d s + b u with d = a + k c, whose standard error is known."""
    s, u, k = torch.sin(TIME), torch.exp(-TIME), 250.0
    mixed = ParameterSpace(
        [Parameter("P.offset", "m^3/s", 0.0), Parameter("b", "1", 0.0), Parameter("A.level", "m", 0.0, -1.0, 1.0)]
    )
    estimate = make_estimate(mixed, torch.tensor([0.2, 0.4, 0.003], dtype=DOUBLE), columns(s, u, k * s))
    (combination,) = estimate.combinations
    alone = certainty(columns(s, u))
    assert combination.parameters == ("P.offset", "A.level") and combination.unit == "m^3/s"
    assert combination.coefficients == pytest.approx((1.0, k), rel=1e-9)
    assert combination.value == pytest.approx(0.2 + 0.003 * k, rel=1e-9)
    assert combination.std == pytest.approx(float(alone.std[0]), rel=1e-6)
    # 250 m^3/s per m is 2.5e6 cm^3/s per cm.
    assert combination.formula == "P.offset + 2.5e+06 cm^3/s/cm A.level"
    assert estimate.to_dict()["combinations"] == [combination.to_dict()]
    assert Combination.from_dict(combination.to_dict()) == combination


def test_held_parameter_counts_as_known_in_what_is_determined() -> None:
    signal = torch.sin(TIME)
    sure = certainty(columns(signal, 0.5 * signal), held=torch.tensor([True, False]))
    assert not sure.null.any() and torch.equal(sure.determined, sure.covariance)


def test_nearly_collinear_is_determined_but_told_to_exceed_its_range() -> None:
    near = torch.sin(TIME) + 1e-4 * torch.cos(TIME)
    estimate = make_estimate(space("a", "b"), torch.full((2,), 0.5, dtype=DOUBLE), columns(torch.sin(TIME), near))
    assert torch.isfinite(estimate.std).all()
    assert len(estimate.undetermined) == 2 and "a is hardly determined: standard error" in estimate.undetermined[0]


def test_prior_determines_what_readings_do_not() -> None:
    signal = torch.sin(TIME)
    with_prior = columns(signal, signal) + torch.diag(torch.tensor([0.0, 100.0], dtype=DOUBLE))
    sure = certainty(with_prior)
    assert sure.std[1].item() == pytest.approx(0.1)
    assert sure.std[0].item() == pytest.approx(math.sqrt(0.01 + 1.0 / (signal**2).sum().item()))


def test_bounds_are_told() -> None:
    theta = torch.tensor([0.0, 1.0, 0.5], dtype=DOUBLE)
    assert parameters_at_bounds(space("a", "b", "c"), theta) == {"a": "low", "b": "high"}
    endless = ParameterSpace([Parameter("a", "m", 0.0)])
    assert parameters_at_bounds(endless, theta[:1]) == {}


def test_interval_is_that_of_the_distribution() -> None:
    estimate = make_estimate(
        space("a", "b"), torch.tensor([0.5, 0.25], dtype=DOUBLE), fisher_information(line(), SIGMA)
    )
    low, high = estimate.interval(0.9)
    torch.testing.assert_close((high - low) / 2, stats.norm.ppf(0.95) * estimate.std)
    diagonal = estimate.correlation.diagonal()
    torch.testing.assert_close(diagonal, torch.ones(2, dtype=DOUBLE))


def test_interval_of_an_estimate_at_a_bound_ends_there() -> None:
    theta = torch.tensor([0.0, 1.0], dtype=DOUBLE)
    estimate = make_estimate(space("a", "b"), theta, torch.diag(torch.tensor([400.0, 400.0], dtype=DOUBLE)))
    low, high = estimate.interval()
    reach = stats.norm.ppf(0.975) * 0.05
    torch.testing.assert_close(low, torch.tensor([0.0, 1.0 - reach], dtype=DOUBLE))
    torch.testing.assert_close(high, torch.tensor([reach, 1.0], dtype=DOUBLE))


def test_an_interval_ends_with_the_range_of_its_parameter() -> None:
    """Whether or not the estimate lies at the end of the range, 0 to 1."""
    theta = torch.tensor([0.05, 0.95], dtype=DOUBLE)
    estimate = make_estimate(space("a", "b"), theta, torch.diag(torch.tensor([100.0, 100.0], dtype=DOUBLE)))
    low, high = estimate.interval()
    reach = stats.norm.ppf(0.975) * 0.1
    torch.testing.assert_close(low, torch.tensor([0.0, 0.95 - reach], dtype=DOUBLE))
    torch.testing.assert_close(high, torch.tensor([0.05 + reach, 1.0], dtype=DOUBLE))


def test_plain_form_is_strict_json_and_says_none_for_no_number() -> None:
    estimate = make_estimate(
        space("a", "b"),
        torch.tensor([0.0, 0.5], dtype=DOUBLE),
        torch.diag(torch.tensor([4.0, 0.0], dtype=DOUBLE)),
        status="converged",
        noise_std=torch.tensor([1e-3]),
        reached={"steps": (5.0, 0.5), "gap": math.nan, "by": {"search": "l-shade"}},
    )
    plain = estimate.to_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["std"] == [0.5, None] and plain["covariance"] == [0.25, None, None, None]
    assert plain["covariance_shape"] == [2, 2] and plain["at_bounds"] == {"a": "low"}
    assert plain["reached"] == {"steps": [5.0, 0.5], "gap": None, "by": {"search": "l-shade"}}
    with pytest.raises(ValueError, match=r"reached\.engine: expected numbers, text"):
        replace(estimate, reached={"engine": np.random.default_rng}).to_dict()


def test_misuse_is_refused_in_words() -> None:
    with pytest.raises(ValueError, match=r"expected theta \(2,\) and information \(2, 2\)"):
        make_estimate(space("a", "b"), torch.zeros(3), torch.eye(3))
