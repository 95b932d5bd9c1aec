"""The example of docs/examples/live: its rig, monitor and dashboard work together."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml
from live_servers import broker
from test_monitor_follow import monitored

from fdi_torch.cli import main
from fdi_torch.live.metrics import Metrics
from fdi_torch.live.mqtt import MqttClient

EXAMPLE = Path(__file__).parents[1] / "docs/examples/live"


@pytest.mark.slow
def test_the_monitor_isolates_the_leak_of_the_replayed_rig(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("paho.mqtt.client")
    assert main(["simulate", "--config", str(EXAMPLE / "record.yaml"), "--out", str(tmp_path), "--quiet"]) == 0
    capsys.readouterr()
    connected, original = threading.Event(), MqttClient._connected

    def patched(self: MqttClient, *arguments: Any) -> None:
        original(self, *arguments)
        connected.set()

    monkeypatch.setattr(MqttClient, "_connected", patched)
    with broker(tmp_path) as running:

        def replay() -> None:
            assert connected.wait(60.0)
            words = [tmp_path / "rig.csv", "--port", running.port, "--speed", 400]
            subprocess.run([sys.executable, EXAMPLE / "replay.py", *map(str, words)], check=True)

        thread = threading.Thread(target=replay)
        thread.start()
        words = ["--config", str(EXAMPLE / "watch.yaml"), "--source", f"mqtt://127.0.0.1:{running.port}/rig"]
        events = monitored([*words, "--idle", "3", "--out", str(tmp_path / "logs")], capsys)
        thread.join()
    isolated = next(event for event in events if event["kind"] == "isolated")
    assert isolated["faults"] == ["T3.leak.size"]
    assert isolated["onset"] == pytest.approx(600.0, abs=4.0 * float(str(isolated["onset_std"])))


def test_the_compose_file_names_files_that_exist_and_opens_ports_to_this_machine_only() -> None:
    services = yaml.safe_load((EXAMPLE / "compose.yaml").read_text())["services"]
    assert set(services) == {"broker", "monitor", "rig", "prometheus", "grafana"}
    for service in services.values():
        for volume in service.get("volumes", []):
            assert not volume.startswith("./") or (EXAMPLE / volume.partition(":")[0]).is_file(), volume
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))
        if "build" in service:
            assert (EXAMPLE / service["build"]["context"] / service["build"]["dockerfile"]).is_file()


def test_the_dashboard_shows_metrics_that_the_monitor_serves() -> None:
    served = {family.name for family in Metrics(pytest.importorskip("prometheus_client")).registry.collect()}
    panels = json.loads((EXAMPLE / "grafana/dashboard.json").read_text())["panels"]
    shown = {name for panel in panels for target in panel["targets"] for name in re.findall(r"fdi_\w+", target["expr"])}
    assert shown and {name.removesuffix("_total") for name in shown} <= served
