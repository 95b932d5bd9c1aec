"""The page says what the log says, escapes everything, and stands alone."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from sample_runs import NASTY, material_of, write_train

from fdi_torch import cli
from fdi_torch.config.plant_file import load_plant
from fdi_torch.logbook import RunLog
from fdi_torch.report.page import RunReport, page, report_of, write_pictures
from fdi_torch.report.verdict import headline

# Eight lists, each ten times the one before: a hundred million values.
BOMB = "a0: &a0 [1]\n" + "".join(f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9))


class Tags(HTMLParser):
    """Every tag and attribute of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_train(tmp_path_factory.mktemp("logs") / "run.mcap")


@pytest.fixture(scope="module")
def reported(log: Path) -> RunReport:
    return report_of(material_of(log, load_plant("three_tank")))


@pytest.fixture(scope="module")
def text(reported: RunReport) -> str:
    return page([reported])


def test_the_verdict_comes_first_in_words(log: Path, text: str) -> None:
    assert headline(material_of(log)) == "Single fault: leak at T1 (size 0.3004 ± 0.0020, 30 cm^3/s)"
    assert text.index("Single fault: leak at T1") < text.index("<svg")
    assert "0.3004 ± 0.0020" in text
    assert "leak at T1 changes the flow by 30 cm³/s at the mean levels, as a sharp-edged hole of 4.8 mm would" in text


def test_each_section_is_there_that_the_log_has_something_for(log: Path, reported: RunReport) -> None:
    with_plant = [s.title for s in reported.sections]
    assert with_plant[:4] == ["The rig", "Estimate", "Readings against the estimate", "Inputs"]
    assert [s.title for s in report_of(material_of(log)).sections] == with_plant[1:]


def test_the_page_needs_nothing_from_outside(text: str) -> None:
    tags = Tags(text)
    assert tags.names.count("script") == 1, "the charts, which the policy allows by their hash"
    assert not {"link", "iframe", "object", "img", "foreignobject"} & set(tags.names)
    pointing = [v for n, v in tags.attributes if n in ("href", "src", "xlink:href", "action")]
    assert all(v.startswith("#") for v in pointing)
    assert not [n for n, _ in tags.attributes if n.startswith("on")]


def test_ids_are_unique_and_every_reference_has_its_target(reported: RunReport) -> None:
    text = page([reported] * 2)
    ids = [v for n, v in Tags(text).attributes if n == "id"]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:url\(#|href="#)([^")]+)', text)) == set(ids)


def test_a_name_with_markup_is_only_a_name(tmp_path: Path) -> None:
    path = write_train(tmp_path / "run.mcap", name=f"{NASTY}.$x_{{\\frac\x00\u202e")
    text = page([report_of(material_of(path, load_plant("three_tank")))])
    assert Tags(text).names.count("script") == 1, "that of the charts"
    assert "&lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt;" in text
    assert "\x00" not in text and "\u202e" not in text


def test_a_message_that_makes_no_sense_costs_its_section_only(tmp_path: Path) -> None:
    with RunLog(tmp_path / "odd.mcap", "train", env={}, git={}) as log:
        log.write("/estimate/final", {"names": ["a", "b"], "values": [1.0], "std": [1.0]})
        log.write("/diagnosis/fault", {"fault": "leak", "location": "T1", "present": True, "size": "large"})
    report = report_of(material_of(tmp_path / "odd.mcap"))
    assert headline(report.material) == "Single fault: leak at T1"
    assert "The log cannot be shown here: ValueError" in page([report])
    assert "Integrity of the log" in [s.title for s in report.sections]


def test_a_torn_log_is_shown_and_said_to_be_torn(log: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap.partial"
    torn.write_bytes(log.read_bytes()[:-5000])
    text = page([report_of(material_of(torn))])
    assert "damaged" in text and "fdi recover" in text


def test_pictures_are_written_as_png_and_svg_and_repeat(log: Path, tmp_path: Path) -> None:
    first = write_pictures(report_of(material_of(log)).pictures, tmp_path / "a")
    again = write_pictures(report_of(material_of(log)).pictures, tmp_path / "b")
    assert {p.suffix for p in first} == {".png", ".svg"}
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in again]
    assert first[0].read_bytes().startswith(b"\x89PNG")


def test_the_command_writes_the_page_beside_the_log(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", str(log), "--pictures", "--quiet"]) == cli.DONE
    assert log.with_suffix(".html").read_text(encoding="utf-8").startswith("<!doctype html>")
    assert (log.with_suffix("") / "rig.svg").exists()
    assert "Single fault: leak at T1" in capsys.readouterr().out


def test_a_page_that_would_overwrite_a_log_is_refused(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", str(log), "--out", str(log)]) == cli.MISUSE
    assert "expected a page that ends in .html, or a folder, got" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        ("plant: ../../etc/plant.yaml\n", "got '../../etc"),
        ("plant: [1]\n", "expected a plant, got list"),
        (BOMB, "expected at most 100000 values"),
        ("!!python/object/apply:os.system ['false']\n", "expected plain values, got the tag"),
        ("# " + 1_100_000 * "x", "expected at most 1048576 bytes of YAML"),
        ("", "expected a configuration in the log, got none"),
    ],
)
def test_a_configuration_in_a_log_opens_and_runs_nothing(
    config: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunLog(tmp_path / "run.mcap", "train", config_text=config, env={}, git={}):
        pass
    assert cli.main(["report", str(tmp_path / "run.mcap")]) == cli.DONE
    assert sentence in capsys.readouterr().err
