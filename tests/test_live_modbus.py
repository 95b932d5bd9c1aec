"""The monitor on Modbus: a recording replayed by a real server gives the events of the file."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from live_servers import Proxy, ThreadedServer
from test_live_mqtt import MESSAGES, told
from test_monitor_follow import config, monitored, texts

from fdi_torch.cli import main
from fdi_torch.live.modbus import Register, blocks, register_of

simulator = pytest.importorskip("pymodbus.simulator")

FIELDS = ("t", "Q1", "Q2", "h1", "h2", "h3")
FIRST = 100


def registers(sample: dict[str, float]) -> list[int]:
    """The fields as float64, most significant register first."""
    return list(struct.unpack(">24H", struct.pack(">6d", *(sample[name] for name in FIELDS))))


class Plc(ThreadedServer):
    """A Modbus server whose registers go on to the next sample with each second reading. `sent`: their number."""

    def __init__(self) -> None:
        self.reads = 0
        super().__init__()

    @property
    def sent(self) -> int:
        return min(self.reads // 2, len(MESSAGES) - 1)

    async def serve(self) -> AsyncIterator[None]:
        from pymodbus.server import ModbusTcpServer

        async def next_sample(
            _code: int, start: int, _address: int, _count: int, content: list[int], _set: Any
        ) -> None:
            content[:24] = registers(MESSAGES[self.sent])
            self.reads += 1

        data = simulator.SimData(FIRST, values=registers(MESSAGES[0]), datatype=simulator.DataType.REGISTERS)
        device = simulator.SimDevice(1, [data], action=next_sample)
        server = ModbusTcpServer(device, address=("127.0.0.1", self.port))
        await server.serve_forever(background=True)
        yield
        await server.shutdown()


@pytest.fixture
def plc() -> Iterator[Plc]:
    with closing(Plc()) as running:
        yield running


def source(port: int, **changes: object) -> dict[str, object]:
    places = {name: f"holding:{FIRST + 4 * k}:float64" for k, name in enumerate(FIELDS)}
    tags = {name: {"tag": places[name], "unit": "cm^3/s" if name[0] == "Q" else "cm"} for name in FIELDS[1:]}
    clock = {"tag": places["t"], "unit": "s"}
    settings = {"period": "0.003 s", "reorder": "0.1 s"}
    return {"url": f"modbus://127.0.0.1:{port}", "tags": tags, "clock": clock, **settings, **changes}


@pytest.mark.parametrize("disturbance", ["cut", "restart"])
def test_a_recording_through_a_server_gives_the_events_of_the_file(
    disturbance: str,
    tmp_path: Path,
    plc: Plc,
    capsys: pytest.CaptureFixture[str],
    watched: tuple[Path, list[dict[str, Any]]],
) -> None:
    """Each sample is read at least twice. cut: the network is cut for a while; restart: the server is stopped and
    started again. The plant waits meanwhile.
    """
    proxy = Proxy(plc.port)

    def disturb() -> None:
        while plc.sent < 210:
            time.sleep(0.01)
        (proxy.cut if disturbance == "cut" else plc.close)()
        time.sleep(0.7)
        (proxy.mend if disturbance == "cut" else plc.start)()

    thread = threading.Thread(target=disturb)
    thread.start()
    path = config(tmp_path, recording=None, source=source(plc.port if disturbance == "restart" else proxy.port))
    events = monitored(["--config", path, "--idle", "3"], capsys)
    thread.join()
    proxy.cut()
    assert told(events) == told(watched[1])
    assert (texts(events).count("lost"), texts(events).count("again after")) == (1, 1)


def test_without_a_clock_the_time_of_polling_counts(tmp_path: Path, plc: Plc) -> None:
    from fdi_torch.config.live_source import live_rows
    from fdi_torch.config.monitor_file import load_monitor

    run = load_monitor(config(tmp_path, recording=None, source=source(plc.port, clock=None, period="0.1 s")))
    assert run.config.source is not None
    rows = live_rows(run.config.source, run.plant)
    first = [row for row in (next(rows) for _ in range(4)) if not isinstance(row, str)]
    assert [t for t, _, _ in first] == pytest.approx([0.0, 0.1, 0.2, 0.3], abs=1e-5)
    assert rows.origin == pytest.approx(time.time(), abs=10.0)
    assert first[0][2] == pytest.approx([0.01 * MESSAGES[0][name] for name in ("h1", "h2", "h3")])
    rows._rows.close()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"device": 7}, "expected a Modbus device with these registers at 127.0.0.1"),
        ({"clock": {"tag": "holding:9000", "unit": "s"}}, "holding:9000 to 9000"),
        ({"clock": {"tag": "holding:100"}}, "expected a unit of the register's number"),
        ({"clock": {"tag": "holding:none", "unit": "s"}}, "expected an address from 0 to 65535"),
        ({"clock": {"tag": "register:1", "unit": "s"}}, "expected a table of the device"),
        ({"clock": {"tag": "holding:1:flaot32", "unit": "s"}}, "expected a type"),
        ({"clock": {"tag": "coil:1:int16", "unit": "s"}}, "expected no type for a single bit"),
        ({"session": "watch"}, "session: expected this key of an MQTT source only"),
    ],
)
def test_a_device_that_cannot_be_used_is_refused_in_a_sentence(
    tmp_path: Path, plc: Plc, capsys: pytest.CaptureFixture[str], changes: dict[str, object], sentence: str
) -> None:
    path = config(tmp_path, recording=None, source=source(plc.port, **changes))
    assert main(["monitor", "--config", path, "--quiet"]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.mcap*")), "no log of a run that never began"


def test_neighbouring_registers_are_read_by_one_request() -> None:
    tags = ["holding:4:float32", "holding:0:int64", "holding:7", "input:8", "holding:6", "coil:3"]
    expected = [[("coil", 3)], [("holding", 0), ("holding", 4), ("holding", 6), ("holding", 7)], [("input", 8)]]
    got = list(blocks([register_of(tag) for tag in tags]))
    assert [[(r.table, r.address) for r in block] for block in got] == expected
    long = [Register("holding", k, "uint16") for k in range(130)]
    assert [len(block) for block in blocks(long)] == [125, 5]
