"""The picture of a fit: its title says the diagnosis, and every text fits into its place."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure

from fdi_torch import Plant
from fdi_torch.config.plant_file import load_plant
from fdi_torch.plant.description import Sensor, Tank
from fdi_torch.recording import Recording
from fdi_torch.report.chart import Chart, Line, draw
from fdi_torch.report.fit_figure import fit_figure
from fdi_torch.report.sections.gap_closure import curve_panel
from fdi_torch.report.style import MODEL, save, set_title

TITLE = "est: fault not isolated: T2.leak.size or OUT2.plugging.size (T2.leak.size - OUT2.plugging.size = 0.1 ± 0.008)"


@pytest.mark.parametrize("sensors", [1, 3])
def test_title_and_labels_fit_into_the_picture(sensors: int) -> None:
    time = torch.arange(50.0, dtype=torch.float64)
    read = torch.sin(time)[:, None].expand(-1, sensors)
    names = tuple(f"h{k}" for k in range(sensors))
    recording = Recording(time, time[:, None], read, ("Q",), names, ("m^3/s",), ("m",) * sensors)
    figure = fit_figure(recording, {"estimate": 0.9 * read}, TITLE, load_plant("three_tank"))
    figure.draw_without_rendering()
    title = figure.get_suptitle()
    assert title.replace("\n", " ").replace("\N{NO-BREAK SPACE}", " ") == TITLE
    for text in figure.texts:
        box = text.get_window_extent()
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1
    for axes in figure.axes:
        assert axes.yaxis.label.get_window_extent().height <= axes.get_window_extent().height


NAMES = ("h1", "LI101", "Füllstand LI-101 im Behälter")


@pytest.mark.parametrize("name", NAMES)
def test_the_title_of_a_panel_is_apart_from_the_labels_of_its_lines(name: str) -> None:
    time = torch.arange(50.0, dtype=torch.float64)
    read = torch.sin(time)[:, None].expand(-1, 2)
    recording = Recording(time, time[:, None], read, ("Q",), (name, f"{name}2"), ("m^3/s",), ("m",) * 2)
    figure = fit_figure(recording, {"nominal": 0.8 * read, "corrected": 0.9 * read}, "run", load_plant("three_tank"))
    lines = [Line(each, time.numpy(), read[:, 0].numpy(), MODEL) for each in ("recalibrated", "with the causes")]
    curve = {"location": "P", "variable": f"{name} commanded", "at": [0, 1], "free": [0, 1], "free_std": [1, 1]}
    panels = [draw(Chart("a", f"{name}, hold-out", "reading, m", lines)), curve_panel({**curve, "effect": [0, 1]})]
    for each in (figure, *panels):
        each.draw_without_rendering()
        for axes in (axes for axes in each.axes if axes.get_legend()):
            title, labels = axes._left_title.get_window_extent(), axes.get_legend().get_window_extent()
            assert not title.overlaps(labels), axes.get_title("left")
            assert title.x1 <= each.bbox.x1 and title.y1 <= each.bbox.y1


def test_a_picture_of_another_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected a picture that ends in \.png or \.svg, got .*rig\.foo; rename it"):
        save(Figure(), tmp_path / "rig.foo")


def test_a_value_stays_beside_its_error() -> None:
    figure = Figure(figsize=(6.4, 4.8))
    for words in range(1, 14):
        set_title(figure, "word " * words + "size 0.15030 ± 0.00018")
        assert "±\n" not in figure.get_suptitle() and "\n±" not in figure.get_suptitle()


def test_the_title_of_a_fit_has_minus_signs_and_raised_units() -> None:
    plant = Plant([Tank("A", 0.1, 1.0)], sensors=[Sensor("h", "A")])
    time, read = torch.arange(5.0, dtype=torch.float64), torch.ones(5, 1, dtype=torch.float64)
    recording = plant.recording(time, read[:, :0], read, source="run-2.csv")
    title = fit_figure(
        recording, {"estimate": read}, "run-2.csv: pump offset at Q (-11.1 cm^3/s)", plant
    ).get_suptitle()
    assert title == "run-2.csv: pump offset at Q (−11.1 cm³/s)"


def test_many_sensors_stand_in_rows() -> None:
    plant = Plant([Tank(f"T{k}", 0.1, 1.0) for k in range(7)], sensors=[Sensor(f"h{k}", f"T{k}") for k in range(7)])
    time, read = torch.arange(5.0, dtype=torch.float64), torch.ones(5, 7, dtype=torch.float64)
    recording = plant.recording(time, read[:, :0], read, source="run.csv")
    figure = fit_figure(recording, {"estimate": read}, "run", plant)
    assert figure.get_figwidth() < 20.0 and len(figure.axes) == 14
    assert all(axes.xaxis.get_tick_params()["labelbottom"] for axes in figure.axes if "model" in axes.get_ylabel())
    assert sum("measured −\nmodel" in axes.get_ylabel() for axes in figure.axes) == 7


def test_inputs_stand_below_the_sensors_those_of_one_unit_together() -> None:
    plant = load_plant("three_tank")
    time = torch.arange(50.0, dtype=torch.float64)
    read, inputs = torch.ones(50, 3, dtype=torch.float64), 1e-5 * torch.ones(50, 2, dtype=torch.float64)
    figure = fit_figure(plant.recording(time, inputs, read), {"estimate": read}, "run", plant)
    figure.draw_without_rendering()
    panel = figure.axes[-1]
    assert len(figure.axes) == 7 and panel.get_ylabel() == "input, cm³/s"
    assert [line.get_label() for line in panel.lines] == ["Q1", "Q2"] and panel.lines[0].get_ydata()[
        0
    ] == pytest.approx(10)
