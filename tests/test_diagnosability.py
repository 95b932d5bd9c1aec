"""Diagnosability against the published bound, against structure by another tool, and against what is known by hand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from fdi_torch.cli import main
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import placements_for
from fdi_torch.estimate.fitting import set_up
from fdi_torch.monitor.diagnosability import diagnosability
from fdi_torch.monitor.structural_analysis import Structure, structure_of
from fdi_torch.recording import Recording

PLANT = load_plant("three_tank")
PAPER = ["T1.leak.size", "OUT2.net_outlet.size", "T3.leak.size", "P13.openness.size", "P32.openness.size"]
SINGLES = [f"T{i}.leak.size" for i in (1, 2, 3)] + [f"{pipe}.plugging.size" for pipe in ("P13", "P32", "OUT2")]
TABLE_3 = dict(zip(PAPER, (0.3, 0.3, 0.5, 0.6, 1.0), strict=True))


def steady(samples: int = 1001) -> Recording:
    time = torch.arange(samples, dtype=torch.float64)
    flows, readings = time.new_full((samples, 2), 50e-6), time.new_zeros(samples, 3)
    return PLANT.recording(time, flows, readings)


def millimetre() -> torch.Tensor:
    return torch.full((3,), 1e-3, dtype=torch.float64)


def test_standard_errors_are_the_cramer_rao_bound_of_table_3() -> None:
    fitting = set_up(PLANT, [steady()], PAPER, "equilibrium")
    clean = fitting.engines(0.1)[0].readings(fitting.space.vector(TABLE_3))
    found = diagnosability(PLANT, PAPER, steady(), clean.std(0) * 10**-2.5, at=TABLE_3, step=0.1)
    # Independent computation: central differences through RK4 at 0.02 s.
    assert found.std == pytest.approx([203e-6, 174e-6, 268e-6, 539e-6, 744e-6], rel=0.01)
    assert found.std_by_correlation == pytest.approx([390e-6, 601e-6, 847e-6, 849e-6, 1300e-6], rel=0.01)


def test_a_correlation_sees_neither_bias_nor_gain_of_a_sensor() -> None:
    faults = ["T1.leak.size", "h1.sensor_bias.bias", "h2.sensor_gain.factor"]
    found = diagnosability(PLANT, faults, steady(), millimetre(), at={"T1.leak.size": 0.3})
    assert all(math.isfinite(std) for std in found.std) and math.isfinite(found.std_by_correlation[0])
    assert found.std_by_correlation[1:] == (math.inf, math.inf)


def test_a_stuck_sensor_at_a_constant_level_shows_at_no_size() -> None:
    """Its signature is rounding: it would need a size of ten million, and hides no other fault."""
    alone = diagnosability(PLANT, ["T1.leak.size"], steady(), millimetre())
    found = diagnosability(PLANT, ["T1.leak.size", "h1.sensor_stuck.size"], steady(), millimetre())
    assert (found.std[1], found.smallest_detectable[1], found.smallest_isolable[1]) == (math.inf,) * 3
    assert found.rank == 1 and found.smallest_isolable[0] == pytest.approx(alone.smallest_isolable[0])
    assert found.remarks[0] == "h1.sensor_stuck.size does not show in any reading at any size of its range"


def test_plugging_of_the_outlet_and_a_leak_of_its_tank_are_one_and_the_reason_is_told() -> None:
    found = diagnosability(PLANT, SINGLES, steady(), millimetre())
    assert found.groups == (
        "leak at T2 and plugging at OUT2 are indistinguishable: both are flows in proportion to sqrt(2 g h) of T2, "
        "so that the data determine only their sum",
    )
    assert found.smallest_isolable[1] == math.inf and found.smallest_isolable[5] == math.inf
    assert all(math.isfinite(size) for size in found.smallest_detectable)


def test_at_rest_three_readings_determine_three_combinations_and_moving_levels_five() -> None:
    rest = diagnosability(PLANT, PAPER, steady(), millimetre())
    assert rest.rank == 3 and all(math.isinf(std) for std in rest.std)
    assert any("correlation is undefined" in remark for remark in rest.remarks)
    moving = diagnosability(PLANT, PAPER, steady(), millimetre(), at=TABLE_3)
    assert moving.rank == 5 and all(math.isfinite(std) for std in moving.std)


def test_smallest_detectable_size_follows_the_rates_and_the_noise() -> None:
    """Normal quantiles of 0.9995 and 0.95: one false alarm in a thousand, and one fault in twenty missed."""
    quiet = diagnosability(PLANT, ["T1.leak.size"], steady(200), millimetre())
    noisy = diagnosability(PLANT, ["T1.leak.size"], steady(200), 2 * millimetre())
    assert quiet.smallest_detectable[0] == pytest.approx((3.29053 + 1.64485) * quiet.std[0], rel=1e-5)
    assert noisy.smallest_detectable[0] == pytest.approx(2 * quiet.smallest_detectable[0], rel=1e-9)


def test_uncertain_constants_hide_what_they_imitate() -> None:
    alone = diagnosability(PLANT, ["P13.plugging.size"], steady(), millimetre())
    constants = ["P13.discharge_coefficient"]
    hidden = diagnosability(PLANT, ["P13.plugging.size"], steady(), millimetre(), calibrate=constants)
    # Plugging is told from the coefficient only by the coefficient's tolerance of 3 %.
    assert hidden.std[0] == pytest.approx(0.03, rel=0.01) and alone.std[0] < 1e-3
    reach = hidden.smallest_detectable[0] / alone.smallest_detectable[0]
    assert reach == pytest.approx(hidden.std[0] / alone.std[0], rel=0.01)


def test_a_sensor_that_sees_nothing_of_a_fault_says_so() -> None:
    found = diagnosability(PLANT, ["h2.sensor_bias.bias"], steady(50), millimetre())
    assert found.shows[0][0] == 0.0 and found.shows[0][2] == 0.0 and found.shows[0][1] > 0
    assert found.to_dict()["rank"] == 1


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one fault"):
        diagnosability(PLANT, [], steady(), millimetre())


def test_structure_of_a_chain_by_hand() -> None:
    # x is read twice: both readings and the law of y are checked by each other, z is nobody's.
    structure = Structure(
        {"a": frozenset({"x"}), "b": frozenset({"x"}), "c": frozenset({"z"})},
        {"fa": frozenset({"a"}), "fb": frozenset({"b"}), "fc": frozenset({"c"})},
    )
    without_c = {"fa": False, "fb": False, "fc": True}
    assert structure.isolable() == {"fa": without_c, "fb": without_c, "fc": dict.fromkeys(without_c, False)}


def test_structure_agrees_with_the_fault_diagnosis_toolbox() -> None:
    toolbox = pytest.importorskip("faultdiagnosistoolbox", reason="faultdiagnosistoolbox is not installed")
    places = [*placements_for([*SINGLES, "h1.sensor_bias.bias", "h3.sensor_bias.bias", "Q1.pump_gain.factor"])]
    structure = structure_of(PLANT, places)
    names = [p.prefix.replace(".", "_") for p in places]
    model = toolbox.DiagnosisModel(_as_toolbox_model(toolbox, structure, names), name="three tanks")
    detectable, hidden = model.DetectabilityAnalysis()
    assert set(detectable) == set(names) and not hidden
    not_isolable = model.IsolabilityAnalysis()
    ours = structure.isolable()
    for i, f in enumerate(places):
        for j, g in enumerate(places):
            assert ours[f.prefix][g.prefix] == (not not_isolable[i, j]), (f.prefix, g.prefix)


def _as_toolbox_model(toolbox: Any, structure: Structure, names: list[str]) -> dict[str, Any]:
    """The same equations in the toolbox's own words: faults and readings written into them."""
    unknowns = sorted({u for row in structure.equations.values() for u in row})
    written: list[Any] = []
    readings = []
    for name, row in structure.equations.items():
        if name.startswith("derivative"):
            tank = name.split()[1]
            written.append(toolbox.DiffConstraint(f"dh_{tank}", f"h_{tank}"))
            continue
        upset = [fault for fault, own in zip(names, structure.faults.values(), strict=True) if name in own]
        known = [f"y_{name.split()[1]}"] if name.startswith("sensor") or name.startswith("law Q") else []
        readings += known
        written.append([u.replace(" ", "_") for u in sorted(row)] + upset + known)
    return {
        "type": "VarStruc",
        "x": [u.replace(" ", "_") for u in unknowns],
        "f": names,
        "z": readings,
        "rels": written,
    }


def test_the_tables_are_in_the_units_of_the_plant(capsys: pytest.CaptureFixture[str]) -> None:
    """A pump's offset in cm^3/s has a millionth of the effect of one in m^3/s; what is not determined has no number."""
    words = ["diagnosability", "--plant", "three_tank", "--input", "50 cm^3/s,50 cm^3/s", "--duration", "60 s"]
    assert main([*words, "--faults", "Q1.pump_offset,h1.sensor_bias,T2.leak,OUT2.plugging"]) == 0
    shown = capsys.readouterr().out
    assert "inf" not in shown and " SI" not in shown
    assert "faults (or combinations) are determined together" in shown.splitlines()[1]
    assert "sine of the angle between signatures (0: not distinguishable)" not in shown and " sine" in shown
    offset = [line.split() for line in shown.splitlines() if line.startswith("Q1.pump_offset")]
    [bounds, effects] = offset
    assert bounds[1] == effects[1] == "cm^3/s" and 0.1 < float(effects[2]) < 1e3
    assert any(line.split()[2] == "–" for line in shown.splitlines() if line.startswith("OUT2.plugging"))


def test_inputs_may_come_from_a_file_that_maps_the_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [f"{k}\t{50 + k % 7}\t50\t50\t40\t45" for k in range(100)]
    (tmp_path / "lab.txt").write_text("\n".join(rows) + "\n")
    columns = {
        "t": (1, "s"),
        "Q1": (2, "cm^3/s"),
        "Q2": (3, "cm^3/s"),
        "h1": (4, "cm"),
        "h2": (5, "cm"),
        "h3": (6, "cm"),
    }
    mapped = ", ".join(f"{name}: {{column: {k}, unit: {unit}}}" for name, (k, unit) in columns.items())
    lab = f"{{file: lab.txt, header: false, columns: {{{mapped}}}}}"
    listing = tmp_path / "runs.yaml"
    words = ["diagnosability", "--plant", "three_tank", "--input", str(listing), "--faults", "T1.leak", "--quiet"]
    listing.write_text(f"recordings: [{lab}]\n")
    assert main(words) == 0
    assert "T1.leak.size" in capsys.readouterr().out
    listing.write_text(f"recordings: [{lab}, {lab}]\n")
    assert main(words) == 2
    assert "--input: expected one recording with known inputs, got 2" in capsys.readouterr().err


def test_the_inputs_are_those_of_a_recording_by_either_name(tmp_path: Path) -> None:
    (tmp_path / "planned.csv").write_text("t_s,Q1_cm3_s,Q2_cm3_s\n0,50,50\n300,70,50\n600,50,50\n")
    for name in ("--input", "--recording"):
        words = ["diagnosability", "--plant", "three_tank", name, str(tmp_path / "planned.csv"), "--quiet"]
        assert main([*words, "--faults", "T1.leak"]) == 0
