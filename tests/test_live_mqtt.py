"""The monitor on MQTT: a recording replayed through a real broker gives the events of the file."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from live_servers import Broker, broker, free_port
from test_monitor_follow import config, growing, logged_events, monitored, readings, texts

from fdi_torch.cli import INTERRUPTED, MISUSE, main
from fdi_torch.live.mqtt import MqttClient
from fdi_torch.live.values import PASSWORD, USER, address_of

paho = pytest.importorskip("paho.mqtt.client")

QUIET = ("notice", "summary")


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Broker]:
    with broker(tmp_path) as found:
        yield found


def source(port: int, **changes: object) -> dict[str, object]:
    """Tags of the three tanks in the fields of one topic."""
    tags: dict[str, object] = {name: {"tag": f":{name}", "unit": "cm^3/s"} for name in ("Q1", "Q2")}
    tags |= {name: {"tag": f":{name}", "unit": "cm"} for name in ("h1", "h2", "h3")}
    clock = {"tag": "t", "unit": "s"}
    return {"url": f"mqtt://127.0.0.1:{port}/rig", "tags": tags, "clock": clock, "reorder": "0.2 s", **changes}


def live_config(folder: Path, port: int, **changes: object) -> str:
    return config(folder, recording=None, source=source(port, **changes))


def message(k: int, levels: list[float]) -> dict[str, float]:
    """A sample with the digits of the CSV file."""
    return {"t": k, "Q1": 50.0, "Q2": 50.0} | {f"h{i}": round(100 * h, 4) for i, h in enumerate(levels, start=1)}


MESSAGES = [message(k, levels) for k, levels in enumerate(readings())]


class Rig:
    """A publisher with a queue of its own, which sends what was not confirmed again after a broken connection."""

    def __init__(self, port: int) -> None:
        self.client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id="rig", clean_session=False)
        self.client.reconnect_delay_set(1, 1)
        self.client.max_queued_messages_set(0)
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()

    def send(self, messages: list[dict[str, Any]], pause: float = 0.003, topic: str = "rig") -> None:
        for sample in messages:
            self.client.publish(topic, json.dumps(sample), qos=1)
            time.sleep(pause)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


@pytest.fixture
def when_subscribed(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, Callable[[Rig], None]], threading.Thread]:
    """Run a function of a rig in a thread once the monitor has subscribed."""
    connected, original = threading.Event(), MqttClient._connected

    def patched(self: MqttClient, *arguments: Any) -> None:
        original(self, *arguments)
        connected.set()

    monkeypatch.setattr(MqttClient, "_connected", patched)

    def start(port: int, then: Callable[[Rig], None]) -> threading.Thread:
        def run() -> None:
            assert connected.wait(60.0)
            time.sleep(0.2)  # for the broker to see the subscription
            rig = Rig(port)
            then(rig)
            rig.close()

        return growing(run)

    return start


WhenSubscribed = Callable[[int, Callable[[Rig], None]], threading.Thread]


def told(events: list[dict[str, object]]) -> list[tuple[object, ...]]:
    """What a person is told: all events but notices about the connection."""
    return [(e["time"], e["kind"], e["faults"], e["sizes"], e["text"]) for e in events if e["kind"] not in QUIET]


@pytest.fixture
def expected(watched: tuple[Path, list[dict[str, Any]]]) -> list[tuple[object, ...]]:
    """The events of the file."""
    assert [kind for _, kind, *_ in told(watched[1])][:3] == ["watching", "alarm", "isolated"]
    return told(watched[1])


def test_a_recording_through_a_broker_gives_the_events_of_the_file(
    tmp_path: Path,
    running: Broker,
    expected: list[tuple[object, ...]],
    when_subscribed: WhenSubscribed,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With neighbours exchanged, samples sent twice, and a message that is none."""
    messages = list(MESSAGES)
    messages[60], messages[61] = messages[61], messages[60]
    messages.insert(100, messages[98])

    def send(rig: Rig) -> None:
        rig.client.publish("rig", "no sample", qos=1)
        rig.send(messages)

    thread = when_subscribed(running.port, send)
    events = monitored(["--config", live_config(tmp_path, running.port), "--idle", "2"], capsys)
    thread.join()
    assert told(events) == expected
    assert "rig: expected JSON or a number, got 'no sample'" in texts(events)


def test_a_broker_that_is_stopped_and_started_again_loses_no_event(
    tmp_path: Path,
    running: Broker,
    expected: list[tuple[object, ...]],
    when_subscribed: WhenSubscribed,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def send(rig: Rig) -> None:
        rig.send(MESSAGES[:210])
        running.stop()
        rig.send(MESSAGES[210:230])
        running.start()
        rig.send(MESSAGES[230:])
        time.sleep(2.0)  # for the reconnection of the rig

    thread = when_subscribed(running.port, send)
    path = live_config(tmp_path, running.port, session="watch", reorder="1 s")
    events = monitored(["--config", path, "--idle", "4"], capsys)
    thread.join()
    assert told(events) == expected
    assert "lost" in texts(events) and "again after" in texts(events)


def test_a_killed_run_of_a_source_with_dates_is_resumed_with_its_time_origin(
    tmp_path: Path,
    running: Broker,
    expected: list[tuple[object, ...]],
    when_subscribed: WhenSubscribed,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The broker keeps what comes between the two runs."""
    dated = [{**m, "t": f"2026-01-01T00:{int(m['t']) // 60:02}:{int(m['t']) % 60:02}Z"} for m in MESSAGES]
    path = live_config(tmp_path, running.port, session="watch", clock={"tag": "t"})
    words = ["--config", path, "--idle", "1.5"]
    thread = when_subscribed(running.port, lambda rig: rig.send(dated[:225]))
    with monkeypatch.context() as patch:

        def killed(self: object) -> None:
            raise KeyboardInterrupt

        patch.setattr("fdi_torch.jobs.logged_monitor.LoggedMonitor.close", killed)
        assert main(["monitor", *words, "--json", "--quiet"]) == INTERRUPTED
    thread.join()
    early = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    running.stop()  # a resumed run that cannot reach the broker leaves the samples to the next
    assert main(["monitor", *words, "--resume", "--quiet"]) == MISUSE
    running.start()
    capsys.readouterr()
    rig = Rig(running.port)
    rig.send(dated[225:])
    late = monitored([*words, "--resume"], capsys)
    rig.close()
    assert told(early) + told(late) == expected
    [log] = (tmp_path / "logs").glob("watch.mcap")
    assert [time for time, *_ in told(logged_events_as_told(log))] == [time for time, *_ in expected]


def test_samples_of_a_run_that_is_killed_while_it_learns_are_kept(
    tmp_path: Path,
    running: Broker,
    expected: list[tuple[object, ...]],
    when_subscribed: WhenSubscribed,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = live_config(tmp_path, running.port, session="watch")
    words = ["--config", path, "--idle", "1.5"]
    thread = when_subscribed(running.port, lambda rig: rig.send(MESSAGES[:100]))
    with monkeypatch.context() as patch:

        def killed(self: object, whole: object) -> None:
            raise KeyboardInterrupt

        patch.setattr("fdi_torch.jobs.logged_monitor.LoggedMonitor.learn", killed)
        assert main(["monitor", *words, "--json", "--quiet"]) == INTERRUPTED
    thread.join()
    [kept] = (tmp_path / "logs").glob("*.learning")
    kept.write_bytes(kept.read_bytes() + b"[null,[[1.0,")  # the kill may come while a line is written
    rig = Rig(running.port)
    rig.send(MESSAGES[100:])
    resumed = monitored([*words, "--resume"], capsys)
    rig.close()
    assert told(resumed) == expected
    assert not kept.exists()


def logged_events_as_told(log: Path) -> list[dict[str, object]]:
    return [json.loads(str(event["details"])) for event in logged_events(log)]


def test_one_topic_per_value_without_a_clock_gives_a_row_per_period(tmp_path: Path, running: Broker) -> None:
    from fdi_torch.config.live_source import live_rows
    from fdi_torch.config.monitor_file import load_monitor

    tags = {name: {"tag": name, "unit": "cm^3/s", "factor": 2.0, "offset": 1.0} for name in ("Q1", "Q2")}
    tags |= {name: {"tag": f"{name}/level", "unit": "cm"} for name in ("h1", "h2", "h3")}
    path = live_config(tmp_path, running.port, tags=tags, clock=None, period="0.1 s", reorder="0.3 s")
    run = load_monitor(path)
    assert run.config.source is not None
    rows = live_rows(run.config.source, run.plant, idle=1.0)
    rig = Rig(running.port)
    for topic, payload in {"Q1": 10, "Q2": 20, "h1/level": 30, "h2/level": 31.5, "h3/level": None}.items():
        rig.client.publish(f"rig/{topic}", json.dumps(payload), qos=1)
    got = [row for row in rows if not isinstance(row, str)]
    rig.close()
    assert rows.origin == pytest.approx(time.time(), abs=10.0)
    _, inputs, _ = got[-1]
    assert inputs == pytest.approx([21e-6, 41e-6]) and len(got) <= 2
    levels = [max((row[2][k] for row in got if row[2][k] == row[2][k]), default=None) for k in range(3)]
    assert levels == [pytest.approx(0.3), pytest.approx(0.315), None]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"url": "mqtt://127.0.0.1:PORT/rig"}, "expected an MQTT broker at 127.0.0.1:PORT, got none"),
        ({"url": "http://127.0.0.1/rig"}, "source.url: expected a URL of the kind mqtt://HOST"),
        ({"url": "mqtt://me:secret@127.0.0.1/rig"}, "expected a URL without user and password"),
        (
            {"clock": {"tag": "all:t", "unit": "s"}},
            "clock.tag: expected a field of the same JSON object, got 'all:t'; write 't'",
        ),
        ({"url": "mqtt://127.0.0.1:PORT/rig/#"}, "expected a topic without the wildcards # and +"),
        ({"tags": {"h9": {"tag": "h9", "unit": "cm"}}}, "source: tags.h9: expected a channel of the plant"),
        ({"tags": {"Q1": {"tag": "q", "unit": "cm"}}}, "Q1: expected a unit of flow such as l/min"),
        ({"tags": {"Q1": {"tag": "q"}}}, "tags.Q1: expected a unit, got none"),
        ({"tags": {"Q1": {"unit": "cm"}}}, "tags: expected either tag or constant of each channel, got none of Q1"),
        ({"tags": {"h1": {"constant": "1 cm"}}}, "expected a tag for each channel, got none for Q1"),
        ({"period": "0 s"}, "source.period"),
    ],
)
def test_a_source_that_cannot_be_used_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, object], sentence: str
) -> None:
    port = free_port()
    changes = {key: v.replace("PORT", str(port)) if isinstance(v, str) else v for key, v in changes.items()}
    assert main(["monitor", "--config", live_config(tmp_path, port, **changes), "--quiet"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert sentence.replace("PORT", str(port)) in said
    assert not list(tmp_path.rglob("*.mcap*")), "no log of a run that never began"
    both = config(tmp_path, source=source(port))
    assert main(["monitor", "--config", both, "--quiet"]) == 2
    assert "expected either recording or source, got both" in capsys.readouterr().err


def test_credentials_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    from fdi_torch.live.values import credentials

    assert credentials() is None
    monkeypatch.setenv(USER, "rig")
    monkeypatch.setenv(PASSWORD, "secret")
    assert credentials() == ("rig", "secret")
    assert address_of("mqtt://broker/a/b").port == 1883 and address_of("mqtt://broker/a/b").path == "a/b"
