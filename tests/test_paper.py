"""The paper's page: tables assembled from results, every equation's code found, a row of Table 2 made again."""

from __future__ import annotations

import importlib
import re
from operator import attrgetter

import pytest
import torch

from benchmarks.paper import paper_tables
from benchmarks.paper.equations import EQUATIONS, ERRATA, STATEMENTS
from benchmarks.paper.modes import Modes, all_modes, called_present, confusion, diagnose_modes, mode_name
from benchmarks.paper.online import follow, varies
from benchmarks.paper.paper_page import PAGE, WINDOWS
from benchmarks.paper.published import PARAMETERS, TABLE_2, TABLE_3
from benchmarks.paper.table_cases import Case, shipped_run, solve
from fdi_torch.config.run_file import load_run
from fdi_torch.config.yaml_files import SHIPPED
from fdi_torch.recording import Recording

TRUTH = torch.tensor([0.1, 0.6, 0.5, 1.0, 1.0], dtype=torch.float64)


def case(name: str = "table2_3d", snr: float | None = None) -> Case:
    """A row whose search is off by 0.01 and whose refinement by 0.001."""
    std = torch.full((5,), 0.002, dtype=torch.float64)
    return Case(
        name, snr, TRUTH, TRUTH + 0.01, TRUTH + 0.001, std, TRUTH + 0.004, std, 2.999, 2.998,
        TRUTH.expand(7, 5), "converged", (1.0, 0.05),
    )  # fmt: skip


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def test_every_equation_is_listed_once() -> None:
    assert [n for e in EQUATIONS for n in e.numbers] == list(range(1, 36))


PLACES = {place for e in EQUATIONS for place in e.places} | {place for *_, places in STATEMENTS for place in places}


@pytest.mark.parametrize("place", sorted(PLACES))
def test_the_code_of_every_equation_exists(place: str) -> None:
    module, name = place.split(":")
    found = importlib.import_module(module if module.startswith("benchmarks.") else f"fdi_torch.{module}")
    first, *rest = name.split(".")
    attribute = getattr(found, first)
    fields = getattr(attribute, "__dataclass_fields__", {})
    assert not rest or rest[0] in fields or attrgetter(".".join(rest))(attribute) is not None


def test_errata_say_what_is_built_instead() -> None:
    assert all(len(entry) == 3 and all(entry) for entry in ERRATA)


@pytest.mark.parametrize("name", [*TABLE_2, *TABLE_3])
def test_the_paper_prints_five_estimates_near_the_simulated_faults(name: str) -> None:
    printed = {**TABLE_2, **TABLE_3}[name]
    faults = shipped_run(name).config.simulate.faults  # type: ignore[union-attr]
    true = [float(faults[p.removesuffix(".size")]) for p in PARAMETERS]
    assert len(printed) == len(true)
    assert all(p is None or abs(p - t) < 0.08 for p, t in zip(printed, true, strict=True))


def test_a_row_of_table_2_holds_errors_of_paper_search_and_refinement() -> None:
    header, _, *rows = cells(paper_tables.table_2([case()], TABLE_2))
    first = dict(zip(header, rows[0], strict=True))
    assert (first["fault"], first["true"], first["paper"], first["DE alone"]) == (
        "3-dim",
        "0.1",
        "0.098079",
        "0.110000",
    )
    assert (first["paper's error"], first["DE's error"], first["refined error"]) == ("-1.9e-03", "+1.0e-02", "+1.0e-03")
    assert rows[2][3] == paper_tables.MISPRINT and rows[2][6] == "–"
    assert len(rows) == 5 and {len(row) for row in rows} == {len(header)}


def test_errors_below_rounding_are_said_to_be_so() -> None:
    assert [paper_tables.error(e, "+") for e in (0.0, -9e-8, 2e-7)] == ["< 1e-07", "< 1e-07", "+2.0e-07"]


def test_a_row_of_table_3_scores_the_free_estimate_by_the_bound() -> None:
    header, _, *rows = cells(paper_tables.table_3([case("table3_snr40", 40.0)], TABLE_3))
    assert rows[0][0] == "40 dB"
    assert rows[0][header.index("its error / bound")] == "+2.00"


def test_all_modes_are_31_and_start_with_single_faults() -> None:
    modes = all_modes(5)
    assert len({tuple(m.tolist()) for m in modes}) == 31
    assert [mode_name(m) for m in modes[[0, 4, 5, 30]]] == ["1", "5", "1 2", "1 2 3 4 5"]
    assert mode_name(torch.zeros(5, dtype=torch.bool)) == "–"


def test_a_fault_is_called_present_beyond_the_shared_out_confidence() -> None:
    # Two faults at 95 %: 2.5 % each, two-sided, is 2.2414 standard errors.
    value = torch.tensor([2.24, 2.25], dtype=torch.float64)
    said = called_present(value, torch.ones(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64), 0.95)
    assert said.tolist() == [False, True]


def modes_result() -> Modes:
    """Two faults, two draws of each mode: fault 2 is missed in one draw of mode '1 2', invented in one of mode '1'."""
    modes = all_modes(2)
    said = modes.unsqueeze(1).repeat(1, 2, 1)
    said[2, 0, 1], said[0, 1, 1] = False, True
    values = 0.5 * modes.double().unsqueeze(1).repeat(1, 2, 1)
    return Modes(modes, 0.5 * modes.double(), values + 0.1, values + 0.02, torch.full_like(values, 0.01), said)


def test_confusion_counts_modes_simulated_against_modes_said() -> None:
    assert confusion(modes_result()).tolist() == [[0, 1, 0, 1], [0, 0, 2, 0], [0, 1, 0, 1]]


def test_the_table_of_modes_counts_missed_and_invented_faults() -> None:
    header, _, *rows = cells(paper_tables.by_dimension(modes_result()))
    last = dict(zip(header, rows[-1], strict=True))
    assert (last["draws"], last["named exactly"]) == ("6", "66.7 %")
    assert (last["faults missed"], last["faults invented"]) == ("1", "1")
    assert (last["DE alone, RMSE"], last["refined, RMSE"]) == ("0.10000", "0.02000")
    assert last["errors / standard error, RMS"] == "2.00"


def test_wrongly_named_modes_are_told() -> None:
    assert (
        paper_tables.wrongly_named(modes_result())
        == "Wrong draws, by the numbers of their faults: 1 was named 1 2; 1 2 was named 1."
    )


def readings(values: torch.Tensor) -> Recording:
    time = torch.arange(len(values), dtype=torch.float64)
    return Recording(time, time.unsqueeze(1), values, ("Q",), ("h1", "h2"), ("m^3/s",), ("m", "m"))


def test_outputs_that_stand_still_under_noise_do_not_vary() -> None:
    noise = torch.randn(1001, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert not varies(readings(noise))
    slope = torch.linspace(0.0, 30.0, 1001, dtype=torch.float64).unsqueeze(1)
    assert varies(readings(noise + slope))
    assert not varies(readings(noise + slope * torch.tensor([1.0, 0.0], dtype=torch.float64)))


def test_other_parameters_than_the_papers_are_refused() -> None:
    run = load_run(SHIPPED / "paper" / "table3_snr10.yaml", ["simulate.duration=20 s", "estimate.parameters=[T1.leak]"])
    with pytest.raises(ValueError, match=r"expected the parameters T1\.leak\.size, .*, got T1\.leak\.size"):
        solve(run)


def test_a_short_case_is_solved_from_its_run_file() -> None:
    """60 s, a small search and given steps: the way from run file to row, within the bound's reach."""
    small = ["simulate.duration=60 s", "estimate.search.evaluations=1500"]
    steps = ["estimate.step.search=2 s", "estimate.step.refine=0.5 s"]
    found = solve(load_run(SHIPPED / "paper" / "table3_snr50.yaml", [*small, *steps]))
    assert found.status == "converged" and found.history.shape[1] == 5
    assert bool(((found.free - found.truth).abs() < 4.0 * found.bound).all())
    assert torch.allclose(found.std, found.bound, rtol=0.2)


def test_the_page_has_every_figure() -> None:
    wanted = {f"figure_{k}.png" for k in (3, 4, 5, 6, 7)} | {"fault_modes.png"}
    assert set(re.findall(r"\]\(([^)]+\.png)\)", PAGE)) == wanted


@pytest.mark.slow
def test_row_1_of_table_2_is_found_to_five_digits() -> None:
    found = solve(shipped_run("table2_1d"))
    assert float((found.refined - found.truth).abs().max()) < 1e-5
    assert found.status == "converged"
    # The bound at 50 dB by central differences through RK4, converged to half a per cent.
    bound = torch.tensor([1001, 479, 1195, 2707, 1047], dtype=torch.float64) * 1e-6
    assert torch.allclose(found.bound, bound, rtol=0.01)


@pytest.mark.slow
def test_modes_are_named_in_one_batch() -> None:
    run = shipped_run("modes")
    found = diagnose_modes(run, 1)
    assert found.stated.shape == (31, 1, 5)
    assert float((found.refined - found.truth.unsqueeze(1)).abs().max()) < 0.2


@pytest.mark.slow
def test_both_faults_in_a_row_raise_alarms_and_are_sized_within_three_standard_errors() -> None:
    found = follow([shipped_run(name) for name in WINDOWS])
    quiet, *faulty = found.windows
    assert quiet.alarm is None and quiet.result is None
    for window in faulty:
        assert 0.0 <= window.delay < 20.0
        assert window.result is not None
        final = window.result.estimate
        assert bool(((final.value[:5] - window.truth).abs() <= 3.0 * final.std[:5]).all())
        assert abs(float(window.result.correlation.sum()) - 3.0) < 1e-4
