"""The printed answer of a gap diagnosis."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from fdi_torch.amounts import probability_words
from fdi_torch.cli.gap_text import next_steps, show
from fdi_torch.cli.screen import Screen
from fdi_torch.gap.answer import Amount, Answer, Cause, ProbableExplanation, adopted
from fdi_torch.gap.constant_remarks import constant_remarks
from fdi_torch.gap.verdict_words import causes_of, verdict_sentence
from fdi_torch.jobs.python_results import GapResult
from fdi_torch.quantities import displayed_in
from fdi_torch.report.gap_tables import cause_table, flows_that_matter
from tests.test_gap import nominal_plant

LEAK = Cause("leak", "T1", {"size": Amount(0.2, 0.01, "1")})
ODD = ("unknown", "Q1")
ROUNDS = "sensor_quantization"
FLOWS = {
    "T1": {"std": 2.5e-6, "unit": "m^3/s", "correlation_time": 15.0},
    "T2": {"std": 1e-6, "unit": "m^3/s", "correlation_time": 0.0},
}
BOTH = Answer(
    verdict="unknown",
    p_value=0.0,
    where=[("Q1", 0.97), ("T1", 0.96), ("P13", 1e-6)],
    causes=[LEAK, Cause(*ODD)],
    ambiguity_set=[],
    posterior=[ProbableExplanation((("leak", "T1"), ODD), 0.97), ProbableExplanation((("leak", "T1"),), 0.01)],
    closure={},
    noise={},
    unexamined=0.02,
    disturbances=FLOWS,
)


@pytest.mark.parametrize(
    ("closed", "most_closed", "warning"),
    [
        (-0.5, -0.1, "Do not adopt these causes: they make the prediction of the hold-out worse. The gap comes"),
        (-0.5, 0.1, "These causes do not close the gap of the hold-out. The gap comes"),
        (0.5, 0.9, "The gap comes"),
        (None, None, "The gap comes"),
    ],
)
def test_causes_that_do_not_carry_over_to_the_holdout_are_said_first(
    closed: float | None, most_closed: float | None, warning: str
) -> None:
    interval = None if most_closed is None else [-0.9, most_closed]
    answer = replace(BOTH, closure={"closed": closed, "closed_ci95": interval})
    assert verdict_sentence(answer.to_dict()).startswith(warning)
    promised = any("no longer take the gap for a fault" in s for s in next_steps(answer, True, None, None, "new.yaml"))
    assert promised is warning.startswith("The gap")


def test_the_terminal_prints_the_unknown_and_the_named_causes(capsys: pytest.CaptureFixture[str]) -> None:
    show(BOTH, nominal_plant(), [], Screen())
    said = capsys.readouterr().out
    assert said.startswith(
        "The gap comes from leak at T1 and something unknown at Q1, probability 97.0 %; no effect of the library "
        "describes the unknown part."
    )
    rows = [line.split() for line in said.splitlines()]
    assert ["T1", "2.5", "cm^3/s", "15", "s"] in rows and ["T2", "1", "cm^3/s", "none"] in rows
    assert ["explanations", "that", "were", "not", "examined", "2.0", "%"] in rows
    assert ["Q1", "97.0", "%"] in rows and not any(row[:1] == ["P13"] for row in rows)


def test_errors_on_a_hold_out_are_those_of_the_models_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    errors = {"nominal": 12.0, "recalibrated": 11.0, "augmented": 11.0, "ceiling": 11.0, "noise_floor": 0.1}
    closure = {"unit": "cm", "units": {"h1": "cm"}, "per_sensor": {"h1": errors}, "holdouts": ["b.csv"], **errors}
    closure |= {"closed": 0.0, "closed_ci95": [0.0, 0.0], "augmented_with": [], "frozen": errors}
    told = {}
    for verdict in ("no_gap", "unknown", "named"):
        show(replace(BOTH, verdict=verdict, closure=closure), nominal_plant(), [], Screen())
        text = capsys.readouterr().out.partition("error of free runs on b.csv, cm\n")[2]
        told[verdict] = text
    models = [line.rsplit(maxsplit=2)[0] for line in told["no_gap"].splitlines()[1:4]]
    assert models == ["nominal model", "recalibrated", "noise"] and "closes" not in told["no_gap"]
    assert "with the causes and a freely fitted curve" in told["unknown"] and "curves" not in told["unknown"]
    assert "with freely fitted curves there" in told["named"] and "0.0 % of the gap closes" in told["named"]


def test_random_flows_below_the_noise_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """A flow of 2.5 cm^3/s moves T1, which empties in some 200 s from 154 cm^2, by 3 cm; 0.7 mm^3/s by 0.01 mm."""
    noise = {name: {"std": 1e-3, "unit": "m"} for name in ("h1", "h2", "h3")}
    small = {"std": 7e-10, "unit": "m^3/s", "correlation_time": 320.0}
    answer = replace(BOTH, noise=noise, disturbances={"T1": FLOWS["T1"], "T2": small})
    assert list(flows_that_matter(answer.to_dict(), nominal_plant())) == ["T1"]
    show(replace(answer, disturbances={"T2": small}), nominal_plant(), [], Screen())
    assert "random" not in capsys.readouterr().out


def test_constants_that_stay_out_of_their_tolerances_are_to_be_calibrated_first(
    capsys: pytest.CaptureFixture[str],
) -> None:
    beyond = {"nominal": 0.6, "tolerance": 0.02, "recalibrated": 0.66, "augmented": 0.66, "std": 0.001, "unit": "1"}
    absorbed = {**beyond, "augmented": 0.61}  # back within its tolerance with the causes
    answer = replace(BOTH, constants={"P13.discharge_coefficient": beyond, "OUT2.discharge_coefficient": absorbed})
    [remark] = constant_remarks(answer.constants, has_causes=True)
    words = "more than 2 tolerances off"
    off = f"even with the causes, P13.discharge_coefficient (0.66, not 0.6) is {words} its nominal value: calibrate"
    assert remark.startswith(off) and "OUT2" not in remark
    two = constant_remarks({"T1.area": {**beyond, "unit": "m^2"}, "Q1.gain": beyond}, has_causes=True)[0]
    assert f"T1.area (6600 cm^2, not 6000 cm^2) and Q1.gain (0.66, not 0.6) are {words} their nominal values" in two
    no_gap = replace(answer, verdict="no_gap", causes=[])
    assert constant_remarks(no_gap.constants, has_causes=False)[0].startswith("P13.discharge_coefficient (0.66")
    show(no_gap, nominal_plant(), [], Screen())
    said = capsys.readouterr().out
    assert "constants with a tolerance\nconstant                    nominal  tolerance  fitted  std error" in said
    assert [line.split()[0] for line in said.splitlines()[1:] if ".discharge" in line] == [*answer.constants]
    show(answer, nominal_plant(), [], Screen())
    assert "constants more than 2 tolerances off\n" in capsys.readouterr().out


def test_a_constant_that_moved_far_within_a_generous_tolerance_may_hide_a_fault() -> None:
    """A pipe that is plugged by a quarter, within a tolerance of 30 %."""
    plugged = {"nominal": 0.6, "tolerance": 0.18, "augmented": 0.45, "std": 0.002, "unit": "1"}
    [remark] = constant_remarks({"P.discharge_coefficient": plugged}, has_causes=False)
    assert remark.startswith(
        "the fit moved P.discharge_coefficient from 0.6 to 0.45 (-25 %), within its tolerance: a fault"
    )
    usual, doubtful = {**plugged, "augmented": 0.58}, {**plugged, "std": 0.06}
    offset = {**plugged, "nominal": 0.0, "augmented": 0.1, "unit": "m"}  # has no size to compare it with
    assert constant_remarks({"a": usual, "b": doubtful, "h.offset": offset}, has_causes=False) == []


def test_effects_that_are_named_are_not_among_those_that_the_inputs_hardly_show(
    capsys: pytest.CaptureFixture[str],
) -> None:
    hidden = [{"effect": e, "location": at} for e, at in (("leak", "T1"), ("plugging", "P13"), ("leak", "T2"))]
    same = replace(LEAK, same_as=(("plugging", "P13"),))
    show(replace(BOTH, causes=[same], excitation={"hidden": hidden}), nominal_plant(), [], Screen())
    assert "- these inputs hardly show leak at T2: at a usual size" in capsys.readouterr().out


def test_an_ambiguous_verdict_states_which_causes_are_certain() -> None:
    sets = [(("leak", "T1"), ODD), (("leak", "T1"),)]
    posterior = [ProbableExplanation((("leak", "T1"), ODD), 0.6), ProbableExplanation((("leak", "T1"),), 0.39)]
    answer = replace(BOTH, verdict="ambiguous", ambiguity_set=sets, posterior=posterior)
    assert answer.certain == [("leak", "T1")]
    assert verdict_sentence(answer.to_dict()) == (
        "There is a gap; 2 explanations are plausible at 95 %, the likeliest is leak at T1 and something unknown at "
        "Q1, probability 60.0 %. Present with at least 95 %: leak at T1."
    )


def test_several_places_of_one_unknown_are_told_as_such() -> None:
    leak, posterior = (
        ("leak", "T1"),
        [ProbableExplanation((("leak", "T1"), ("unknown", at)), p) for p, at in ((0.6, "Q1"), (0.38, "h1"))],
    )
    answer = replace(BOTH, ambiguity_set=[(leak, ODD), (leak, ("unknown", "h1"))], posterior=posterior)
    assert answer.verdict == "unknown"
    assert verdict_sentence(answer.to_dict()) == (
        "The gap comes from something that no effect of the library describes; 2 explanations are plausible at 95 %, "
        "the likeliest is leak at T1 and something unknown at Q1, probability 60.0 %. Present with at least 95 %: "
        "leak at T1."
    )


def test_a_single_explanation_that_does_not_suffice_states_the_unfitted_probability() -> None:
    posterior = [ProbableExplanation((("leak", "T1"),), 0.8)]
    answer = replace(BOTH, verdict="ambiguous", ambiguity_set=[(("leak", "T1"),)], posterior=posterior, unexamined=0.2)
    assert verdict_sentence(answer.to_dict()) == (
        "There is a gap; the likeliest is leak at T1, probability 80.0 %. "
        "Explanations that were not fitted have 20.0 % together."
    )


def test_an_explanation_whose_fit_has_not_converged_says_so() -> None:
    alone = [ProbableExplanation((("leak", "T1"),), 0.9999)]
    answer = replace(BOTH, verdict="ambiguous", ambiguity_set=[alone[0].causes], posterior=alone, converged=False)
    assert verdict_sentence(answer.to_dict()) == (
        "There is a gap; the likeliest is leak at T1, probability over 99.9 %. "
        "Its fit has not converged, so that its sizes and its probability may be wrong."
    )
    assert not any("two explanations" in step for step in next_steps(answer, True, None, None, None))


def test_every_verdict_on_causes_says_that_their_fit_has_not_converged() -> None:
    """Also that with something unknown; without causes, a better fit would change nothing."""
    warning = "Its fit has not converged, so that its sizes and its probability may be wrong."
    posterior = [ProbableExplanation((("leak", "T1"), ODD), 0.97)]
    unknown = replace(BOTH, ambiguity_set=[posterior[0].causes], posterior=posterior)
    assert unknown.verdict == "unknown" and "converged" not in verdict_sentence(unknown.to_dict())
    for answer in (unknown, replace(BOTH, verdict="named"), replace(BOTH, verdict="ambiguous")):
        sentence = verdict_sentence(replace(answer, converged=False).to_dict())
        assert sentence.count(warning) == 1 and "Present with" not in sentence
    assert warning not in verdict_sentence(replace(BOTH, verdict="no_gap", converged=False).to_dict())


def test_where_the_plant_as_it_is_remains_plausible_there_may_be_a_gap() -> None:
    posterior = [ProbableExplanation((), 0.88), ProbableExplanation((("unknown", "T1"),), 0.11)]
    answer = replace(BOTH, verdict="ambiguous", ambiguity_set=[(), (("unknown", "T1"),)], posterior=posterior)
    assert verdict_sentence(answer.to_dict()) == (
        "There may be a gap; 2 explanations are plausible at 95 %, the likeliest is nothing beyond tolerances, "
        "probability 88.0 %."
    )


def test_a_recording_that_is_only_rounded_may_have_no_gap() -> None:
    rounded = (ROUNDS, "h1")
    posterior = [ProbableExplanation((rounded,), 0.7), ProbableExplanation((rounded, ("leak", "T1")), 0.29)]
    answer = replace(
        BOTH, verdict="ambiguous", causes=[], ambiguity_set=[e.causes for e in posterior], posterior=posterior
    )
    assert verdict_sentence(answer.to_dict()).startswith("There may be a gap; ")


def test_an_unknown_is_nothing_to_adopt() -> None:
    alone = replace(BOTH, causes=[Cause(*ODD)])
    assert adopted(nominal_plant(), alone).effects == ()
    assert [p.effect for p in adopted(nominal_plant(), BOTH).effects] == ["leak"]
    assert not any("--adopt FILE writes" in step for step in next_steps(alone, True, None, None, None))
    assert any("--adopt FILE writes" in step for step in next_steps(BOTH, True, None, None, None))
    unsure = replace(BOTH, verdict="ambiguous")
    assert not any("--adopt FILE writes" in step for step in next_steps(unsure, True, None, None, None))
    refused = "nothing adopted: the fit of the likeliest explanation has not converged"
    told = next_steps(BOTH, True, None, None, None, refused=refused)
    assert refused in told and not any("--adopt FILE writes" in step for step in told)


@pytest.mark.parametrize(("probability", "words"), [(1.0, "over 99.9 %"), (0.9721, "97.2 %"), (5e-4, "under 0.1 %")])
def test_no_probability_is_certain(probability: float, words: str) -> None:
    assert probability_words(probability) == words


def test_an_unknown_of_either_format_is_read_once() -> None:
    odd = {"effect": "unknown", "location": "Q1"}
    assert causes_of({"causes": [], "unknown_at": "Q1"}) == [odd]
    assert causes_of({"causes": [odd], "unknown_at": "Q1"}) == [odd]
    assert verdict_sentence({}) == ""


def test_rounded_readings_are_no_fault_and_are_told_in_the_unit_of_the_sensor(
    capsys: pytest.CaptureFixture[str],
) -> None:
    step = {"step": Amount(0.01, 0.0, "1")}
    posterior = [ProbableExplanation((("leak", "T1"), (ROUNDS, "h1")), 0.99)]
    both = replace(BOTH, verdict="named", causes=[LEAK, Cause(ROUNDS, "h1", step)], posterior=posterior, unexamined=0.0)
    with displayed_in({f"h1.{ROUNDS}.step": "%"}):
        show(both, nominal_plant(), ["do this"], Screen())
        said = capsys.readouterr().out
        assert said.startswith(
            "The gap comes from leak at T1, probability 99.0 %. Readings are rounded, which is no fault: h1 to 1 %.\n"
            "- next: do this\n"
        )
        assert ROUNDS not in said
        alone = replace(
            both, causes=[Cause(ROUNDS, "h1", step)], posterior=[ProbableExplanation(((ROUNDS, "h1"),), 0.99)]
        )
        assert verdict_sentence(alone.to_dict()) == (
            "No gap: the plant file explains the recording within rounding, noise and tolerances, probability 99.0 %. "
            "Readings are rounded, which is no fault: h1 to 1 %."
        )


def test_a_verdict_without_a_gap_names_the_constants_that_the_table_shows_far_off() -> None:
    near = {"nominal": 0.6, "tolerance": 0.02, "augmented": 0.62, "std": 0.001, "unit": "1"}
    far = near | {"augmented": 0.54}
    answer = {"verdict": "no_gap", "constants": {"P1.discharge_coefficient": near}}
    assert verdict_sentence(answer) == "No gap: the plant file explains the recording within noise and tolerances."
    answer["constants"] = {"P1.discharge_coefficient": near, "P2.discharge_coefficient": far}
    assert verdict_sentence(answer) == (
        "No gap: apart from P2.discharge_coefficient (-3 tolerances off), beyond its tolerance, the plant file "
        "explains the recording within noise."
    )


def test_the_flow_of_a_leak_stands_beside_its_size(capsys: pytest.CaptureFixture[str]) -> None:
    """On the terminal, in Python, in the JSON and on the page, in the user's units."""
    answer = replace(BOTH, causes=[replace(LEAK, flow=25e-6)])
    with displayed_in({"m^3/s": "l/min"}):
        show(answer, nominal_plant(), [], Screen())
        assert re.search(r"leak +T1 +flow at mean levels +1.5 +l/min", capsys.readouterr().out)
        page_rows = cause_table(answer.to_dict()).cells()
    assert page_rows[1] == ["leak", "T1", "flow at mean levels", "1.5", "", "l/min"]
    rows = GapResult(answer, nominal_plant(), Path("gap.mcap")).table().columns
    assert rows["parameter"] == ["size", "flow at mean levels"] and rows["value"][1] == pytest.approx(25.0)
    assert answer.to_dict()["causes"][0]["flow"] == 25e-6 and "flow" not in BOTH.to_dict()["causes"][0]
