"""The picture of a fit: its title says the diagnosis, and every text fits into its place."""

from __future__ import annotations

import pytest
import torch
from matplotlib.figure import Figure

from fdi_torch.config.plant_file import load_plant
from fdi_torch.recording import Recording
from fdi_torch.report.fit_figure import fit_figure
from fdi_torch.report.style import set_title

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


def test_a_value_stays_beside_its_error() -> None:
    figure = Figure(figsize=(6.4, 4.8))
    for words in range(1, 14):
        set_title(figure, "word " * words + "size 0.15030 ± 0.00018")
        assert "±\n" not in figure.get_suptitle() and "\n±" not in figure.get_suptitle()
