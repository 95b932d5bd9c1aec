"""Every kind of page in a real browser: wide and narrow, light and dark, and on paper.

The screenshots lie in pytest's folder for temporary files; with `--basetemp=FOLDER` they are easy to look at.
"""

from __future__ import annotations

import io
import re
import unicodedata
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from browser import browser, draw_all, opened  # noqa: F401
from matplotlib.image import imread
from sample_runs import (
    NASTY,
    material_of,
    write_challenge,
    write_gap,
    write_monitor,
    write_rehearsal,
    write_study,
    write_train,
)

from fdi_torch import Plant
from fdi_torch.config.plant_file import load_plant
from fdi_torch.jobs.report import comparison_of
from fdi_torch.plant.description import Pipe, Sensor, Tank
from fdi_torch.report.page import RunReport, document, page, report_of
from fdi_torch.report.schematic import Overlay, schematic
from fdi_torch.report.section import Picture, Section, section_html
from fdi_torch.view.log_list import LogList
from fdi_torch.view.pages import list_page, query_of

DATA = Path(__file__).parents[1] / "data"
WRITERS = {
    "train": (write_train, "three_tank"),
    "gap": (write_gap, "quadruple_tank"),
    "monitor": (write_monitor, "dts200"),
    "study": (write_study, "cascaded_tanks"),
    "challenge": (write_challenge, "three_tank"),
    "rehearsal": (write_rehearsal, "three_tank"),
}
LOGS = ("windows", "what_if", "monitor", "gap")
KINDS = (*WRITERS, *(f"logged_{name}" for name in LOGS), "compare", "nasty", "view")
PAPER, PAGE = 688, 1009  # pixels of an A4 page between its margins

# The words of each table that fits on a page.
BLOCKS = """most => [...document.querySelectorAll("table")].filter(table => table.checkVisibility()
    && table.getBoundingClientRect().height < 0.95 * most).map(table => table.innerText)"""

# What is wrong with a page, in words. Text on a canvas is not seen; whether it is drawn is.
FAULTS = """() => {
  const wrong = [], body = document.body;
  if (document.documentElement.scrollWidth > innerWidth) wrong.push("the page is wider than the window");
  const numbers = colour => (colour.match(/[\\d.]+/g) || []).map(Number);
  const light = colour => {
    const linear = v => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    const [r, g, b] = numbers(colour).map(v => linear(v / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = element => {
    for (let e = element; e; e = e.parentElement) {
      const colour = getComputedStyle(e).backgroundColor;
      if (numbers(colour).length === 3) return colour;
    }
    return "rgb(255, 255, 255)";
  };
  // The topmost shape of a picture that lies below a text, over the ground of the page.
  const below = (svg, text, box) => {
    const x = (box.left + box.right) / 2, y = (box.top + box.bottom) / 2;
    let colour = ground(svg.parentElement);
    for (const shape of svg.querySelectorAll("path, rect, text")) {
      if (shape === text) return colour;
      const around = shape.getBoundingClientRect(), style = getComputedStyle(shape), fill = numbers(style.fill);
      const inside = around.left <= x && x <= around.right && around.top <= y && y <= around.bottom;
      if (shape.tagName === "text" || !inside || fill.length < 3) continue;
      const share = (fill[3] ?? 1) * style.opacity * style.fillOpacity, under = numbers(colour);
      colour = `rgb(${under.map((value, k) => share * fill[k] + (1 - share) * value).join()})`;
    }
    return colour;
  };
  const boxes = [], walker = document.createTreeWalker(body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode, parent = node.parentElement, text = node.textContent.trim();
    if (!text || parent.closest("script, style, nav") || !parent.checkVisibility({ opacityProperty: true })) continue;
    const range = document.createRange(), style = getComputedStyle(parent), svg = parent.closest("svg");
    range.selectNodeContents(node);
    const slanted = svg && /rotate\\((?!-?(0|90)[ )])/.test(parent.getAttribute("transform") || "");
    const own = svg ? [parent.getBoundingClientRect()] : [...range.getClientRects()];
    for (const box of own) if (box.width && box.height && !slanted) boxes.push({ box, text, svg });
    const [a, b] = [light(svg ? style.fill : style.color), light(svg ? below(svg, parent, own[0]) : ground(parent))];
    const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (contrast < 4.5) wrong.push(`contrast of ${contrast.toFixed(2)}: ${text}`);
    const matrix = svg && parent.getScreenCTM(), scale = svg ? Math.hypot(matrix.a, matrix.b) : 1;
    const letters = scale * parseFloat(style.fontSize), least = matchMedia("print").matches ? 10 : 11;
    if (letters < least) wrong.push(`letters of ${letters.toFixed(1)} pixels: ${text}`);
    if (/(^|[\\s(])-\\d/.test(text) && !parent.closest("pre")) wrong.push(`a hyphen for a minus sign: ${text}`);
    const cut = own.some(box => box.right > innerWidth + 1) && !parent.closest(".scroll, .wide");
    if (cut) wrong.push(`cut off: ${text}`);
  }
  boxes.sort((one, other) => one.box.top - other.box.top);
  boxes.forEach((one, i) => {
    for (let k = i + 1; k < boxes.length && boxes[k].box.top < one.box.bottom - 3; k++) {
      const other = boxes[k];
      const across = Math.min(one.box.right, other.box.right) - Math.max(one.box.left, other.box.left);
      const down = Math.min(one.box.bottom, other.box.bottom) - other.box.top;
      if (across > 3 && down > 3) wrong.push(`on top of each other: ${one.text} | ${other.text}`);
    }
  });
  for (const cell of document.querySelectorAll("td.l")) {
    const line = parseFloat(getComputedStyle(cell).lineHeight), text = document.createRange();
    text.selectNodeContents(cell);
    const broken = /^[a-z]{1,12}$/i.test(cell.textContent) && text.getBoundingClientRect().height > 1.5 * line;
    if (broken) wrong.push(`a word of two lines: ${cell.textContent}`);
  }
  for (const figure of document.querySelectorAll("figure")) {
    const shown = [...figure.querySelectorAll("svg, canvas")].filter(picture => picture.checkVisibility());
    if (shown.length !== 1) wrong.push(`${shown.length} pictures in one figure`);
    const canvas = shown.find(picture => picture.tagName === "CANVAS");
    if (!canvas) continue;
    const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    let drawn = 0;
    for (let k = 3; k < pixels.length; k += 4) drawn += pixels[k] > 0;
    if (drawn < 0.005 * canvas.width * canvas.height) wrong.push("an empty chart");
  }
  return [...new Set(wrong)];
}"""


def made(kind: str, folder: Path) -> str:
    """The page of a kind of run."""

    def report(path: Path, plant: str = "three_tank") -> RunReport:
        return report_of(material_of(path, load_plant(plant)))

    if kind == "compare":
        long = {name: f"[{','.join(f'{name}_{k}.plugging.size' for k in range(30))}]" for name in ("first", "second")}
        both = [report(write_train(folder / f"{name}.mcap", setting=text)) for name, text in long.items()]
        return page(both, [comparison_of(both)])
    if kind == "view":
        logs = LogList(DATA)
        return list_page("data", logs.entries(), ("train", "gap"), query_of({}), len(logs.entries()))
    if kind == "nasty":
        return page([report(write_train(folder / "nasty.mcap", name=f"{NASTY * 4}.leak.size"))])
    if kind.startswith("logged_"):
        return page([report(DATA / f"log_format_1_{kind.removeprefix('logged_')}.mcap")])
    write, plant = WRITERS[kind]
    return page([report(write(folder / f"{kind}.mcap"), plant)])


@pytest.fixture(scope="module", params=KINDS)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("pages") / f"{request.param}.html"
    target.write_text(made(request.param, target.parent), encoding="utf-8")
    return target


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_page_can_be_read_on_a_desk_and_a_phone(browser: Any, path: Path, width: int, scheme: str) -> None:  # noqa: F811
    """The layout depends on the width alone, the contrast on the scheme alone."""
    tab, said = opened(browser, path, width, color_scheme=scheme)
    draw_all(tab)
    assert tab.evaluate(FAULTS) == [] and said == []
    target = path.with_name(f"{path.stem}_{width}_{scheme}.png")
    tab.screenshot(path=target, full_page=True)
    pixels = imread(target)[:, :, :3]
    assert pixels.shape[1] == width and pixels.std() > 0.02
    assert (pixels.mean() > 0.8) if scheme == "light" else (pixels.mean() < 0.3)
    tab.context.close()


def test_rows_of_charts_are_full(browser: Any, tmp_path: Path) -> None:  # noqa: F811
    """Of a wide page; with two columns an odd number leaves one place free."""
    path = tmp_path / "page.html"
    style = (resources.files("fdi_torch.report") / "assets" / "page.css").read_text()
    grids = "".join(f"<div class=grid>{'<figure><svg></svg></figure>' * count}</div>" for count in range(2, 12))
    path.write_text(f"<style>{style}</style><main><section>{grids}</section></main>")
    tab, _ = opened(browser, path)
    tops = "[...document.querySelectorAll('.grid')].map(grid => [...grid.children].map(figure => figure.offsetTop))"
    for of_grid in tab.evaluate(tops):
        rows = [of_grid.count(top) for top in dict.fromkeys(of_grid)]
        assert set(rows) <= {2, 3} and rows == sorted(rows, reverse=True)
    tab.context.close()


def test_still_pictures_of_charts_have_one_scale(browser: Any, tmp_path: Path) -> None:  # noqa: F811
    """Without scripts, however many stand in a row."""
    path = tmp_path / "page.html"
    style = (resources.files("fdi_torch.report") / "assets" / "page.css").read_text()
    figure = '<figure data-clock="run"><svg viewBox="0 0 230 166"></svg></figure>'
    grids = "".join(f"<div class=grid>{figure * count}</div>" for count in (1, 2, 3))
    path.write_text(f"<style>{style}</style><main><section>{grids}</section></main>")
    tab, _ = opened(browser, path)
    for media, width in (("screen", 1280), ("print", PAPER)):
        tab.set_viewport_size({"width": width, "height": 900})
        tab.emulate_media(media=media)
        widths = tab.evaluate("[...document.querySelectorAll('svg')].map(svg => svg.getBoundingClientRect().width)")
        assert max(widths) < 1.05 * min(widths), (media, widths)
    tab.context.close()


@pytest.mark.slow
def test_a_page_can_be_printed(browser: Any, path: Path) -> None:  # noqa: F811
    pypdf = pytest.importorskip("pypdf")
    tab, said = opened(browser, path, PAPER, color_scheme="dark")
    draw_all(tab)
    tab.emulate_media(media="print")
    assert tab.evaluate(FAULTS) == [] and said == []
    printed = tab.pdf(prefer_css_page_size=True, format="A4")
    path.with_suffix(".pdf").write_bytes(printed)
    before_content = "h1, h2, h3, h4, summary, p:has(+ .grid)"
    leading = tab.eval_on_selector_all(before_content, "all => all.map(each => each.textContent)")
    pages = [squeezed(each.extract_text()) for each in pypdf.PdfReader(io.BytesIO(printed)).pages]
    for words in tab.evaluate(BLOCKS, PAGE):
        ends = squeezed(words)[:40], squeezed(words)[-40:]
        assert any(all(end in text for end in ends) for text in pages), f"broken between two pages: {words[:80]}"
    for k, text in enumerate(pages[:-1]):
        last = [words for words in map(squeezed, leading) if text.endswith(words[-60:])]
        assert not last, f"page {k + 1} ends with what belongs to the next one: {last}"
    tab.context.close()


def squeezed(text: str) -> str:
    """Text without spaces and ligatures, which PDF does not keep or adds."""
    return re.sub(r"\s", "", unicodedata.normalize("NFKC", text))


FLOW = {"std": 2.5e-6, "unit": "m^3/s", "correlation_time": 15.0}


@pytest.mark.parametrize("plant", ["three_tank", "quadruple_tank"])
def test_the_result_of_a_gap_is_on_one_screen(browser: Any, plant: str, tmp_path: Path) -> None:  # noqa: F811
    """With tanks in a row, or in two; random flows are a section more, by which the index fills a line more."""
    target, height = tmp_path / "gap.html", 900
    log = write_gap(tmp_path / "gap.mcap", disturbances={"T1": FLOW})
    target.write_text(page([report_of(material_of(log, load_plant(plant)))]))
    tab, _ = opened(browser, target)
    for title in ("The rig", "What causes it", "Where the gap lies", "How far it closes"):
        box = tab.locator("section", has=tab.locator(f"h3:text-is('{title}')")).bounding_box()
        assert box["y"] >= 0 and box["y"] + box["height"] <= height, title
    tab.context.close()


@pytest.mark.parametrize(("name", "width"), [("T1.leak.size", 1100), ("Zulauf_FIC_101.pump_lag.time_constant", 1280)])
def test_an_estimate_beside_the_rig_shows_all_its_columns(browser: Any, tmp_path: Path, name: str, width: int) -> None:  # noqa: F811
    """A long name takes its place from the rig. A still longer one scrolls within its card."""
    target = tmp_path / "train.html"
    target.write_text(
        page([report_of(material_of(write_train(tmp_path / "train.mcap", name), load_plant("three_tank")))])
    )
    tab, _ = opened(browser, target, width)
    hidden = tab.locator(".lead .scroll").first.evaluate("e => e.scrollWidth - e.clientWidth")
    rig, window = tab.locator(".lead > section").first.bounding_box(), tab.evaluate("document.body.scrollWidth")
    assert hidden <= 0 and rig["width"] >= 280 and window <= width
    tab.context.close()


def test_a_wide_rig_scrolls_on_a_phone_at_a_scale_that_can_be_read(browser: Any, tmp_path: Path) -> None:  # noqa: F811
    names = [f"T{k}" for k in range(8)]
    pipes = [Pipe(f"from{a}", a, b, 1e-4, 0.6) for a, b in pairwise(names)]
    plant = Plant([Tank(name, 0.1, 1.0) for name in names], pipes, sensors=[Sensor("h", "T0")])
    rig = schematic(plant, Overlay(marks={"T7": ["leak 0.3"]}))
    (tmp_path / "rig.html").write_text(
        document("rig", [section_html(Section("rig", [[Picture("rig", rig, "The rig", wide=True)]]), "a", "s")])
    )
    for width, scrolls in ((390, True), (1280, False)):
        tab, _ = opened(browser, tmp_path / "rig.html", width)
        high = tab.evaluate("document.querySelector('figure text').getBoundingClientRect().height")
        assert high >= 9.0, width
        assert tab.evaluate("(f => f.scrollWidth > f.clientWidth)(document.querySelector('figure'))") is scrolls
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
        box = tab.get_by_text("leak 0.3").bounding_box()
        assert 0 < box["x"] < width - box["width"], "what is diagnosed is in view"
