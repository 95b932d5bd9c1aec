"""Interactive charts of a page: their data, and zoom, crosshair, readout, pan and enlarging in a browser."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import browser, draw_all, opened  # noqa: F401
from sample_runs import material_of, write_train

from fdi_torch.report.chart import MOST_SAMPLES, Chart, Line, chart_json, draw
from fdi_torch.report.page import POLICY, SCRIPT, document, page, report_of
from fdi_torch.report.section import Section, section_html, signals
from fdi_torch.report.style import MARK, MODEL

TIME = np.arange(100.0)


def decoded(code: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(code), kind)


def of_chart(*lines: Line, **options: Any) -> dict[str, Any]:
    return json.loads(chart_json(Chart("<b>", "time, s", "level, cm", lines, **options)))


def test_lines_of_one_clock_share_it_and_gaps_stay() -> None:
    y = np.where(TIME == 7, np.nan, TIME**2)
    made = of_chart(
        Line("a", TIME, y, MODEL), Line("b", TIME, -y, MARK, dashed=True), Line("c", TIME[::2], y[::2], MARK)
    )
    assert [line["clock"] for line in made["lines"]] == [0, 0, 1]
    assert [line["dashed"] for line in made["lines"]] == [False, True, False]
    np.testing.assert_array_equal(decoded(made["clocks"][0], "<f8"), TIME)
    np.testing.assert_array_equal(decoded(made["lines"][1]["y"], "<f4"), -y)
    assert all(line["complete"] for line in made["lines"])


def test_a_long_line_keeps_its_spikes_and_is_said_to_be_thinned() -> None:
    time = np.arange(100_000.0)
    y = np.where(time == 77_777, 50.0, np.sin(time))
    made = of_chart(Line("a", time, y, MODEL), Line("b", time, np.where(time == 5, -9.0, 0.0), MARK))
    kept, values = decoded(made["clocks"][0], "<f8"), decoded(made["lines"][0]["y"], "<f4")
    assert not made["lines"][0]["complete"] and len(kept) <= 2 * MOST_SAMPLES
    assert values[kept == 77_777] == 50.0 and decoded(made["lines"][1]["y"], "<f4")[kept == 5] == -9.0


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        ([1.0, 2.0, 100.0], ["log", 0.0]),
        ([1.0, 2.0, 3.0], ["linear", 0.0]),
        ([0.0, 2.0, 100.0], ["linear", 0.0]),  # 100 is less than 20 times the median of 2 and 100
        ([0.0, 0.0, 2.0, 4.0, 1000.0], ["asinh", 4.0]),
        ([-1.0, 2.0, 100.0], ["linear", 0.0]),
        ([np.nan, np.nan], ["linear", 0.0]),
    ],
)
def test_an_axis_is_logarithmic_where_values_span_decades(values: list[float], scale: list[Any]) -> None:
    x = np.arange(len(values))
    assert of_chart(Line("a", x, np.array(values), MODEL), log=True)["scale"] == scale
    assert of_chart(Line("a", x, np.array(values), MODEL))["scale"] == ["linear", 0.0]


@pytest.mark.parametrize("excess", [[1e-4, 3e-7, 0.0], [3e-9, 1e-9, 0.0], [2e-12, 0.0, 1e-12]])
def test_values_that_differ_in_late_digits_are_shown_above_their_lowest(excess: list[float]) -> None:
    """The labels of picture and interactive chart would otherwise differ in digits beyond the fifth, or not at all."""
    x, low = np.arange(3.0), 421.123456
    chart = Chart("Cost", "iteration", "cost, cm", [Line("a", x, low + np.array(excess), MODEL)], log=True)
    assert json.loads(chart_json(chart))["y"] == "cost above lowest, cm"
    shown = decoded(json.loads(chart_json(chart))["lines"][0]["y"], "<f4")
    np.testing.assert_allclose(shown, excess, rtol=1e-3, atol=2e-13)
    axes = draw(chart).axes[0]
    axes.figure.canvas.draw()
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert len(set(labels)) == len(labels) and max(map(len, labels)) <= 8


@pytest.mark.parametrize("values", [[421.0, 421.0], [0.0, 0.0], [421.0, 421.0 + 6e-14], [0.3, 0.31], [np.nan, 1.0]])
def test_values_that_are_equal_or_clearly_differ_are_shown_as_they_are(values: list[float]) -> None:
    assert of_chart(Line("a", np.arange(2.0), np.array(values), MODEL))["y"] == "level, cm"


def test_the_policy_allows_the_only_script_and_nothing_else() -> None:
    text = page([])
    (script,) = [part.partition("</script>")[0] for part in text.split("<script>")[1:]]
    assert script == SCRIPT and "</" not in SCRIPT and "Copyright (c) 2022 Leon Sorokin" in SCRIPT
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert POLICY.split("; ") == ["default-src 'none'", "style-src 'unsafe-inline'", f"script-src 'sha256-{digest}'"]
    assert f'content="{POLICY}"' in text


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    made = folder / "run.html"
    made.write_text(page([report_of(material_of(write_train(folder / "run.mcap")))]), encoding="utf-8")
    return made


@pytest.fixture
def tab(browser: Any, path: Path) -> Any:  # noqa: F811
    shown, said = opened(browser, path)
    draw_all(shown)
    yield shown
    assert said == []
    shown.context.close()


def figure(tab: Any, title: str) -> Any:
    return tab.locator("figure", has=tab.locator(f".chart-title:text-is('{title}')"))


def drag(tab: Any, title: str, first: float, last: float, key: str = "") -> None:
    """Drag over a chart between two shares of its width."""
    over = figure(tab, title).locator(".u-over")
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    y = box["y"] + box["height"] / 2
    if key:
        tab.keyboard.down(key)
    tab.mouse.move(box["x"] + first * box["width"], y)
    tab.mouse.down()
    tab.mouse.move(box["x"] + (first + last) / 2 * box["width"], y)
    tab.mouse.move(box["x"] + last * box["width"], y)
    tab.mouse.up()
    if key:
        tab.keyboard.up(key)


def shown_stretch(tab: Any, title: str) -> tuple[float, float]:
    words = figure(tab, title).locator(".stretch").text_content().split()
    return float(words[0]), float(words[2])


def zoomed(tab: Any, title: str) -> bool:
    return "zoomed" in figure(tab, title).get_attribute("class")


def test_the_crosshair_reads_out_the_samples_on_all_charts_of_the_recording(tab: Any) -> None:
    over = figure(tab, "h1").locator(".u-over")
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20)
    assert abs(float(figure(tab, "h1").locator(".at").text_content().split()[1]) - 499.5) < 5
    values = [cell.text_content() for cell in figure(tab, "h1").locator("output").all()]
    assert all(abs(float(value.split()[0]) - 100 * (0.3 + 0.1 * np.exp(-499.5 / 300))) < 0.5 for value in values)
    assert values[0].endswith(" cm")
    assert figure(tab, "h1: residual").locator("output").text_content().endswith(" cm")
    assert figure(tab, "Q1").locator("output").text_content().endswith(" cm³/s")


def test_a_selected_stretch_shows_its_residual_and_pans_and_resets(tab: Any) -> None:
    drag(tab, "h1", 0.2, 0.4)
    low, high = shown_stretch(tab, "h1: residual")
    assert abs(low - 200) < 8 and abs(high - 400) < 8 and zoomed(tab, "Q1") and zoomed(tab, "h1")
    words = figure(tab, "h1: residual").locator(".stretch").text_content()
    rms = float(words.partition("rms ")[2].split()[0])
    assert 0.085 < rms < 0.115, "noise of 1 mm over 200 samples"
    drag(tab, "h2", 0.75, 0.25, "Shift")
    moved, end = shown_stretch(tab, "h1: residual")
    assert abs(moved - low - 100) < 8 and end - moved == pytest.approx(high - low, rel=1e-3)
    figure(tab, "h1").locator(".field").press("ArrowLeft")
    assert shown_stretch(tab, "h1: residual")[0] == pytest.approx(moved - 0.25 * (high - low), rel=1e-3)
    figure(tab, "h1").locator(".field").dblclick()
    assert shown_stretch(tab, "h1: residual") == (0.0, 999.0) and not zoomed(tab, "h1")


def test_a_stretch_of_one_clock_leaves_the_others(tab: Any) -> None:
    drag(tab, "h1", 0.2, 0.4)
    assert zoomed(tab, "h2: residual") and not zoomed(tab, "T1.leak.size")


def test_a_chart_is_enlarged_with_its_residual_and_comes_back(tab: Any) -> None:
    before = figure(tab, "h1").locator("canvas").bounding_box()
    figure(tab, "h1").hover()
    figure(tab, "h1").get_by_text("Enlarge").click()
    tab.wait_for_timeout(100)
    inside = tab.locator("dialog[open] .chart-title").all_text_contents()
    assert inside == ["h1", "h1: residual"]
    assert figure(tab, "h1").locator("canvas").bounding_box()["width"] > 1.8 * before["width"]
    tab.keyboard.press("Escape")
    tab.wait_for_timeout(100)
    assert figure(tab, "h1").locator("canvas").bounding_box()["width"] == pytest.approx(before["width"], abs=2)
    assert tab.locator("dialog figure").count() == 0


def test_buttons_zoom_where_there_is_no_mouse(browser: Any, path: Path) -> None:  # noqa: F811
    tab, said = opened(browser, path, 390, has_touch=True, is_mobile=True)
    draw_all(tab)
    for name in ("Zoom in", "Zoom in", "Later"):
        figure(tab, "h1").get_by_label(name).tap()
    low, high = shown_stretch(tab, "h1: residual")
    assert (low, high) == (pytest.approx(437.06, rel=1e-3), pytest.approx(686.8, rel=1e-3))
    figure(tab, "h1").get_by_label("Show all").tap()
    assert shown_stretch(tab, "h1: residual") == (0.0, 999.0) and said == []


def test_without_scripts_and_on_paper_the_pictures_stay(browser: Any, path: Path) -> None:  # noqa: F811
    still, _ = opened(browser, path, java_script_enabled=False)
    pictures = still.locator("figure > svg")
    assert pictures.count() > 8 and all(picture.is_visible() for picture in pictures.all())
    tab, _ = opened(browser, path)
    draw_all(tab)
    assert not tab.locator(".live > svg").first.is_visible() and tab.locator("canvas").first.is_visible()
    tab.emulate_media(media="print")
    assert all(picture.is_visible() for picture in tab.locator("figure > svg").all())
    assert not tab.locator("canvas").first.is_visible()


ADOPTED = "leak at Zulauf and valve leak at Verbindung 12 and sensor bias at LI-101 adopted"
# Keeps the words that are written on canvases, with their left and right ends and the width of the canvas.
WRITTEN = """() => {
    window.written = [];
    const write = CanvasRenderingContext2D.prototype.fillText;
    CanvasRenderingContext2D.prototype.fillText = function (text, x, ...rest) {
        const wide = this.measureText(text).width, left = this.textAlign === "right" ? x - wide : x;
        written.push([text, left, left + wide, this.canvas.width]);
        write.call(this, text, x, ...rest);
    };
}"""


@pytest.mark.parametrize("moment", [3.0, 45.0, 55.0, 97.0])
def test_the_label_of_a_mark_is_not_cut_on_a_narrow_chart(browser: Any, moment: float, tmp_path: Path) -> None:  # noqa: F811
    line = Line("residual", TIME, np.sin(TIME), MODEL)
    chart = Chart("h1", "time, s", "residual, cm", [line], level=0.0, marks=[(moment, ADOPTED)])
    (tmp_path / "page.html").write_text(
        document("charts", [section_html(Section("Residuals", [[signals("h1", chart)]]), "r", "s")])
    )
    tab, said = opened(browser, tmp_path / "page.html", 500)
    draw_all(tab)
    tab.evaluate(WRITTEN)
    tab.set_viewport_size({"width": 390, "height": 900})
    tab.wait_for_timeout(200)
    parts = [each for each in tab.evaluate("written") if each[0] in ADOPTED and not each[0].isdigit()]
    assert " ".join(part for part, *_ in parts) == ADOPTED and len(parts) > 1
    assert all(left >= 0 and right <= wide for _, left, right, wide in parts)
    tab.context.close()
    assert said == []


@pytest.mark.parametrize("moment", [3.0, 45.0, 55.0, 97.0])
def test_the_label_of_a_mark_is_not_cut_in_a_picture(moment: float) -> None:
    chart = Chart("h1", "time, s", "residual, cm", [Line("r", TIME, np.sin(TIME), MODEL)], marks=[(moment, ADOPTED)])
    figure = draw(chart)
    figure.canvas.draw()
    (label,) = figure.axes[0].texts
    box = label.get_window_extent()
    assert box.x0 >= 0.0 and box.x1 <= figure.bbox.x1
    assert label.get_text().replace("\n", " ").startswith("leak at Zulauf and valve leak")
