"""The monitor on OPC UA: a recording replayed by a real server gives the events of the file."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from live_servers import Proxy, ThreadedServer, free_port
from test_live_mqtt import MESSAGES, told
from test_monitor_follow import config, monitored, texts, written

from fdi_torch.cli import main
from fdi_torch.live.opcua import SILENT
from fdi_torch.live.values import Inbox, Item, Value

asyncua = pytest.importorskip("asyncua")

NAMES = ("Q1", "Q2", "h1", "h2", "h3")
START = datetime(2026, 1, 1, tzinfo=UTC)


class Plc(ThreadedServer):
    """An OPC UA server with a node a channel, in a thread of its own, which starts with its last sample."""

    def __init__(self) -> None:
        self._last = MESSAGES[0]
        super().__init__()

    async def serve(self) -> AsyncIterator[None]:
        server = asyncua.Server()
        await server.init()
        server.set_endpoint(f"opc.tcp://127.0.0.1:{self.port}/rig")
        self.nodes = {}
        for name in NAMES:
            node = await server.nodes.objects.add_variable(f"ns=2;s=Rig.{name}", f"2:{name}", 0.0)
            self.nodes[name] = node
        self._server = server
        await self._write(self._last)
        async with server:
            yield

    def write(self, sample: dict[str, float], bad: tuple[str, ...] = (), only: tuple[str, ...] = NAMES) -> None:
        asyncio.run_coroutine_threadsafe(self._write(sample, bad, only), self.loop).result(10.0)

    async def _write(self, sample: dict[str, float], bad: tuple[str, ...] = (), only: tuple[str, ...] = NAMES) -> None:
        self._last, ua = sample, asyncua.ua
        for name in only:
            status = ua.StatusCode(ua.StatusCodes.BadSensorFailure if name in bad else ua.StatusCodes.Good)
            value = ua.DataValue(
                ua.Variant(float(sample[name]), ua.VariantType.Double),
                status,
                SourceTimestamp=START + timedelta(seconds=sample["t"]),
            )
            await self._server.write_attribute_value(self.nodes[name].nodeid, value)


@pytest.fixture
def plc() -> Iterator[Plc]:
    with closing(Plc()) as running:
        yield running


def source(port: int, **changes: object) -> dict[str, object]:
    tags: dict[str, object] = {name: {"tag": f"ns=2;s=Rig.{name}", "unit": "cm^3/s"} for name in ("Q1", "Q2")}
    tags |= {name: {"tag": f"ns=2;s=Rig.{name}", "unit": "cm"} for name in ("h1", "h2", "h3")}
    return {"url": f"opcua://127.0.0.1:{port}/rig", "tags": tags, "reorder": "0.2 s", **changes}


@pytest.fixture
def once_subscribed(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], None]], threading.Thread]:
    """Run a function in a thread once the monitor has subscribed."""
    from fdi_torch.live.opcua import OpcUaSource

    subscribed, original = threading.Event(), OpcUaSource._subscribe

    async def patched(self: OpcUaSource, client: Any) -> None:
        await original(self, client)
        subscribed.set()

    monkeypatch.setattr(OpcUaSource, "_subscribe", patched)

    def start(then: Callable[[], None]) -> threading.Thread:
        def run() -> None:
            assert subscribed.wait(60.0)
            then()

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    return start


@pytest.mark.parametrize("cut", [False, True])
def test_a_recording_through_a_server_gives_the_events_of_the_file(
    cut: bool,
    tmp_path: Path,
    plc: Plc,
    once_subscribed: Callable[[Callable[[], None]], threading.Thread],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """cut: the network is cut around the onset; the server keeps the samples in the session."""
    expected = monitored(["--config", config(tmp_path, recording={"file": str(written(tmp_path / "all.csv"))})], capsys)
    proxy = Proxy(plc.port)
    plc.write(MESSAGES[0])

    def replay() -> None:
        for k, sample in enumerate(MESSAGES):
            if cut and k == 195:
                proxy.cut()
            plc.write(sample)
            time.sleep(0.005)
            if cut and k == 225:
                time.sleep(0.5)
                proxy.mend()

    thread = once_subscribed(replay)
    path = config(tmp_path, recording=None, source=source(proxy.port))
    events = monitored(["--config", path, "--idle", "4" if cut else "1.5"], capsys)
    thread.join()
    proxy.cut()
    assert told(events) == told(expected)
    assert ("lost" in texts(events), "again after" in texts(events)) == (cut, cut)


@pytest.mark.slow
@pytest.mark.parametrize("restored", [True, False])
def test_a_server_that_is_stopped_and_started_again_loses_no_event(
    restored: bool,
    tmp_path: Path,
    plc: Plc,
    once_subscribed: Callable[[Callable[[], None]], threading.Thread],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A restarted server knows neither session nor subscription. The plant waits until the monitor is back, because
    nothing keeps samples meanwhile. restored: whether the library succeeds in restoring the subscription. The network
    is cut until the server is back, because a server that is being stopped may still take up a session.
    """
    proxy = Proxy(plc.port)
    arrived, connected_again, put = threading.Event(), threading.Event(), Inbox.put
    last = START.timestamp() + MESSAGES[209]["t"]

    def noticing(self: Inbox, items: Iterable[Item]) -> None:
        put(self, kept := list(items))
        if any(isinstance(item, str) and "again after" in item for item in kept):
            connected_again.set()
        if any(isinstance(item, Value) and item.tag.endswith(NAMES[-1]) and item.stamp >= last for item in kept):
            arrived.set()

    async def failing(subscription: asyncua.common.subscription.Subscription) -> None:
        raise TimeoutError

    monkeypatch.setattr(Inbox, "put", noticing)
    if not restored:
        monkeypatch.setattr("fdi_torch.live.opcua.SILENT", 2.0)
        monkeypatch.setattr(asyncua.common.subscription.Subscription, "restore", failing)
    expected = monitored(["--config", config(tmp_path, recording={"file": str(written(tmp_path / "all.csv"))})], capsys)

    def replay() -> None:
        for k, sample in enumerate(MESSAGES):
            if k == 210:
                assert arrived.wait(60.0)
                proxy.cut()
                plc.close()
                plc.start()
                if restored:  # SILENT counts from the end of the loss
                    time.sleep(SILENT + 1.0)
                proxy.mend()
                assert connected_again.wait(60.0)
            plc.write(sample)
            time.sleep(0.005)

    thread = once_subscribed(replay)
    path = config(tmp_path, recording=None, source=source(proxy.port))
    events = monitored(["--config", path, "--idle", "30"], capsys)
    thread.join()
    proxy.cut()
    assert told(events) == told(expected)
    assert texts(events).count("trying again") == texts(events).count("again after") == 1


def test_a_bad_status_is_a_missing_reading(tmp_path: Path, plc: Plc) -> None:
    from fdi_torch.config.live_source import live_rows
    from fdi_torch.config.monitor_file import load_monitor

    run = load_monitor(config(tmp_path, recording=None, source=source(plc.port)))
    assert run.config.source is not None
    plc.write(MESSAGES[0])
    rows = live_rows(run.config.source, run.plant, idle=3.0)
    plc.write(MESSAGES[1], bad=("h2",))
    got = [row for row in rows if not isinstance(row, str)]
    assert [t for t, _, _ in got] == [0.0, 1.0]
    assert rows.origin == START.timestamp()
    _, inputs, levels = got[1]
    assert inputs == pytest.approx([50e-6, 50e-6])
    assert levels[1] != levels[1] and [levels[0], levels[2]] == pytest.approx(
        [0.01 * MESSAGES[1]["h1"], 0.01 * MESSAGES[1]["h3"]]
    )


def test_a_node_or_server_that_is_missing_is_named(
    tmp_path: Path, plc: Plc, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = source(plc.port)
    wrong["tags"]["h1"]["tag"] = "ns=2;s=Rig.none"  # type: ignore[index]
    assert main(["monitor", "--config", config(tmp_path, recording=None, source=wrong), "--quiet"]) == 2
    assert "nodes at 127.0.0.1" in (said := capsys.readouterr().err) and "ns=2;s=Rig.none" in said
    absent = config(tmp_path, recording=None, source=source(free_port()))
    assert main(["monitor", "--config", absent, "--quiet"]) == 2
    assert "expected an OPC UA server" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.mcap*")), "no log of a run that never began"
    clock = config(tmp_path, recording=None, source=source(plc.port, clock={"tag": "t"}))
    assert main(["monitor", "--config", clock, "--quiet"]) == 2
    assert "clock: expected none for OPC UA" in capsys.readouterr().err


def test_ctrl_c_ends_the_command(tmp_path: Path, plc: Plc) -> None:
    file = config(tmp_path, recording=None, source=source(plc.port))
    words = [sys.executable, "-m", "fdi_torch", "monitor", "--config", file]

    def listen() -> None:  # even if the tests run in the background of a shell, which ignores Ctrl-C
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, preexec_fn=listen) as process:
        try:
            assert process.stderr is not None
            waiting = next(line for line in process.stderr if "waiting for samples" in line)
            process.send_signal(signal.SIGINT)
            assert waiting and process.wait(60.0) == 130
        finally:
            process.kill()


def test_a_level_that_has_not_changed_for_hours_does_not_set_time_zero(tmp_path: Path, plc: Plc) -> None:
    """The first value of a node has the time of its last change."""
    from fdi_torch.config.live_source import live_rows
    from fdi_torch.config.monitor_file import load_monitor

    run = load_monitor(config(tmp_path, recording=None, source=source(plc.port)))
    assert run.config.source is not None
    moving = tuple(name for name in NAMES if name != "h1")
    plc.write(MESSAGES[0] | {"t": -10800.0})
    plc.write(MESSAGES[0], only=moving)
    rows = live_rows(run.config.source, run.plant, idle=3.0)
    plc.write(MESSAGES[1], only=moving)
    got = [row for row in rows if not isinstance(row, str)]
    assert [t for t, _, _ in got] == [0.0, 1.0] and rows.origin == START.timestamp()
