"""The page in a real browser, wide and narrow: nothing sticks out, no picture is missing, letters can be read."""

from __future__ import annotations

import html
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
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

from fdi_torch.config import load_plant
from fdi_torch.report.page import page, report_of

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
pytestmark = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")

# One frame of the wanted width for each page and width: the window itself cannot be made narrow everywhere.
MEASURE = """
<script>
onload = () => {
  const frames = [...document.querySelectorAll("iframe")];
  document.body.dataset.found = JSON.stringify(frames.map(frame => {
    const page = frame.contentDocument, root = page.documentElement;
    const boxes = [...page.querySelectorAll("svg")].map(svg => svg.getBoundingClientRect())
      .filter(box => box.width);
    const letters = [...page.querySelectorAll("svg text")].map(text => text.getBoundingClientRect().height)
      .filter(height => height);
    return {width: root.clientWidth, needed: root.scrollWidth, pictures: boxes.length,
      smallest: Math.min(...boxes.map(box => Math.min(box.width, box.height))),
      right: Math.max(...boxes.map(box => box.right)), letters: Math.min(...letters),
      title: page.querySelector("h2").textContent, scripts: page.scripts.length};
  }));
};
</script>
"""


def measured(pages: list[Path], widths: list[int], folder: Path) -> list[dict[str, Any]]:
    """What the browser says of each page at each width, and its screenshot."""
    frames = [
        f'<iframe src="{p.name}" style="width:{w}px;height:900px;border:0"></iframe>' for w in widths for p in pages
    ]
    (folder / "all.html").write_text("<!doctype html><body>" + "".join(frames) + MEASURE, encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--hide-scrollbars"]
    command = [CHROMIUM, *options, f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=20000", "--dump-dom"]
    done = subprocess.run([*command, f"file://{folder / 'all.html'}"], capture_output=True, text=True, timeout=120)
    text = done.stdout.partition('data-found="')[2].partition('"')[0]
    return json.loads(html.unescape(text))


def test_pages_fit_a_desk_and_a_phone(tmp_path: Path) -> None:
    writers = (write_train, write_gap, write_monitor, write_study, write_challenge, write_rehearsal)
    pages, plants = [], ("three_tank", "quadruple_tank", "dts200", "cascaded_tanks", "three_tank", "three_tank")
    for write, plant in zip(writers, plants, strict=True):
        material = material_of(write(tmp_path / f"{write.__name__}.mcap"), load_plant(plant))
        pages.append(tmp_path / f"{write.__name__}.html")
        pages[-1].write_text(page([report_of(material)]), encoding="utf-8")
    nasty = material_of(write_train(tmp_path / "nasty.mcap", name=f"{NASTY * 4}.leak.size"), load_plant("three_tank"))
    pages.append(tmp_path / "nasty.html")
    pages[-1].write_text(page([report_of(nasty)]), encoding="utf-8")
    found = measured(pages, [1280, 390], tmp_path)
    assert [view["width"] for view in found] == [1280] * 7 + [390] * 7
    for view, shown in zip(found, [*pages, *pages], strict=True):
        assert view["needed"] <= view["width"], f"{view['title']} sticks out at {view['width']}"
        assert view["pictures"] >= (1 if shown.stem == write_rehearsal.__name__ else 2)
        assert view["smallest"] > 40 and view["right"] <= view["width"]
        assert view["letters"] >= 8.5, f"{view['title']}: letters of {view['letters']} pixels at {view['width']}"
        assert view["scripts"] == 1


@pytest.mark.parametrize("width", [1280, 390])
def test_a_screenshot_shows_the_page(width: int, tmp_path: Path) -> None:
    source, target = tmp_path / "page.html", tmp_path / "page.png"
    material = material_of(write_train(tmp_path / "run.mcap"), load_plant("three_tank"))
    source.write_text(page([report_of(material)]), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={tmp_path / 'p'}"]
    command = [CHROMIUM, *options, f"--window-size={width},2000", f"--screenshot={target}", f"file://{source}"]
    subprocess.run(command, capture_output=True, timeout=120, check=True)
    from matplotlib.image import imread

    pixels = imread(target)
    assert pixels.shape[:2] == (2000, width)
    assert pixels[:, :, :3].std() > 0.05, "the screenshot is empty"
