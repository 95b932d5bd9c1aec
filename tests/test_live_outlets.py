"""Events by MQTT and metrics for Prometheus, as a client of each receives them."""

from __future__ import annotations

import json
import math
import threading
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_servers import broker, free_port
from test_live_mqtt import Rig, source
from test_monitor_follow import FAULT, SAMPLES, config, monitored, written

from fdi_torch.cli import main
from fdi_torch.live.metrics import Metrics
from fdi_torch.logbook import RunLog


def test_events_are_published_and_the_state_is_retained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("paho.mqtt.client")
    written(tmp_path / "rig.csv")
    received: list[Any] = []
    with broker(tmp_path) as running:
        url = f"mqtt://127.0.0.1:{running.port}/plant/monitor"
        listening, retained = Rig(running.port), threading.Event()
        listening.client.on_message = lambda *arguments: received.append(arguments[2])
        listening.client.subscribe("plant/monitor/event", qos=1)
        events = monitored(["--config", config(tmp_path), "--publish", url], capsys)
        late = Rig(running.port)
        late.client._client_id = b"late"
        state: list[Any] = []
        late.client.on_message = lambda *arguments: (state.append(arguments[2].payload), retained.set())
        late.client.subscribe("plant/monitor/state", qos=1)
        assert retained.wait(10.0)
        listening.close()
        late.close()
    assert [json.loads(message.payload) for message in received] == events
    assert json.loads(state[0])["state"] == events[-1]["state"]


def test_metrics_follow_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read at the end of the run, while the server still runs."""
    pytest.importorskip("prometheus_client")
    written(tmp_path / "rig.csv")
    port, pages = free_port(), []

    from fdi_torch.jobs.logged_monitor import LoggedMonitor

    close = LoggedMonitor.close

    def read(self: LoggedMonitor) -> None:
        close(self)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
            pages.append(answer.read().decode())

    monkeypatch.setattr(LoggedMonitor, "close", read)
    assert main(["monitor", "--config", config(tmp_path), "--metrics", str(port), "--quiet"]) == 0
    lines = dict(line.rsplit(" ", 1) for line in pages[0].splitlines() if not line.startswith("#"))
    assert float(lines["fdi_samples_total"]) == SAMPLES and float(lines["fdi_plant_time_seconds"]) == SAMPLES - 1
    assert float(lines['fdi_events_total{kind="alarm"}']) == 1
    assert float(lines['fdi_events_total{kind="recovered"}']) == 0
    assert float(lines[f'fdi_fault_present{{fault="{FAULT}"}}']) == 1
    assert float(lines[f'fdi_fault_size{{fault="{FAULT}"}}']) == pytest.approx(0.05, abs=0.01)
    assert float(lines['fdi_input{channel="Q1"}']) == pytest.approx(50e-6)
    assert 'fdi_reading{channel="h3"}' in lines and 'fdi_residual{channel="h3"}' in lines
    assert float(lines['fdi_detector{quantity="threshold"}']) > 0.0


def test_metrics_have_no_values_before_the_first_sample() -> None:
    """Nor numbers that could be taken for one: no time, reading, statistic or fault, and counters at 0."""
    library = pytest.importorskip("prometheus_client")
    samples = {s.name: s.value for family in Metrics(library).registry.collect() for s in family.samples}
    assert math.isnan(samples.pop("fdi_plant_time_seconds"))
    assert {name: value for name, value in samples.items() if not name.endswith("_created")} == {"fdi_samples_total": 0}


def test_the_metric_of_a_missing_reading_is_no_earlier_one(tmp_path: Path) -> None:
    """A dead sensor must not show its last level for ever."""
    metrics = Metrics(pytest.importorskip("prometheus_client"))
    with RunLog(tmp_path / "a.mcap", "monitor", listener=metrics) as log:
        log.samples("/plant/output", [0.0, 1.0], np.array([[0.1, 0.2], [math.nan, 0.3]]), ["h1", "h2"], ["m", "m"])
    shown = {name: metrics.registry.get_sample_value("fdi_reading", {"channel": name}) for name in ("h1", "h2")}
    assert math.isnan(shown["h1"] or 0.0) and shown["h2"] == 0.3


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--metrics", "everywhere"], "--metrics: expected [HOST:]PORT"),
        (["--publish", "http://127.0.0.1/x"], "--publish: expected a URL of the kind mqtt://HOST"),
        (["--publish", "mqtt://127.0.0.1:1/x"], "--publish: expected an MQTT broker at 127.0.0.1:1"),
    ],
)
def test_an_outlet_that_cannot_be_used_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], sentence: str
) -> None:
    written(tmp_path / "rig.csv")
    assert main(["monitor", "--config", config(tmp_path), "--quiet", *words]) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("library", "words", "extra"),
    [
        ("paho.mqtt.client", ["--publish", "mqtt://127.0.0.1/x"], "mqtt"),
        ("prometheus_client", ["--metrics"], "prometheus"),
        ("paho.mqtt.client", ["--source", "mqtt://127.0.0.1/rig"], "mqtt"),
        ("asyncua", ["--source", "opcua://127.0.0.1"], "opcua"),
        ("pymodbus.client", ["--source", "modbus://127.0.0.1"], "modbus"),
    ],
)
def test_a_missing_extra_is_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    library: str,
    words: list[str],
    extra: str,
) -> None:
    def absent(name: str) -> Any:
        raise ModuleNotFoundError(name=library.partition(".")[0])

    monkeypatch.setattr("fdi_torch.tables.import_module", absent)
    written(tmp_path / "rig.csv")
    changes = {"recording": None, "source": {**source(1), "clock": None}} if words[0] == "--source" else {}
    assert main(["monitor", "--config", config(tmp_path, **changes), "--quiet", *words]) == 2
    assert f"pip install 'fdi_torch[{extra}]'" in capsys.readouterr().err
