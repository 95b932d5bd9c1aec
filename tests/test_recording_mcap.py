"""Recordings from MCAP: logs of this program are read back exactly, others by topic and field."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from mcap.writer import Writer

from fdi_torch.config.growing_recordings import growing_rows
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.logbook import RunLog
from fdi_torch.recording import Recording
from fdi_torch.recordings.mcap_files import read_mcap
from fdi_torch.recordings.source import ChannelSource


def written(path: Path) -> Recording:
    """A log of ours with a masked reading and an unknown command, and the recording that it holds."""
    numbers = torch.arange(12, dtype=torch.float64).reshape(4, 3) / 7
    inputs = torch.tensor([[50e-6, 1e-5], [50e-6, float("nan")], [60e-6, 1e-5], [60e-6, 2e-5]], dtype=torch.float64)
    mask = torch.ones(4, 3, dtype=torch.bool)
    mask[2, 1] = False
    with RunLog(path, "simulate") as log:
        log.recording(
            torch.arange(4) * 0.5,
            inputs,
            numbers,
            ("Q1", "Q2"),
            ("h1", "h2", "h3"),
            ("m^3/s", "m^3/s"),
            ("m", "m", "m"),
            mask=mask,
            hold="linear",
        )
    return Recording(
        time=torch.arange(4, dtype=torch.float64) * 0.5,
        inputs=inputs,
        outputs=numbers,
        mask=mask,
        input_names=("Q1", "Q2"),
        output_names=("h1", "h2", "h3"),
        input_units=("m^3/s", "m^3/s"),
        output_units=("m", "m", "m"),
        hold="linear",
    )


def test_our_own_log_needs_no_mapping(tmp_path: Path) -> None:
    truth = written(tmp_path / "run.mcap")
    config = RecordingConfig(file="run.mcap")
    found = read_recording(config, load_plant("three_tank"), tmp_path)
    for name in ("time", "outputs", "mask"):
        assert torch.equal(getattr(found, name), getattr(truth, name))
    torch.testing.assert_close(found.inputs, truth.inputs, rtol=0, atol=0, equal_nan=True)
    assert (found.hold, found.input_names, found.output_units) == ("linear", ("Q1", "Q2"), ("m", "m", "m"))
    assert len(found.sha256) == 64


def test_channels_of_our_own_log_by_other_names_and_constants(tmp_path: Path) -> None:
    truth = written(tmp_path / "run.mcap")
    mapping = {"left": ChannelSource("h2"), "feed": ChannelSource(constant=3e-5, unit="m^3/s")}
    found = read_mcap(tmp_path / "run.mcap", ["feed"], ["left"], mapping)
    assert torch.equal(found.outputs[:, 0], truth.outputs[:, 1])
    assert found.mask[:, 0].tolist() == [True, True, False, True]
    assert found.inputs[:, 0].tolist() == [3e-5] * 4


def test_a_channel_that_is_not_logged(tmp_path: Path) -> None:
    written(tmp_path / "run.mcap")
    with pytest.raises(ValueError, match=r"run.mcap: h4: expected a channel of the log \(Q1.* h3\), got 'h4'"):
        read_mcap(tmp_path / "run.mcap", ["Q1"], ["h4"])


def foreign(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        levels, pump = (writer.register_channel(topic, "json", 0) for topic in ("/rig/levels", "/rig/pump"))
        for i in range(4):
            now = 1_790_000_000 * 10**9 + i * 500_000_000
            writer.add_message(pump, now - 1, b'{"flow": %d}' % (10 * i), now)
            writer.add_message(levels, now, b'{"data": [%d, 5], "minutes": %d}' % (i, i), now)
        writer.finish()


LEVEL, FLOW = ChannelSource("/rig/levels:data[0]", "cm"), ChannelSource("/rig/pump:flow", "cm^3/s")


def test_a_foreign_log_by_topic_and_field(tmp_path: Path) -> None:
    foreign(tmp_path / "rig.mcap")
    found = read_mcap(tmp_path / "rig.mcap", ["Q1"], ["h1"], {"h1": LEVEL, "Q1": FLOW})
    assert found.time.tolist() == [0.0, 0.5, 1.0, 1.5]
    assert found.outputs[:, 0].tolist() == pytest.approx([0.0, 0.01, 0.02, 0.03])
    assert found.inputs[:, 0].tolist() == pytest.approx([0.0, 1e-5, 2e-5, 3e-5])


def test_a_foreign_log_with_its_own_clock(tmp_path: Path) -> None:
    foreign(tmp_path / "rig.mcap")
    timed = {"h1": LEVEL, "t": ChannelSource("minutes", "minute")}
    assert read_mcap(tmp_path / "rig.mcap", [], ["h1"], timed).time.tolist() == [0.0, 60.0, 120.0, 180.0]
    with pytest.raises(ValueError, match=r"rig.mcap: t: expected a unit that converts to s, got 'cm'"):
        read_mcap(tmp_path / "rig.mcap", [], ["h1"], timed | {"t": ChannelSource("minutes", "cm")})


@pytest.mark.parametrize(
    ("mapping", "sentence"),
    [
        ({"h1": LEVEL}, r"rig.mcap: Q1: expected a column TOPIC:FIELD as in /rig/levels:left, got 'None'"),
        ({"h1": LEVEL, "Q1": ChannelSource("/rig/pump:flow")}, r"rig.mcap: Q1: expected a unit, got none; give it"),
    ],
)
def test_what_a_foreign_log_needs_is_said(tmp_path: Path, mapping: dict[str, ChannelSource], sentence: str) -> None:
    foreign(tmp_path / "rig.mcap")
    with pytest.raises(ValueError, match=sentence):
        read_mcap(tmp_path / "rig.mcap", ["Q1"], ["h1"], mapping)


def test_something_else_than_a_log_is_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("t_s,h1_cm")
    with pytest.raises(ConfigError, match=r"run.mcap"):
        read_recording(RecordingConfig(file="run.mcap"), load_plant("three_tank"), tmp_path)


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("h1", "plus", ["h2"]),
        ("h1", "quality", "state"),
        ("h1", "words", {"FAIL": None}),
        ("Q1", "held", "10 s"),
        ("t", "shift", "5 s"),
        ("t", "zone", "Europe/Berlin"),
    ],
)
@pytest.mark.parametrize("followed", [False, True])
def test_keys_that_a_log_cannot_have_are_refused(
    tmp_path: Path, name: str, key: str, value: object, followed: bool
) -> None:
    """They were ignored: a sum of two pumps lost one of them without a word."""
    written(tmp_path / "own.mcap")
    entry = {"file": "own.mcap", "columns": {name: {key: value}}}
    config = RecordingConfig.model_validate(entry)
    plant = load_plant("three_tank")
    with pytest.raises(ConfigError, match=rf"{name}\.{key}: expected no such key|expected neither zone, sort"):
        if followed:
            list(growing_rows(config, plant, tmp_path, idle=0.1))
        else:
            read_recording(config, plant, tmp_path)


def test_a_reading_on_another_topic_counts_once(tmp_path: Path) -> None:
    """A slow sensor has no more readings than messages; they were repeated at every message of the fast one."""
    with (tmp_path / "rig.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        fast, slow, pump = (writer.register_channel(topic, "json", 0) for topic in ("/fast", "/slow", "/pump"))
        for i in range(6):
            now = 1_790_000_000 * 10**9 + i * 500_000_000
            if i in (1, 4):
                writer.add_message(slow, now - 1000, b'{"level": %d}' % i, now)
                writer.add_message(pump, now - 1000, b'{"flow": %d}' % i, now)
            writer.add_message(fast, now, b'{"level": %d}' % i, now)
        writer.finish()
    mapping = {"h1": ChannelSource("/fast:level", "cm"), "h2": ChannelSource("/slow:level", "cm")}
    found = read_mcap(
        tmp_path / "rig.mcap", ["Q1"], ["h1", "h2"], mapping | {"Q1": ChannelSource("/pump:flow", "cm^3/s")}
    )
    assert found.mask.T.tolist() == [[True] * 6, [False, True, False, False, True, False]]
    assert found.valid_readings("h2").tolist() == [0.01, 0.04]
    assert (1e6 * found.inputs[1:, 0]).tolist() == pytest.approx([1.0, 1.0, 1.0, 4.0, 4.0])
