"""Layouts for viewers: every message path exists in the log, found by the library's own reader of MCAP files."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_logs import FIXED, write_everything
from mcap.reader import make_reader

from fdi_torch.cli import DONE, MISUSE, main
from fdi_torch.logbook import RunLog, foxglove_layout, read_run, series

# Keys that the panels read: fields of PlotConfig, TableConfig, LogConfig, RawMessagesConfig in foxglove.layouts of
# foxglove-sdk 0.30.3, and of the types of these panels in Lichtblick (packages/suite-base/src/panels), camel case. The
# title is kept beside them by the viewer itself: PANEL_TITLE_CONFIG_KEY of packages/suite-base/src/util/layout.ts.
PANELS = {
    "Plot": {
        *("paths", "showLegend", "legendDisplay", "showXAxisLabels", "showYAxisLabels", "isSynced"),
        *("xAxisVal", "xAxisPath", "xAxisLabel", "yAxisLabel", "foxglovePanelTitle", "lichtblickPanelTitle"),
    },
    "Table": {"topicPath"},
    "RawMessages": {"topicPath"},
    "RosOut": {"searchTerms", "minLogLevel", "topicToRender"},
    "Tab": {"activeTabIdx", "tabs"},
}
DATA = Path(__file__).parents[1] / "data"
GOLDEN = sorted(DATA.glob("log_format_1*.mcap"))


def schemas(path: Path) -> dict[str, dict[str, str]]:
    """Topic -> field -> JSON type, from the summary of the file."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    found: dict[str, dict[str, str]] = {}
    for channel in summary.channels.values():
        properties = json.loads(summary.schemas[channel.schema_id].data)["properties"]
        found.setdefault(channel.topic, {}).update({name: part["type"] for name, part in properties.items()})
    return found


def paths(node: Any) -> Any:
    """Every text that begins like a topic."""
    if isinstance(node, dict):
        node = list(node.values())
    if isinstance(node, list):
        for part in node:
            yield from paths(part)
    elif isinstance(node, str) and node.startswith("/"):
        yield node


def expect_sound(layout: dict[str, Any], log: Path) -> list[str]:
    """The paths of a layout, all of which exist in the log; every panel is placed once."""
    known, shown = schemas(log), list(paths(layout["configById"]))
    for path in shown:
        # The grammar of paths in Lichtblick (packages/message-path/src/grammar.ne): a name or a quoted string.
        assert re.fullmatch(r'(/[A-Za-z0-9_-]+)+(\.([A-Za-z0-9_-]+|"([^"\\]|\\["\\])*"))?', path), path
        topic, _, name = path.partition(".")
        name = re.sub(r'\\(["\\])', r"\1", name[1:-1]) if name.startswith('"') else name
        assert topic in known and (not name or known[topic][name] in ("number", "integer")), path
    assert {"configById", "layout", "globalVariables", "userNodes", "playbackConfig"} == set(layout)
    for panel, config in layout["configById"].items():
        assert set(config) <= PANELS[panel.partition("!")[0]], panel
        for line in config.get("paths", ()):
            assert set(line) == {"value", "enabled", "timestampMethod", "label"}
        assert config.get("xAxisVal", "timestamp") == ("custom" if "xAxisPath" in config else "timestamp")
    tabs = layout["configById"]["Tab!fdi"]["tabs"]
    placed = re.findall(r'"(\w+!\w+)"', json.dumps([layout["layout"], *(tab["layout"] for tab in tabs)]))
    assert sorted(placed) == sorted(layout["configById"])
    return shown


@pytest.mark.parametrize("log", GOLDEN, ids=lambda path: path.stem)
def test_every_path_exists_in_the_log(log: Path) -> None:
    assert expect_sound(foxglove_layout(read_run(log)), log)


def test_a_plot_per_sensor_shows_measured_and_estimated(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        write_everything(log)
    assert main(["inspect", str(tmp_path / "a.mcap"), "--layout", str(tmp_path / "a.json")]) == DONE
    layout = json.loads((tmp_path / "a.json").read_text())
    shown = expect_sound(layout, tmp_path / "a.mcap")
    panels = [panel for panel in layout["configById"].values() if "paths" in panel]
    plots = {panel["foxglovePanelTitle"]: [line["value"] for line in panel["paths"]] for panel in panels}
    assert plots["h2, m"] == ["/plant/output.h2", "/estimate/output.h2"]
    residual = "/estimate/residual.h2"
    assert [residual, f"{residual}_low", f"{residual}_high"] in plots.values()
    assert plots["Inputs, m^3/s"] == ["/plant/input.Q1", "/plant/input.Q2"]
    for panel in panels:
        title, unit = panel["foxglovePanelTitle"], panel["foxglovePanelTitle"].rpartition(", ")[2]
        assert panel["lichtblickPanelTitle"] == panel["yAxisLabel"] == title and unit in ("m", "m^3/s", "no unit")
        assert all(line["label"].endswith(f", {unit}") for line in panel["paths"])
        assert panel["xAxisLabel"] == (
            "time, s" if panel["xAxisVal"] == "timestamp" else title.rpartition(" over ")[2][:-9]
        )
    assert {"/log", "/observer/alarm", "/gap/verdict", "/estimate/final"} <= set(shown)


def test_the_statistic_of_a_monitor_is_beside_its_threshold() -> None:
    panels = foxglove_layout(read_run(DATA / "log_format_1_monitor.mcap"))["configById"].values()
    title = "lichtblickPanelTitle"
    plots = {p[title]: [(line["value"], line["label"]) for line in p["paths"]] for p in panels if "paths" in p}
    test = [(f"/observer/residual.cusum_{name}", f"{name}, no unit") for name in ("statistic", "threshold")]
    assert plots["cusum: test statistic, no unit"] == test
    assert plots["h1: residual, m"] == [("/observer/residual.h1", "residual, m")]
    assert sum("cusum" in title for title in plots) == 1


def test_recordings_in_groups_have_plots_of_their_own_and_odd_names_are_quoted(tmp_path: Path) -> None:
    time, two, outputs = np.arange(3.0), np.zeros((3, 2)), ("h1", 'Füllstand "T.h" \\')
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        for group in ("1", "2"):
            log.recording(time, two, two, ("Q1", "Q 2"), outputs, ("m^3/s",) * 2, ("m",) * 2, group=group)
            log.predictions(time, two, two, outputs, ("m",) * 2, group=group)
    shown = expect_sound(foxglove_layout(read_run(tmp_path / "a.mcap")), tmp_path / "a.mcap")
    assert "/plant/2/output.h1" in shown and "/estimate/2/output.h1" in shown and "/plant/1/input.Q1" in shown
    assert '/plant/1/input."Q 2"' in shown and '/estimate/2/residual."Füllstand \\"T.h\\" \\\\"' in shown


def test_a_log_without_content_has_no_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED):
        pass
    assert main(["inspect", str(tmp_path / "a.mcap"), "--layout", str(tmp_path / "a.json")]) == MISUSE
    assert "got none that a layout could show" in capsys.readouterr().err and not (tmp_path / "a.json").exists()


def test_the_modelled_series_are_the_readings_less_the_residuals(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    time, outputs, model = np.arange(40.0), rng.standard_normal((40, 2)), rng.standard_normal((40, 2))
    mask = rng.random((40, 2)) > 0.2
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.predictions(time, outputs, model, ("h1", "h2"), ("m", "m"), mask=mask, noise_std=[0.1, 0.2])
    run = read_run(tmp_path / "a.mcap")
    predicted, residual = series(run, "/estimate/output"), series(run, "/estimate/residual")
    for k, name in enumerate(("h1", "h2")):
        np.testing.assert_array_equal(predicted[name], model[:, k])
        np.testing.assert_allclose(residual[name], np.where(mask[:, k], outputs[:, k] - model[:, k], np.nan))
        np.testing.assert_allclose(residual[f"{name}_high"], 1.96 * (0.1, 0.2)[k])
        np.testing.assert_allclose(residual[f"{name}_low"], -1.96 * (0.1, 0.2)[k])


@pytest.mark.parametrize("log", [GOLDEN[0], DATA / "log_format_1_gap.mcap"], ids=lambda path: path.stem)
def test_the_library_of_the_viewer_accepts_every_panel(log: Path) -> None:
    """foxglove.layouts has a class for the settings of each panel, which refuses names that the panel does not have."""
    library = pytest.importorskip("foxglove.layouts")
    classes = {
        "Plot": (library.PlotConfig, "paths", library.PlotSeries),
        "Table": (library.TableConfig, "", None),
        "RawMessages": (library.RawMessagesConfig, "", None),
        "RosOut": (library.LogConfig, "", None),
    }
    found = foxglove_layout(read_run(log))["configById"]
    panels = {name: config for name, config in found.items() if not name.startswith("Tab!")}
    assert panels
    for name, config in panels.items():
        untitled = {key: value for key, value in config.items() if "PanelTitle" not in key}  # it belongs to the panel
        assert _read(untitled, *classes[name.partition("!")[0]]) == untitled, name


def _read(config: dict[str, Any], kind: Any, inner: str, inner_kind: Any) -> dict[str, Any]:
    """The settings as the library's class writes them again."""
    settings = {_snake(key): value for key, value in config.items()}
    if inner:
        settings[inner] = [inner_kind(**{_snake(k): v for k, v in each.items()}) for each in config[inner]]
    return dict(json.loads(kind(**settings).to_json()))


def _snake(name: str) -> str:
    return re.sub("([A-Z])", lambda match: f"_{match[1].lower()}", name)
