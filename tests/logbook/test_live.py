"""The log of a running job as received by a viewer over the Foxglove WebSocket protocol."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_logs import FIXED, log_generation

from fdi_torch.cli import MISUSE, main
from fdi_torch.logbook import Live, RunLog, read_run, serve

Received = dict[str, list[tuple[int, bytes]]]


class Viewer:
    """As much of a viewer as it takes: it asks for every channel that is offered, and keeps what comes."""

    def __init__(self, address: str) -> None:
        client = pytest.importorskip("websockets.sync.client")
        self.connection = client.connect(address, subprotocols=["foxglove.sdk.v1"])
        self.channels: dict[int, dict[str, Any]] = {}
        self.received: Received = {}

    def __enter__(self) -> Viewer:
        self.socket = self.connection.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.connection.__exit__(*error)

    def listen(self, quiet: float = 1.5) -> Received:
        """All that comes until nothing has come for a while: topic -> (log time in ns, payload)."""
        while True:
            try:
                message = self.socket.recv(timeout=quiet)
            except TimeoutError:
                return self.received
            if isinstance(message, bytes):
                kind, number, log_time = struct.unpack_from("<BIQ", message)
                assert kind == 1
                self.received.setdefault(self.channels[number]["topic"], []).append((log_time, message[13:]))
            elif (told := json.loads(message))["op"] == "advertise":
                self.channels |= {channel["id"]: channel for channel in told["channels"]}
                wanted = [{"id": c["id"], "channelId": c["id"]} for c in told["channels"]]
                self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def write(log: RunLog, generations: range) -> None:
    for g in generations:
        log_generation(log, g, 1.0 / (g + 1), {"T1.leak.size": 0.1 * g})


@pytest.fixture
def live() -> Any:
    pytest.importorskip("foxglove")
    with serve("a run", port=0) as server:
        yield server


def test_a_viewer_gets_what_the_log_holds(tmp_path: Path, live: Live) -> None:
    with (
        Viewer(live.address) as early,
        Viewer(live.address) as late,
        RunLog(tmp_path / "run.mcap", "train", **FIXED, listener=live) as log,
    ):
        early.listen()
        log.recording(np.arange(3000.0), np.ones((3000, 1)), np.ones((3000, 1)), ("Q1",), ("h1",), ("m^3/s",), ("m",))
        write(log, range(5))
        late.listen()
        write(log, range(5, 9))
        log.say("done")
        heard = [viewer.listen() for viewer in (early, late)]
    run = read_run(tmp_path / "run.mcap")
    logged: Received = {}
    for m in run.messages():
        logged.setdefault(m.topic, []).append((m.log_time, m.data))
    assert heard[0].keys() == logged.keys() == heard[1].keys()
    for topic, messages in logged.items():
        assert messages == heard[1][topic], f"{topic}: late"
        assert messages == heard[0][topic], f"{topic}: early"
    told = {channel["topic"]: channel for channel in late.channels.values()}
    for m in run.messages():
        offered = told[m.topic]
        assert offered["encoding"] == "json" and offered["schema"].encode() == m.channel.schema_data
        assert offered["schemaName"] == m.channel.schema_name and offered["metadata"] == dict(m.channel.metadata)


def test_the_command_serves_and_says_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("foxglove")
    few = ["simulate.duration=100 s", "estimate.parameters=[T1.leak]", "estimate.search.evaluations=100"]
    changes = [word for change in [*few, "estimate.step={search: 10 s, refine: 5 s}"] for word in ("--set", change)]
    main(["train", "--live", "0", "--out", str(tmp_path), *changes])
    assert "live: ws://127.0.0.1:" in capsys.readouterr().err


@pytest.mark.parametrize("asked", ["here", "localhost:", "127.0.0.1:99999"])
def test_an_address_that_is_none(asked: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--live", asked]) == MISUSE
    assert f"--live: expected [HOST:]PORT such as 127.0.0.1:8765, got {asked}" in capsys.readouterr().err


def test_an_address_that_is_taken(live: Live, capsys: pytest.CaptureFixture[str]) -> None:
    port = live.address.rpartition(":")[2]
    assert main(["train", "--live", port]) == MISUSE
    assert f"--live: expected a free address, got 127.0.0.1:{port}" in capsys.readouterr().err


def test_without_the_extra(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    assert main(["train", "--live"]) == MISUSE
    assert "pip install 'fdi_torch[live]'" in capsys.readouterr().err
