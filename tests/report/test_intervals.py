"""Profiles and draws of a log stand on its page beside the standard errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fdi_torch.logbook import RunLog, read_run
from fdi_torch.report.material import gather
from fdi_torch.report.page import page, report_of
from fdi_torch.report.sections.intervals import intervals_section

NAMES = ["T1.leak.size", "T1.start_level"]


def write_log(path: Path, *, profiles: bool = True, draws: bool = True) -> Path:
    x = np.linspace(0.0, 0.3, 7)
    profile = {
        **{"name": NAMES[0], "unit": "1", "confidence": 0.9, "value": 0.0, "low": 0.0, "high": 0.2125},
        **{"ends": ["low"], "x": x.tolist(), "ratio": ((x / 0.1) ** 2).tolist(), "improvement": 0.0},
        "warnings": ["2 of 7 fits did not converge"],
    }
    with RunLog(path, "train", config_text="plant: three_tank\n") as log:
        log.estimate(NAMES, [0.1, 0.4], [0.05, 0.01], np.eye(2), "converged", units=["1", "m"])
        if draws:
            values = np.stack([np.linspace(0.0, 0.2, 401), np.linspace(0.3, 0.5, 401)], -1)
            log.result_arrays(draws=values.reshape(1, 401, 2))
        log.result(
            {**({"profiles": [profile]} if profiles else {}), **({"draws": {"warnings": ["R-hat"]}} if draws else {})}
        )
    return path


def test_the_limits_stand_side_by_side_with_their_pictures(tmp_path: Path) -> None:
    material = gather(read_run(write_log(tmp_path / "run.mcap")))
    section = intervals_section(material)
    assert section is not None
    text = page([report_of(material)])
    body = text[text.index("Standard errors assume") : text.index("</section>", text.index("Standard errors assume"))]
    assert "0.002 … 0.198" in body, "0.1 ± 1.96 * 0.05"
    assert "0 … 0.2125 (90 %)" in body and "the low end is the end of its range" in body
    assert "0.005 … 0.195" in body, "draws of the leak without 2.5 % on either side"
    assert "30.5 … 49.5" in body and "38.04 … 41.96" in body, "levels in cm"
    assert "2 of 7 fits did not converge" in body and "R-hat" in body
    assert [picture.name for picture in section.pictures] == ["profile_1", "draws_1", "draws_2"]
    assert section.pictures[0].chart is not None and section.pictures[0].chart.level is not None
    assert abs(section.pictures[0].chart.level - 1.645**2) < 1e-2


def test_a_log_with_one_of_them_has_the_section_and_one_without_has_none(tmp_path: Path) -> None:
    for k, (profiles, draws) in enumerate(((True, False), (False, True), (False, False))):
        path = write_log(tmp_path / f"{k}.mcap", profiles=profiles, draws=draws)
        section = intervals_section(gather(read_run(path)))
        assert (section is None) == (not profiles and not draws)
