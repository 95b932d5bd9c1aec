"""Any rig can be drawn: every tank has a place of its own, below what pours into it."""

from __future__ import annotations

from itertools import combinations, pairwise
from pathlib import Path

import pytest

from fdi_torch import Plant, Transfer, Weir
from fdi_torch.config.plant_file import load_plant
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.report.rig_layout import level_text, tank_places
from fdi_torch.report.schematic import Overlay, schematic
from fdi_torch.report.style import inline_svg

PLANTS = sorted(p.stem for p in (Path(__file__).parents[2] / "configs" / "plants").glob("*.yaml"))


@pytest.mark.parametrize("name", PLANTS)
def test_every_component_of_every_shipped_plant_is_named(name: str) -> None:
    plant = load_plant(name)
    svg = inline_svg(schematic(plant), "rig", "the rig")
    assert all(f">{component.name}<" in svg for component in plant.components())


@pytest.mark.parametrize("name", PLANTS)
def test_what_pours_stands_above_what_catches_it(name: str) -> None:
    plant = load_plant(name)
    places = tank_places(plant)
    assert len(set(places.values())) == len(plant.tanks)
    for pipe in plant.pipes:
        if pipe.target != OUTSIDE:
            assert (places[pipe.target][0] > places[pipe.source][0]) == pipe.free_fall


def test_tanks_that_a_pipe_levels_stand_side_by_side_whatever_falls_between_them() -> None:
    """Both ends of a pipe have one zero of the level, so that a weir between them, or beside a chain, lowers none."""
    tanks = [Tank(name, 0.3, 0.9) for name in "ABCD"]
    pipes = [
        Pipe("ab", "A", "B", 3e-4, 0.6),
        Pipe("bc", "B", "C", 3e-4, 0.6),
        Pipe("cd", "C", "D", 3e-4, 0.6, free_fall=True),
    ]
    weirs = [Weir("over", "A", "C", crest=0.6, width=0.04), Weir("back", "B", "A", crest=0.7, width=0.04)]
    plant = Plant(tanks, pipes, sensors=[Sensor("h", "A")], weirs=weirs)
    assert {name: row for name, (row, _) in tank_places(plant).items()} == {"A": 0, "B": 0, "C": 0, "D": 1}


def test_a_sensor_is_drawn_at_the_wall_that_is_free() -> None:
    """Weir and transfer join the tanks where the sensors of both would be drawn."""
    plant = Plant(
        tanks=[Tank("A", 0.1, 1.0), Tank("B", 0.1, 1.0)],
        pipes=[Pipe("link", "A", "B", 1e-4, 0.6)],
        weirs=[Weir("edge", "A", "B", crest=0.7, width=0.05)],
        transfers=[Transfer("back", "B", "A", max_flow=1e-4)],
        sensors=[Sensor("hA", "A"), Sensor("hB", "B")],
    )
    at = {text.get_text(): text.get_position()[0] for text in schematic(plant).axes[0].texts}
    assert at["hA"] < at["A"] - 0.5 and at["hB"] > at["B"] + 0.5


def test_a_pipe_to_the_left_is_named_below_its_line_as_one_to_the_right() -> None:
    tanks = [Tank(name, 0.1, 1.0) for name in ("C", "A", "B")]
    pipes = [Pipe("right", "A", "B", 1e-4, 0.6), Pipe("left", "A", "C", 1e-4, 0.6)]
    plant = Plant(tanks, pipes, sensors=[Sensor("h", "A")])
    places, texts = tank_places(plant), schematic(plant).axes[0].texts
    assert len({places["A"][1] - places[tank][1] for tank in "BC"}) == 2, "one at each side"
    at = {text.get_text(): text.get_position() for text in texts}
    assert at["left"][1] == pytest.approx(at["right"][1])
    middle = {at[name][0] - at["A"][0] for name in ("left", "right")}
    assert sum(middle) == pytest.approx(0.0)


def test_a_chain_is_drawn_in_its_order() -> None:
    columns = {name: column for name, (_, column) in tank_places(load_plant("three_tank")).items()}
    assert columns == {"T1": 0, "T3": 1, "T2": 2}


def test_circles_of_pipes_and_of_falls_are_drawn_too() -> None:
    tanks = tuple(Tank(n, 0.01, 1.0) for n in "ABCD")
    ring = [Pipe(a + b, a, b, 1e-5, 0.6) for a, b in ("AB", "BC", "CD", "DA", "AC")]
    falls = [Pipe("f" + a + b, a, b, 1e-5, 0.6, free_fall=True, valve="v") for a, b in ("AB", "BA")]
    plant = PlantDescription("ring", tanks, (*ring, *falls), (Pump("p", "A", 1e-4),), (Sensor("s", "A"),))
    assert len(set(tank_places(plant).values())) == 4
    assert ">fBA<" in inline_svg(schematic(plant), "rig", "")


def test_guilty_components_and_shares_stand_on_the_drawing() -> None:
    overlay = Overlay({"T1": 0.5}, {"Q1": ["pump lag 8 s"], "T1-T2": ["cross flow"]}, {"P13": 0.62})
    svg = inline_svg(schematic(load_plant("three_tank"), overlay), "rig", "")
    assert all(f">{words}<" in svg for words in ("50.0 cm", "pump lag", "8 s", "cross", "flow", "62.0 %"))
    assert svg.count("var(--mark)") > inline_svg(schematic(load_plant("three_tank")), "rig", "").count("var(--mark)")


@pytest.mark.parametrize("level", [0.0, 0.2, 0.4, 0.5, 0.63])
def test_no_word_within_a_tank_stands_on_another(level: float) -> None:
    said = Overlay({"T1": level}, {"T1": ["leak 0.295"]}, {"T1": 1.0})
    figure = schematic(load_plant("three_tank"), said)
    figure.canvas.draw()
    words = [
        t
        for t in figure.axes[0].texts
        if t.get_text() in ("T1", "leak", "0.295", "over 99.9 %", f"{100 * level:.1f} cm")
    ]
    boxes = sorted((t.get_window_extent() for t in words), key=lambda box: box.y0)
    assert len(boxes) == 5
    for lower, upper in pairwise(boxes):
        assert lower.y1 - upper.y0 < 0.25 * lower.height, "letters overlap"


@pytest.mark.parametrize("level", [0.5, 0.63, 0.72, 0.8, 0.88, 0.93, 0.97, 1.0])
@pytest.mark.parametrize(
    "effects", [["leak 0.295"], ["leak 0.295", "outlet drop 12 mm", "laminar flow 49.8 ± 9.5 mm"], []]
)
def test_no_word_within_a_tank_stands_on_the_water_line(level: float, effects: list[str]) -> None:
    plant = load_plant("three_tank")
    figure = schematic(plant, Overlay({"T1": level}, {"T1": effects} if effects else {}))
    figure.canvas.draw()
    axes = figure.axes[0]
    (surface,) = (line for line in axes.lines if line.get_zorder() == 4)
    (left, height), (right, _) = axes.transData.transform(surface.get_xydata())
    boxes = {t.get_text(): t.get_window_extent() for t in axes.texts}
    within = {text: box for text, box in boxes.items() if left < (box.x0 + box.x1) / 2 < right}
    assert {"T1", level_text(level)} <= within.keys()
    for text, box in within.items():
        assert not box.y0 + 0.2 * box.height < height < box.y1 - 0.2 * box.height, text


@pytest.mark.parametrize(("name", "effects"), [*((name, 3) for name in PLANTS), ("quadruple_tank", 1)])
def test_no_text_stands_on_another_with_effects_everywhere(name: str, effects: int) -> None:
    plant = load_plant(name)
    texts = ["laminar flow 49.8 ± 9.5 mm", "outlet drop 12 mm", "plugging 0.31 ± 0.04"][:effects]
    names = [component.name for component in plant.components()]
    overlay = Overlay(
        {t.name: 0.5 * t.height for t in plant.tanks}, dict.fromkeys(names, texts), dict.fromkeys(names, 0.5)
    )
    figure = schematic(plant, overlay)
    figure.canvas.draw()
    boxes = [(t.get_text(), t.get_window_extent()) for t in figure.axes[0].texts if t.get_text()]
    assert sum(text.startswith("outlet") or text == "• outlet" for text, _ in boxes) == (effects == 3) * len(names)
    for (one, a), (other, b) in combinations(boxes, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        along = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert across < 1.0 or along < 0.25 * min(a.height, b.height), f"{one} stands on {other}"
    for text, box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height, text


def test_a_pipe_between_neighbours_is_straight_in_a_long_row() -> None:
    """Positions of columns are rounded, by more the further right they are."""
    names = [f"T{k}" for k in range(12)]
    pipes = [Pipe(f"from{a}", a, b, 1e-4, 0.6) for a, b in pairwise(names)]
    plant = Plant([Tank(name, 0.1, 1.0) for name in names], pipes, sensors=[Sensor("h", "T0")])
    lines = [line.get_xydata() for line in schematic(plant).axes[0].lines]
    assert sum(len(line) == 2 and line[0, 1] == line[1, 1] for line in lines) == len(pipes)
