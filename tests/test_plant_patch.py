"""Adoption of an estimate changes only the necessary lines of a plant file."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdi_torch.cli.adoption import write_adopted
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_patch import patched_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.yaml_files import parse_yaml, shipped_plants
from fdi_torch.gap.answer import with_constants
from fdi_torch.plant.description import PlacedEffect, PlantDescription

TEXT = """# The rig in the cellar.
name: rig   # ours
tanks:
  A: {area: 0.02 m^2, height: "600 mm"}   # measured on 3 May
  B:
    area: 300 cm^2
    height: 24 in   # rim

    # B has no leak
pipes:
  link: {source: A, target: B, area: 60 mm^2, discharge_coefficient: 60 %}
  drain: {source: B, area: 0.5 cm^2, discharge_coefficient: 0.62}

pumps: {Q: {target: A, max_flow: 6 l/min, gain: 2 l/min/V}}
sensors:
  hA: {tank: A}
  pB:
    tank: B
    gain: 98.1 mbar/m   # from its sheet
tolerances:
  "*.discharge_coefficient": 3 %  # all of them
effects:
- {effect: pump_lag, location: Q, parameters: {time_constant: 500 ms}}
# the end
"""


def read(text: str) -> PlantDescription:
    return build_plant(parse_yaml(text.encode(), "rig.yaml"), "rig.yaml")


def lines_changed(before: str, after: str) -> tuple[list[str], list[str]]:
    old, new = before.splitlines(), after.splitlines()
    return [line for line in old if line not in new], [line for line in new if line not in old]


BEFORE = read(TEXT)


@pytest.mark.parametrize(
    ("constants", "gone", "come"),
    [
        (
            {"A.area": 0.021},
            '  A: {area: 0.02 m^2, height: "600 mm"}   # measured on 3 May',
            '  A: {area: 0.021 m^2, height: "600 mm"}   # measured on 3 May',
        ),
        ({"B.height": 0.635}, "    height: 24 in   # rim", "    height: 25 in   # rim"),
        (
            {"A.height": 0.61},
            '  A: {area: 0.02 m^2, height: "600 mm"}   # measured on 3 May',
            '  A: {area: 0.02 m^2, height: "610 mm"}   # measured on 3 May',
        ),
        ({"pB.gain": 9800.0}, "    gain: 98.1 mbar/m   # from its sheet", "    gain: 98 mbar/m   # from its sheet"),
        (
            {"drain.discharge_coefficient": 0.6123456789},
            "  drain: {source: B, area: 0.5 cm^2, discharge_coefficient: 0.62}",
            "  drain: {source: B, area: 0.5 cm^2, discharge_coefficient: 0.6123457}",
        ),
        ({"hA.offset": 0.0021}, "  hA: {tank: A}", "  hA: {tank: A, offset: 2.1 mm}"),
    ],
)
def test_a_constant_changes_its_line_in_its_own_unit(constants: dict[str, float], gone: str, come: str) -> None:
    changed, kept = patched_plant(TEXT, BEFORE, with_constants(BEFORE, constants))
    assert kept and lines_changed(TEXT, changed) == ([gone], [come])


def test_a_tolerance_that_was_there_is_replaced() -> None:
    before = read(TEXT.replace('"*.discharge_coefficient": 3 %', "link.discharge_coefficient: 3 %"))
    text = TEXT.replace('"*.discharge_coefficient": 3 %', "link.discharge_coefficient: 3 %")
    after = replace(before, tolerances={"link.discharge_coefficient": 0.01})
    changed, kept = patched_plant(text, before, after)
    assert kept and read(changed).tolerances == {"link.discharge_coefficient": 0.01}


def test_a_key_that_was_not_there_comes_at_the_end_of_its_block() -> None:
    changed, kept = patched_plant(TEXT, BEFORE, with_constants(BEFORE, {"pB.offset": 250.0, "B.start_level": 0.2}))
    assert kept and lines_changed(TEXT, changed) == ([], ["    start_level: 200 mm", "    offset: 2.5 mbar"])
    assert changed.index("start_level") < changed.index("# B has no leak")


def test_effects_and_tolerances_are_added_and_wildcards_stay() -> None:
    leak = PlacedEffect("leak", "B", {"size": 0.20454692828452672, "height": 0.1})
    lag = PlacedEffect("pump_lag", "Q", {"time_constant": 0.75})
    after = replace(BEFORE, effects=(leak, lag), tolerances=BEFORE.tolerances | {"B.leak.size": 0.04})
    changed, kept = patched_plant(TEXT, BEFORE, after)
    gone, come = lines_changed(TEXT, changed)
    assert kept and gone == ["- {effect: pump_lag, location: Q, parameters: {time_constant: 500 ms}}"]
    assert come == [
        "  B.leak.size: 0.04",
        "- {effect: pump_lag, location: Q, parameters: {time_constant: 750 ms}}",
        "- {effect: leak, location: B, parameters: {size: 0.2045469, height: 100 mm}}",
    ]
    assert changed.endswith("# the end\n") and '"*.discharge_coefficient": 3 %  # all of them' in changed


def test_an_effect_that_begins_within_a_recording_says_for_which_recordings_it_holds() -> None:
    leak = PlacedEffect("leak", "B", {"size": 0.2, "onset": 499.5})
    steady = PlacedEffect("evaporation", "A", {"rate": 1e-7})
    comment = "  # onset within run.xlsx: delete it for recordings made later"
    for text in (TEXT, TEXT.partition("effects:")[0]):
        before = read(text)
        after = replace(before, effects=(*before.effects, leak, steady))
        changed, kept = patched_plant(text, before, after, recording="run.xlsx")
        (line,) = (line for line in changed.splitlines() if "leak, location: B" in line)
        assert kept and line.endswith("parameters: {size: 0.2, onset: 499.5 s}}" + comment)
        assert changed.count("delete it") == 1 and len(read(changed).effects) == len(after.effects)
    flow = TEXT.replace("effects:\n- {", "effects: [{").replace("500 ms}}", "500 ms}}]")
    changed, kept = patched_plant(flow, read(flow), replace(BEFORE, effects=(*BEFORE.effects, leak)), recording="a.csv")
    assert kept and "#" not in changed.partition("effects:")[2].partition("\n")[0], "a comment would hide what follows"


def test_a_file_without_effects_gets_them_at_its_end() -> None:
    text = TEXT.partition("tolerances:")[0]
    before = read(text)
    after = replace(before, effects=(PlacedEffect("leak", "B", {"size": 0.2}),), tolerances={"B.leak.size": 0.04})
    changed, kept = patched_plant(text.rstrip(), before, after)
    assert kept and changed.startswith(text.rstrip())
    assert "\neffects:\n  - {effect: leak, location: B, parameters: {size: 0.2}}\n" in changed
    assert "\ntolerances:\n  B.leak.size: 0.04\n" in changed


@pytest.mark.parametrize("name", shipped_plants())
def test_every_shipped_plant_can_be_changed_everywhere(name: str) -> None:
    from fdi_torch.config.yaml_files import find_plant

    text = find_plant(name, Path.cwd()).read_text()
    before = load_plant(name)
    constants: dict[str, float] = {f"{t.name}.area": 1.07 * t.area for t in before.tanks}
    constants |= {f"{p.name}.discharge_coefficient": 0.93 * p.discharge_coefficient for p in before.pipes}
    constants |= {f"{p.name}.gain": 1.03 * p.gain for p in before.pumps}
    constants |= {f"{s.name}.gain": 0.99 * s.gain for s in before.sensors}
    constants |= {f"{s.name}.offset": s.offset + 0.01 for s in before.sensors}
    after = with_constants(before, constants)
    after = replace(after, effects=(*after.effects, PlacedEffect("evaporation", before.tanks[0].name, {"rate": 1e-7})))
    changed, kept = patched_plant(text, before, after)
    assert kept
    comments: list[Any] = [line.partition("#")[2] for line in text.splitlines() if "#" in line]
    assert comments == [line.partition("#")[2] for line in changed.splitlines() if "#" in line]


def test_a_file_whose_components_share_a_value_is_written_anew_and_that_is_said(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shared = TEXT.replace("  A: {area: 0.02 m^2", "  A: &wide {area: 0.02 m^2").replace(
        "  B:\n    area: 300 cm^2\n    height: 24 in   # rim\n", "  B: *wide\n"
    )
    Path("rig.yaml").write_text(shared)
    before = read(shared)
    write_adopted("rig.yaml", before, with_constants(before, {"A.area": 0.021}), Path("new.yaml"), Screen())
    told = capsys.readouterr()
    assert "new.yaml: rewritten without the comments of rig.yaml" in told.err
    found = load_plant("new.yaml")
    assert [tank.area for tank in found.tanks] == [pytest.approx(0.021), 0.02]


def test_values_of_a_file_with_anchors_have_the_digits_of_their_standard_errors() -> None:
    shared = TEXT.replace("  A: {area: 0.02 m^2", "  A: &wide {area: 0.02 m^2").replace(
        "  B:\n    area: 300 cm^2\n    height: 24 in   # rim\n", "  B: *wide\n"
    )
    before = read(shared)
    after = with_constants(before, {"A.area": 0.021123456789, "link.discharge_coefficient": 0.612345678})
    text, kept = patched_plant(shared, before, after, {"A.area": 0.00012, "link.discharge_coefficient": 0.0034})
    assert not kept and "123456789" not in text
    assert "area: 0.02112 m^2" in text and "discharge_coefficient: 0.6123" in text
    assert [tank.area for tank in read(text).tanks] == [0.02112, 0.02]


def test_the_diff_is_told(here: Path) -> None:
    Path("rig.yaml").write_text(TEXT)
    diff = write_adopted("rig.yaml", BEFORE, with_constants(BEFORE, {"B.height": 0.635}), Path("new.yaml"), Screen())
    told = "\n".join(diff)
    assert "-    height: 24 in   # rim\n+    height: 25 in   # rim\n" in told
    assert told.startswith("--- rig.yaml\n+++ new.yaml\n")


@pytest.mark.parametrize(("style", "shown"), [("3 %", "0.056 %"), ("0.03", "0.00056")])
def test_tolerances_are_added_in_the_style_of_the_file(style: str, shown: str) -> None:
    text = TEXT.replace("3 %  #", f"{style}  #").replace("    gain: 98.1 mbar/m ", "    gain: 2 %/cm ")
    before = read(text)
    narrow = {"link.discharge_coefficient": 0.00056, "drain.discharge_coefficient": 0.00043, "pB.offset": 0.0056}
    changed, kept = patched_plant(text, before, replace(before, tolerances=before.tolerances | narrow))
    _, new = lines_changed(text, changed)
    assert kept and new[0] == f"  link.discharge_coefficient: {shown}" and new[-1] == "  pB.offset: 0.56 %"
    assert ("%" in new[1]) == ("%" in style)


def test_what_a_sensor_in_percent_gets_is_written_in_percent() -> None:
    text = TEXT.replace("    gain: 98.1 mbar/m ", "    gain: 2 %/cm ")
    before = read(text)
    after = with_constants(before, {"pB.offset": -0.0021})
    biased = replace(after, effects=(*after.effects, PlacedEffect("sensor_bias", "pB", {"bias": 0.01})))
    changed, kept = patched_plant(text, before, biased)
    _, new = lines_changed(text, changed)
    assert kept and new == ["    offset: -0.21 %", "- {effect: sensor_bias, location: pB, parameters: {bias: 1 %}}"]


@pytest.mark.parametrize(
    ("std", "shown"),
    [(4e-6, "20.123 cm^2"), (2.4e-5, "20.12 cm^2"), (4e-4, "20.1 cm^2"), (math.inf, "20 cm^2"), (0.0, "20.12346 cm^2")],
)
def test_a_value_has_the_digits_that_its_standard_error_justifies(std: float, shown: str) -> None:
    """Two digits of the error, 0.040, 0.24, 4.0 cm^2, and never fewer than two of the value."""
    text = TEXT.replace("area: 0.02 m^2", "area: 25 cm^2")
    after = with_constants(read(text), {"A.area": 20.123456e-4})
    changed, kept = patched_plant(text, read(text), after, {"A.area": std})
    assert kept and lines_changed(text, changed)[1] == [
        f'  A: {{area: {shown}, height: "600 mm"}}   # measured on 3 May'
    ]


def test_a_new_effect_has_the_digits_of_its_standard_errors() -> None:
    leak = PlacedEffect("leak", "A", {"size": 0.2034567})
    lag = PlacedEffect("pump_lag", "Q", {"time_constant": 7.8691234})
    changed, _ = patched_plant(
        TEXT, BEFORE, replace(BEFORE, effects=(lag, leak)), {"A.leak.size": 0.0123, "Q.pump_lag.time_constant": 0.084}
    )
    assert "parameters: {size: 0.203}" in changed and "time_constant: 7869 ms" in changed


def test_tolerances_are_written_in_one_style() -> None:
    """1/3 is no short share of 100 %, hence all are bare numbers."""
    for odd, styles in ((0.05, {str}), (1.0 / 3.0, {float})):
        mixed = replace(BEFORE, tolerances={"link.discharge_coefficient": 0.03, "drain.discharge_coefficient": odd})
        written = parse_yaml(dump_plant(mixed).encode(), "rig")["tolerances"]
        assert {type(value) for value in written.values()} == styles
        assert read(dump_plant(mixed)) == mixed
