"""Sealing, answering, scoring: tampering shows, interruptions resume, scores agree with the protocol's."""

from __future__ import annotations

import gzip
import importlib.util
import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdi_torch.blind import cases
from fdi_torch.blind.benchmark import always_null, blind_benchmark
from fdi_torch.blind.case_drafts import plans
from fdi_torch.blind.cases import Case, manifest, open_key, read_plant, read_recording, write_cases
from fdi_torch.blind.plants import three_tank
from fdi_torch.blind.score import by_effect, judge, summary, utility
from fdi_torch.blind.scored_rows import OWN, joined, misses, reliability, tables, write_rows
from fdi_torch.blind.sizes import size_errors, sizes
from fdi_torch.blind.statistics import clopper_pearson, mean_interval, median_interval, root_mean_square_interval
from fdi_torch.jobs.blind_results import LOG, write_results
from fdi_torch.logbook import read_run
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

RIG = three_tank()
LAG, DELAY, LEAK, WIDER = (
    {"effect": e, "location": p}
    for e, p in (("pump_lag", "Q1"), ("pump_delay", "Q1"), ("leak", "T2"), ("plugging", "OUT2"))
)
TRUTHS: list[tuple[str, list[dict[str, str]]]] = [("single", [LAG]), ("null", []), ("single", [LEAK])]


def sealed(out: Path, leave_out: tuple[str, ...] = ()) -> Path:
    """Three short cases made by hand; the fourth of a benchmark of four is missing."""
    rng, made = np.random.default_rng(0), []
    for plan, (kind, causes) in zip(plans(3, 1, ("single", "null")), TRUTHS, strict=True):
        commands, readings = np.round(rng.uniform(12, 72, (5, 2)), 1), rng.uniform(0.2, 0.5, (5, 3))
        truth = {"case": plan.name, "kind": kind, "causes": causes, "leave_out": list(leave_out)}
        truth["gap_rms_m"] = {"recording": 0.01, "holdout": 0.01}
        made.append(Case(plan, RIG, (commands, commands), (readings, readings), truth))
    write_cases(out, made, ["secret"] * 3)
    kinds = ["left_out"] if leave_out else ["single", "null"]
    spec = {"seed": 1, "rig": "three_tank", "kinds": kinds, "library": [], "leave_out": list(leave_out)}
    (out / "spec.json").write_text(json.dumps(spec))
    return out


def test_a_recording_comes_back_in_si_as_its_manifest_says(tmp_path: Path) -> None:
    recording = read_recording(sealed(tmp_path), manifest(tmp_path)["case0001"], "recording", RIG.plant)
    rng = np.random.default_rng(0)
    commands, readings = np.round(rng.uniform(12, 72, (5, 2)), 1), rng.uniform(0.2, 0.5, (5, 3))
    np.testing.assert_allclose(recording.inputs, commands * 1e-6, rtol=1e-12)
    np.testing.assert_allclose(recording.outputs, readings, atol=0.51e-5)
    assert recording.input_names == ("Q1", "Q2") and recording.output_names == ("h1", "h2", "h3")
    assert recording.source == "case0001/recording"
    assert recording.sha256 == manifest(tmp_path)["case0001"]["recording"]


def test_a_plant_comes_back_as_its_manifest_says(tmp_path: Path) -> None:
    line = manifest(sealed(tmp_path))["case0001"]
    assert read_plant(tmp_path, line) == RIG.plant
    path = tmp_path / "cases" / "case0001_plant.json"
    path.write_text(path.read_text().replace("0.6", "0.7"))
    with pytest.raises(ValueError, match="case0001: expected a plant of SHA-256"):
        read_plant(tmp_path, line)


def test_a_changed_recording_shows(tmp_path: Path) -> None:
    path = sealed(tmp_path) / "cases" / "case0002_holdout.csv.gz"
    text = gzip.decompress(path.read_bytes()).decode()
    last = text[-2]
    path.write_bytes(gzip.compress((text[:-2] + ("1" if last != "1" else "2") + "\n").encode(), mtime=0))
    with pytest.raises(ValueError, match="case0002: expected a holdout of SHA-256"):
        read_recording(tmp_path, manifest(tmp_path)["case0002"], "holdout", RIG.plant)


def test_a_changed_key_shows(tmp_path: Path) -> None:
    key = sealed(tmp_path) / "key.jsonl"
    assert open_key(tmp_path)["case0001"]["causes"] == [LAG]
    key.write_text(key.read_text().replace("pump_lag", "pump_gain"))
    with pytest.raises(ValueError, match="case0001: expected a key of SHA-256"):
        open_key(tmp_path)


def test_a_lost_key_shows(tmp_path: Path) -> None:
    key = sealed(tmp_path) / "key.jsonl"
    key.write_text("".join(key.read_text().splitlines(keepends=True)[1:]))
    with pytest.raises(ValueError, match="case0001: expected a sealed key, got none"):
        open_key(tmp_path)


def named(*causes: dict[str, str], verdict: str = "named") -> dict[str, Any]:
    return {"verdict": verdict, "causes": list(causes), "ambiguity_set": [list(causes)], "where": []}


class Counting:
    """A diagnosis that names the lag of pump Q1, counts its calls and fails at one of them."""

    def __init__(self, error: type[BaseException] | None = None, at: int = -1) -> None:
        self.calls, self.error, self.at = 0, error, at
        self.denied: list[tuple[str, ...]] = []

    def __call__(
        self, plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: tuple[str, ...] = ()
    ) -> dict[str, Any]:
        self.calls += 1
        self.denied.append(leave_out)
        if self.error and self.calls == self.at:
            raise self.error("broken pipe")
        return named(LAG) | {"closure": {"closed": math.nan}}


def run(out: Path, diagnose: Callable[..., dict[str, Any]], **options: Any) -> dict[str, Any]:
    """Scores by diagnosis and stratum."""
    rows = blind_benchmark(3, 1, out, diagnose, kinds=("single", "null"), **options)
    return {name: scores["strata"] for name, scores in tables(rows).get("three_tank", {}).items()}


def test_scores_and_baselines_of_a_small_benchmark(tmp_path: Path) -> None:
    scores = run(sealed(tmp_path), Counting(), rivals={"shy": always_null})
    assert scores["fdi"]["single"]["right"] | {"ci95": None} == {"of": 2, "hits": 1, "share": 0.5, "ci95": None}
    assert scores["fdi"]["null"]["false_alarm"]["hits"] == 1
    assert scores["fdi"]["all"]["named_wrong"]["hits"] == 2
    # Of the two single causes, only the outlet's leak may lie within tolerance.
    assert scores["always_null"]["all"]["right"]["hits"] == 2
    assert scores["shy"]["all"]["right"] == scores["always_null"]["all"]["right"]
    assert scores["random"]["all"]["right"]["of"] == 3


def test_an_interrupted_benchmark_resumes(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(sealed(tmp_path), Counting(KeyboardInterrupt, at=3))
    with (tmp_path / "answers_fdi.jsonl").open("a") as file:
        file.write('{"case": "case00')  # cut off in the middle of a line
    second = Counting()
    scores = run(tmp_path, second)
    assert second.calls == 1
    assert scores["fdi"]["all"]["cases"] == 3


def test_out_of_time_it_scores_what_is_answered_and_goes_on_later(tmp_path: Path) -> None:
    first = Counting()
    assert run(sealed(tmp_path), first, minutes=0.0) == {} and first.calls == 0
    assert run(tmp_path, first)["fdi"]["all"]["cases"] == first.calls == 3


def test_it_says_how_far_it_is_and_how_long_it_will_take(tmp_path: Path) -> None:
    said: list[tuple[float, str]] = []
    run(sealed(tmp_path), Counting(), tell=lambda share, text: said.append((share, text)))
    assert [share for share, _ in said] == pytest.approx([n / 9 for n in range(1, 10)])
    assert said[-1][1].endswith("9 of 9 answers, 0 s left") and "fdi says named of case0001" in said[2][1]


def test_a_crash_is_a_wrong_answer_and_ends_nothing(tmp_path: Path) -> None:
    scores = run(sealed(tmp_path), Counting(RuntimeError, at=1))
    assert scores["fdi"]["all"]["crash"]["hits"] == 1
    assert "RuntimeError: broken pipe" in (tmp_path / "answers_fdi.jsonl").read_text()


def test_the_effect_to_leave_out_reaches_the_diagnosis(tmp_path: Path) -> None:
    diagnose = Counting()
    blind_benchmark(3, 1, sealed(tmp_path, ("pump_lag",)), diagnose, leave_out=("pump_lag",))
    assert diagnose.denied == [("pump_lag",)] * 3


def test_another_benchmark_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="take another folder"):
        blind_benchmark(3, 2, sealed(tmp_path), Counting(), kinds=("single", "null"))


def row(kind: str, right: bool, seed: int = 1, index: int = 0, **more: Any) -> dict[str, Any]:
    about = {"by": "fdi", "rig": "three_tank", "seed": seed, "index": index, "case": f"case{index}", "kind": kind}
    judged = {"right": right, "named_wrong": False, "truth": [["pump_lag", "Q1"]], "effect": "pump_lag", "causes": []}
    return about | judged | {"verdict": "named", "utility": 1.0, "sec": 3.0, "code": "abc"} | more


def folder(path: Path, *rows: dict[str, Any]) -> Path:
    path.mkdir()
    write_rows(path, rows)
    return path


def test_folders_join_into_one_table_a_rig(tmp_path: Path) -> None:
    first = folder(tmp_path / "a", row("single", True), row("single", False, index=1))
    second = folder(tmp_path / "b", row("single", True, seed=2), row("left_out", True), row("null", True, rig="other"))
    found = tables(joined([first, second]))
    assert list(found) == ["three_tank", "three_tank, effect left out", "other"]
    assert found["three_tank"]["fdi"]["strata"]["single"]["right"]["of"] == 3


def test_a_case_answered_again_counts_once_as_it_was_answered_last(tmp_path: Path) -> None:
    first, second = (folder(tmp_path / name, row("single", name == "b")) for name in ("a", "b"))
    assert tables(joined([first, second]))["three_tank"]["fdi"]["strata"]["all"]["right"]["hits"] == 1
    assert tables(joined([second, first]))["three_tank"]["fdi"]["strata"]["all"]["right"]["hits"] == 0


def test_a_folder_without_answers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a benchmark's folder"):
        joined([tmp_path])


def test_what_is_concluded_stands_in_the_folder(tmp_path: Path) -> None:
    rows = [row("single", True, stated=0.9, stated_right=True), row("single", False, index=1)]
    found = write_results(tmp_path / "out", rows, {"join": ["a"]}, [])
    assert write_results(tmp_path / "out", rows, {"join": ["a"]}, []) == found
    assert json.loads((tmp_path / "out" / "scores.json").read_text()).keys() == {"three_tank"}
    text = (tmp_path / "out" / "scores.md").read_text()
    assert "2 cases of seeds 1, answered by the code of abc (2)." in text
    assert "| single | 1/2 (1 .. 99 %) |" in text and "| 0.5 to 0.9 | 0.900 | 1/1 (2 .. 100 %) |" in text
    assert "| single | three_tank | 1 | case1 | pump_lag at Q1 | named |  |" in text
    log = read_run(tmp_path / "out" / LOG)
    assert [m.payload["truth"] for m in log.messages(["/study/trial"])] == [["pump_lag@Q1"]] * 2
    assert log.metadata["fdi_torch.result"]["three_tank.single.right"] == "1/2"


@pytest.mark.parametrize(
    ("answer", "truth", "expected"),
    [
        ({"a"}, {"a"}, 1.0),
        (set(), {"a"}, 1 - 63 / 124),
        ({"b"}, {"a"}, 1 - 2 / 124 - 62 / 124),
        ({"a", "b"}, {"a"}, 1 - 3 / 124),
        ({"a"}, set(), 1 - 2 / 124),
    ],
)
def test_utility_by_hand(answer: set[str], truth: set[str], expected: float) -> None:
    assert utility({(a, "X") for a in answer}, {(t, "X") for t in truth}, 62) == pytest.approx(expected, abs=1e-15)


def judged(kind: str, causes: list[dict[str, str]], answer: dict[str, Any]) -> dict[str, Any]:
    return judge({"kind": kind, "causes": causes}, answer, RIG.plant)


def test_a_leak_at_the_floor_and_a_wider_outlet_are_one_thing() -> None:
    assert judged("single", [LEAK], named(WIDER))["right"]
    assert judged("twins", [WIDER], named(LEAK))["right"]
    assert judged("weak", [LEAK], named(verdict="no_gap"))["right"]
    assert not judged("weak", [LAG], named(verdict="no_gap"))["right"]


def test_something_unknown_beside_a_cause_is_no_pair_of_effect_and_place() -> None:
    unknown = {"effect": "unknown", "location": "T1"}
    with_it, without = (
        {"verdict": "unknown", "causes": causes, "posterior": [{"causes": causes, "probability": 1.0}]}
        for causes in ([LAG, unknown], [LAG])
    )
    assert judged("single", [LAG], with_it)["utility"] == judged("single", [LAG], without)["utility"] == 1.0


def test_a_wrong_answer_is_listed_with_the_law_of_its_unknown() -> None:
    truth = [LAG, {"effect": "unknown", "location": "P13", "really": "siphon"}]
    about = {"by": OWN, "rig": "three_tank", "seed": 1, "case": "case1"}
    (row,) = misses([judged("mixed", truth, named(LEAK)) | about]).rows
    assert "siphon at P13" in row[4] and "pump_lag at Q1" in row[4]


def test_unknown_counts_at_its_place_only() -> None:
    truth = [{"effect": "unknown", "location": "P13"}]
    there, elsewhere = ({"verdict": "unknown", "where": [{"location": p}]} for p in ("P13", "P32"))
    assert judged("unknown", truth, there)["right"] and not judged("unknown", truth, elsewhere)["right"]
    assert judged("left_out", [LAG], {"verdict": "unknown", "where": [{"location": "Q1"}]})["right"]
    assert judged("left_out", [LAG], named(DELAY))["named_wrong"]


def test_closure_is_compared_with_the_true_noise() -> None:
    truth = {"kind": "single", "causes": [LAG], "noise_rms_m": {"holdout": [1e-3] * 3}, "repeats": 1.0}
    closure = {"recalibrated": 0.5, "augmented": 0.12, "closed": 0.99}
    expected = 1 - (0.12**2 - 0.1**2) / (0.5**2 - 0.1**2)
    row = judge(truth, named(LAG) | {"closure": closure}, RIG.plant)
    assert row["closed_error"] == pytest.approx(0.99 - expected, abs=1e-12) and row["closed_within"]
    in_metres = {"recalibrated": 0.005, "augmented": 0.0012, "closed": 0.9, "unit": "m"}
    row = judge(truth, named(LAG) | {"closure": in_metres}, RIG.plant)
    assert row["closed_error"] == pytest.approx(expected - 0.9, abs=1e-12) and not row["closed_within"]
    silent = judge(truth, named(LAG) | {"closure": closure | {"closed": None}}, RIG.plant)
    assert silent["closed_within"] is False
    no_gap_left = judge(truth, named(LAG) | {"closure": closure | {"recalibrated": 0.101}}, RIG.plant)
    assert "closed_within" not in no_gap_left


def test_rows_of_one_effect_are_gathered() -> None:
    rows = [judged("single", [LAG], named(LAG)), judged("pair", [LAG, WIDER], named(LAG)), judged("null", [], named())]
    assert by_effect(rows)["pump_lag"]["cases"] == 1
    assert summary(rows)["pair"]["right"]["hits"] == 0


def test_exact_intervals_are_the_tabled_ones() -> None:
    assert clopper_pearson(0, 10) == pytest.approx((0, 0.30850), abs=1e-5)
    assert clopper_pearson(8, 10) == pytest.approx((0.44390, 0.97479), abs=1e-5)
    assert clopper_pearson(10, 10) == pytest.approx((0.69150, 1), abs=1e-5)
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2, 2 - 1.96 / math.sqrt(3), 2 + 1.96 / math.sqrt(3)))
    assert all(math.isnan(v) for v in mean_interval([]))


def test_the_median_lies_between_order_statistics() -> None:
    # The sign test's table: of 10 values the 2nd and the 9th hold the median in 97.9 % of samples.
    assert median_interval([float(k) for k in range(10, 0, -1)]) == (5.5, 2.0, 9.0)
    assert median_interval([3.0])[0] == 3.0 and math.isnan(median_interval([3.0])[1])
    assert all(math.isnan(v) for v in median_interval([]))


def test_calibration_counts_how_often_what_was_given_so_much_is_true() -> None:
    rows = [{"stated": p, "stated_right": right} for p, right in ((0.9, True), (0.9, False), (1.0, True))]
    found = reliability([*rows, {"verdict": "crash"}])
    assert [(b["stated"], b["hits"], b["of"]) for b in found] == [(0.9, 1, 2), (1.0, 1, 1)]


@pytest.mark.parametrize(
    ("kind", "truth", "best", "right"),
    [
        ("single", [LAG], {"causes": [LAG]}, True),
        ("single", [LAG], {"causes": [LAG, WIDER]}, False),
        ("messy", [LAG], {"causes": [LAG, WIDER]}, True),
        ("null", [], {"causes": []}, True),
        (
            "unknown",
            [{"effect": "unknown", "location": "Q1"}],
            {"causes": [{"effect": "unknown", "location": "Q1"}]},
            True,
        ),
        (
            "unknown",
            [{"effect": "unknown", "location": "Q1"}],
            {"causes": [{"effect": "unknown", "location": "T1"}]},
            False,
        ),
    ],
)
def test_the_best_explanation_is_judged_beside_its_probability(
    kind: str, truth: list[dict[str, str]], best: dict[str, Any], right: bool
) -> None:
    weaker = {"causes": [DELAY], "probability": 0.1}
    row = judged(kind, truth, named(LAG) | {"posterior": [weaker, best | {"probability": 0.8}]})
    assert (row["stated"], row["stated_right"]) == (0.8, right)


def protocol_judge(name: str) -> Callable[..., Any]:
    for folder in Path(__file__).resolve().parents:
        path = folder / "shared" / f"{name}.py"
        if path.exists():
            spec = importlib.util.spec_from_file_location(name, path)
            assert spec and spec.loader
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            return module.judge  # type: ignore[no-any-return]
    pytest.skip("the protocol's scorer is not beside the checkout")


@pytest.mark.data
def test_scores_agree_with_the_protocols_scorer() -> None:
    theirs = protocol_judge("score_practice")
    truths = [[], [LAG], [LEAK], [WIDER], [LAG, WIDER], [{"effect": "unknown", "location": "Q1"}]]
    answers = [
        named(*causes, verdict=verdict)
        | {"where": [{"location": place}] if place else []}
        | (
            {"posterior": [{"causes": list(causes), "probability": 0.6}, {"causes": [DELAY], "probability": 0.3}]}
            if post
            else {}
        )
        for verdict, causes, place, post in itertools.product(
            ("no_gap", "named", "ambiguous", "unknown", "crash"),
            ((), (LAG,), (LEAK,), (WIDER,), (WIDER, LAG), (DELAY,)),
            ("Q1", "T2", None),
            (False, True),
        )
    ]
    compared = 0
    for kind, truth in (
        *itertools.product(("single", "pair", "weak", "poor"), truths[1:5]),
        ("null", []),
        ("messy", [LAG]),
        ("unknown", truths[5]),
    ):
        for answer in answers:
            expected, found = theirs(kind, truth, answer), judged(kind, truth, answer)
            for name in ("right", "place", "in_set", "missed", "named_wrong", "false_alarm", "set_size"):
                assert expected.get(name) == found.get(name), (name, kind, truth, answer)
            assert found["utility"] == pytest.approx(expected["utility"], abs=1e-14)
            compared += 1
    assert compared == 19 * len(answers)


UNSEEN = {"effect": "unknown", "location": "Q1"}


@pytest.mark.data
def test_scores_of_the_second_edition_agree_with_the_protocols_scorer() -> None:
    theirs, compared = protocol_judge("score_practice2"), 0
    causes = ((), (LAG,), (LEAK,), (WIDER,), (DELAY,), (UNSEEN,), (LAG, UNSEEN), (LEAK, UNSEEN), (LEAK, LAG))
    sets = ((), ((LAG,), (LEAK,)), ((LEAK, UNSEEN),))
    answers = [
        {"verdict": verdict, "causes": list(own), "ambiguity_set": [list(s) for s in several], "where": where}
        for verdict, own, several, where in itertools.product(
            ("no_gap", "named", "ambiguous", "unknown", "crash"), causes, sets, ([], [{"location": "Q1"}])
        )
    ]
    for kind, truth in (
        *itertools.product(("site", "hidden", "loop", "dsingle"), ([LAG], [LEAK], [WIDER])),
        ("site", [LEAK, LAG]),
        ("law", [UNSEEN]),
        ("mixed", [LEAK, UNSEEN]),
        ("null", []),
        ("dnull", []),
    ):
        for answer in answers:
            found = judged(kind, truth, answer)
            assert (found["right"], found["named_wrong"]) == theirs(kind, truth, answer), (kind, truth, answer)
            compared += 1
    assert compared == 17 * len(answers)


def test_a_cause_beside_an_unknown_counts_when_both_are_said() -> None:
    both = {"verdict": "unknown", "causes": [LEAK, UNSEEN], "ambiguity_set": [[LEAK, UNSEEN]]}
    row = judged("mixed", [LEAK, UNSEEN], both)
    assert row["right"] and row["cause_beside"] and row["in_set"]
    alone = judged("mixed", [LEAK, UNSEEN], both | {"causes": [UNSEEN]})
    assert alone["right"] and not alone["cause_beside"]
    best = [{"causes": [LEAK, UNSEEN], "probability": 0.97}]
    assert judged("mixed", [LEAK, UNSEEN], both | {"posterior": best})["stated_right"]


def test_an_unknown_is_no_pair_of_the_utility() -> None:
    answer = named(LAG, UNSEEN) | {"posterior": [{"causes": [LAG, UNSEEN], "probability": 0.9}]}
    assert judged("single", [LAG], answer)["utility"] == 1.0


def sized(effect: str, place: str, law: str, numbers: dict[str, float], **parameters: Any) -> list[str]:
    """Errors of the sizes of one named cause."""
    deviation = {"effect": effect, "location": place, "law": law, "numbers": numbers}
    truth = {"causes": [{"effect": effect, "location": place}], "deviations": [deviation]}
    return size_errors(truth, [{"effect": effect, "location": place, "parameters": parameters}], RIG.plant)


def test_a_size_is_judged_in_its_standard_errors() -> None:
    lag = {"value": 0.15, "std": 0.01, "unit": "min"}
    assert sized("pump_lag", "Q1", "slow", {"tau": 8.1}, time_constant=lag) == ["pump_lag 1.5"]
    share = {"value": 0.12, "std": 0.02, "unit": "1"}
    bore = 0.6 * 0.6e-4 * math.sqrt(2 * 9.81)
    assert sized("leak", "T1", "floor_hole", {"conductance": 0.1 * bore}, size=share) == ["leak 1"]
    # Laws with another equation, and sizes without a standard error, are not judged.
    assert sized("pump_lag", "Q1", "slow_in_two_poles", {"tau": 8.1}, time_constant=lag) == []
    assert sized("pump_lag", "Q1", "slow", {"tau": 8.1}, time_constant=lag | {"std": None}) == []


def test_a_size_at_a_rig_of_another_pace_is_judged_there() -> None:
    deviation = {"effect": "pump_lag", "location": "Q1", "law": "slow", "numbers": {"tau": 8.0}}
    scales = {"time_s": 100.0, "length_m": 10.0, "area_m2": 1e4}
    truth = {"causes": [LAG], "deviations": [deviation], "scales": scales}
    answer = [LAG | {"parameters": {"time_constant": {"value": 780.0, "std": 10.0, "unit": "s"}}}]
    assert size_errors(truth, answer, RIG.plant) == ["pump_lag -2"]


def test_sizes_are_summed_up_by_effect() -> None:
    found = sizes([{"z": ["pump_lag 3", "leak 0"]}, {"z": ["pump_lag -4"]}, {"z": None}, {}])
    assert found["pump_lag"]["rms"]["mean"] == pytest.approx(math.sqrt(12.5))
    assert found["all"]["within"] | {"ci95": None} == {"of": 3, "hits": 1, "share": 1 / 3, "ci95": None}
    # Tabled chi-square of 2: 0.0506 and 7.378 hold 95 %.
    low, high = root_mean_square_interval([3.0, 4.0])[1:]
    assert (low, high) == pytest.approx((math.sqrt(25 / 7.3778), math.sqrt(25 / 0.050636)), rel=1e-4)


@pytest.mark.slow
def test_a_benchmark_from_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "STEP", 0.5)
    rows = blind_benchmark(9, 5, tmp_path, Counting())
    assert len([r for r in rows if r["by"] == "fdi"]) == 9
    assert blind_benchmark(9, 5, tmp_path, Counting(RuntimeError, at=1)) == rows
