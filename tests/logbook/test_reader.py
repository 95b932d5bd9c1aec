"""Reading of logs: arrays from messages, logs of other programs, growing files and inconsistent files."""

from __future__ import annotations

import io
import json
import threading
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from example_logs import FIXED, TRIAL, write_chunks
from mcap.writer import CompressionType, Writer

from fdi_torch.logbook import (
    LogError,
    RunLog,
    arrays,
    content_hash,
    follow,
    mapped_signals,
    own_signals,
    read_run,
    recover,
    series,
)
from fdi_torch.logbook.payload import unpack
from fdi_torch.logbook.schemas import json_schema
from fdi_torch.logbook.sink import EPOCH_NS, Sink
from fdi_torch.logbook.topic_definitions import Channel, topic_definition


def test_a_recording_comes_back_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    t, u, y = np.cumsum(rng.random(9000)), rng.random((9000, 2)), rng.standard_normal((9000, 3))
    y[17, 1], u[20, 0] = np.nan, np.nan
    mask = np.isfinite(y)
    mask[5000, 2] = False
    with RunLog(tmp_path / "a.mcap", "simulate", **FIXED) as log:
        log.recording(t, u, y, ["Q2", "Q1"], ["h3", "h1", "h2"], ["m^3/s"] * 2, ["m"] * 3, mask=mask, hold="linear")
    back = own_signals(read_run(tmp_path / "a.mcap"))
    for found, truth in ((back.time, t), (back.inputs, u), (back.outputs, y), (back.mask, mask)):
        np.testing.assert_array_equal(found, truth)
    assert back.input_names == ("Q2", "Q1") and back.output_names == ("h3", "h1", "h2")
    assert back.input_units == ("m^3/s",) * 2 and back.output_units == ("m",) * 3 and back.hold == "linear"


def test_a_recording_that_starts_with_a_hole_keeps_its_names_in_order(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "simulate", **FIXED) as log:
        log.recording([0.0], np.zeros((1, 0)), [[np.nan, 1.0]], [], ["h1", "h2"], [], ["m", "m"])
    back = own_signals(read_run(tmp_path / "a.mcap"))
    assert back.output_names == ("h1", "h2") and back.inputs.shape == (1, 0)
    np.testing.assert_array_equal(back.outputs, [[np.nan, 1.0]])


@pytest.mark.parametrize("masked", [0.0, True, [1], ["Q1"], {"Q1": 1}])
def test_a_field_of_another_topic_in_a_strangers_log_is_a_signal_at_most(masked: object, tmp_path: Path) -> None:
    sink = Sink(tmp_path / "a.mcap", "stranger")
    for topic, name in (("/plant/input", "Q1"), ("/plant/output", "h1")):
        definition = topic_definition(topic)
        schema = json_schema(definition, {name: "number"})
        channel = Channel(topic, "json", definition.schema, "jsonschema", schema, ((f"unit.{name}", "m"),))
        data = json.dumps({"t": 0.0, name: 1.0} | ({"masked": masked} if name == "Q1" else {})).encode()
        sink.message(channel, EPOCH_NS, EPOCH_NS, 0, data)
    sink.finish()
    back = own_signals(read_run(tmp_path / "a.mcap"))
    assert back.inputs.tolist() == [[1.0]] and back.mask.tolist() == [[True]]


def test_several_recordings_in_one_log(tmp_path: Path) -> None:
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        for group, level in (("first", 1.0), ("second", 2.0)):
            log.recording([0.0, 1.0], [[0.0]] * 2, [[level]] * 2, ["Q1"], ["h1"], ["m^3/s"], ["m"], group=group)
    run = read_run(tmp_path / "a.mcap")
    assert own_signals(run, "second").outputs.tolist() == [[2.0], [2.0]]
    with pytest.raises(LogError, match="expected messages on /plant/output, got none; map topics"):
        own_signals(run)


def test_series_of_a_topic(finished: Path) -> None:
    table = series(read_run(finished), "/estimator/de/generation")
    np.testing.assert_array_equal(table["best_cost"], [1.0, 1 / 2, 1 / 3])
    np.testing.assert_array_equal(table["t"], [0.0, 1.0, 2.0])
    assert np.isinf(table["mean_cost"]).all() and table["T1.leak.size"][0] == 0.1
    levels = series(read_run(finished), "/plant/output", ["h2"])["h2"]
    assert np.isnan(levels[3]) and np.isfinite(np.delete(levels, 3)).all()


def test_the_state_of_the_search_comes_back(finished: Path) -> None:
    (message,) = read_run(finished).messages(["/estimator/de/population"])
    state = unpack(message.payload)
    assert state["population"].shape == (4, 2)
    np.testing.assert_array_equal(state["cost"], [1.0, np.nan, 2.0, np.inf])


def test_arrays_of_the_result(finished: Path) -> None:
    np.testing.assert_array_equal(arrays(read_run(finished))["covariance"], np.eye(2))
    with pytest.raises(LogError, match="expected one of the attachments"):
        arrays(read_run(finished), "other.npz")


def test_pickled_arrays_are_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, evil=np.array([{"a": 1}], dtype=object))
    sink = Sink(tmp_path / "a.mcap", "x")
    sink.attachment("results.npz", "", buffer.getvalue())
    sink.attachment("torn.npz", "", buffer.getvalue()[:50])
    sink.finish()
    for name in ("results.npz", "torn.npz"):
        with pytest.raises(LogError, match=r"is not an \.npz file of plain arrays"):
            arrays(read_run(tmp_path / "a.mcap"), name)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("chunked", [True, False])
def test_foreign_logs_map_topics_and_fields(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    path, wall = tmp_path / "foreign.mcap", 1_790_000_000 * 10**9
    with open(path, "wb") as file:
        writer = Writer(file, compression=compression, use_chunking=chunked)
        writer.start()
        levels, pump = (
            writer.register_channel("/rig/levels", "json", 0),
            writer.register_channel("/rig/pump", "json", 0),
        )
        for i in range(5):
            now = wall + i * 500_000_000
            if i in (1, 3):
                writer.add_message(pump, now - 1, b'{"cmd":{"flow":%d}}' % i, now)
            writer.add_message(levels, now, b'{"data":[0,%d.5],"bad":"x"}' % i, now)
        writer.finish()
    run = read_run(path)
    found = mapped_signals(run, {"Q1": ("/rig/pump", "cmd.flow")}, {"h1": ("/rig/levels", "data[1]")})
    np.testing.assert_array_equal(found.time, [0.0, 0.5, 1.0, 1.5, 2.0])
    np.testing.assert_array_equal(found.outputs[:, 0], [0.5, 1.5, 2.5, 3.5, 4.5])
    np.testing.assert_array_equal(found.inputs[:, 0], [np.nan, 1, 1, 3, 3])
    assert not run.ours and found.output_names == ("h1",)
    timed = mapped_signals(run, {}, {"h1": ("/rig/levels", "bad")}, time_field="data[1]")
    np.testing.assert_array_equal(timed.time, [0.5, 1.5, 2.5, 3.5, 4.5])
    assert np.isnan(timed.outputs).all() and not timed.mask.any()
    with pytest.raises(LogError, match="expected messages on /no, got none"):
        mapped_signals(run, {}, {"h1": ("/no", "x")})
    with pytest.raises(ValueError, match="expected at least one output"):
        mapped_signals(run, {}, {})


def test_messages_that_are_not_json(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/a", "cdr", 0), 1, b"\x00\x01", 1)
        writer.add_message(writer.register_channel("/b", "json", 0), 1, b"[1]", 1)
        writer.finish()
    binary, text = read_run(path).messages()
    with pytest.raises(LogError, match="/a: messages in cdr, only json can be read"):
        _ = binary.payload
    with pytest.raises(LogError, match="/b: a message is not a JSON object"):
        _ = text.payload
    assert len(content_hash([binary, text])) == 64


def test_files_that_are_no_logs(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="there is no such file"):
        read_run(tmp_path / "none.mcap")
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(LogError, match="the file is empty; the run was killed"):
        read_run(tmp_path / "empty.mcap")
    (tmp_path / "text.mcap").write_text("t_s,h1_cm\n1,2\n" * 100)
    with pytest.raises(LogError, match="expected an MCAP file, got something else"):
        read_run(tmp_path / "text.mcap")
    with pytest.raises(LogError, match="it is a folder"):
        read_run(tmp_path)


def test_a_torn_file_opens_and_says_so(tmp_path: Path) -> None:
    whole = write_chunks(tmp_path / "a.mcap")
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    run = read_run(torn)
    assert not run.complete and f"`fdi recover {torn}`" in run.advice
    assert run.config_text == "a: 1\n"
    found = [message.payload["trial"] for message in run.messages()]
    assert found == list(range(len(found))) and len(found) % 20 == 0 and found


def test_a_damaged_chunk_stops_the_reading_unless_salvage_is_asked_for(tmp_path: Path) -> None:
    data = bytearray(write_chunks(tmp_path / "a.mcap").read_bytes())
    run = read_run(tmp_path / "a.mcap")
    second = [part for part in run.parts if getattr(part, "opcode", 0) == 6][1]
    data[second.end - 5] ^= 0xFF
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data)
    with pytest.raises(LogError, match=rf"bytes {second.start} to {second.end} are damaged .*fdi recover"):
        list(read_run(bad).messages())
    salvaged = read_run(bad, salvage=True)
    assert [m.payload["trial"] for m in salvaged.messages()] == [*range(20), *range(40, 80)]
    assert len(salvaged.damages) == 1


def test_a_chunk_of_ours_without_a_checksum_is_damaged(tmp_path: Path) -> None:
    """0 says that there is none, which MCAP allows; this program writes one into every chunk."""
    data = bytearray(write_chunks(tmp_path / "a.mcap").read_bytes())
    second = [part for part in read_run(tmp_path / "a.mcap").parts if getattr(part, "opcode", 0) == 6][1]
    data[second.start + 33 : second.start + 37] = bytes(4)
    (tmp_path / "bare.mcap").write_bytes(data)
    with pytest.raises(LogError, match="CRC differs"):
        list(read_run(tmp_path / "bare.mcap").messages())


def test_a_file_with_a_hole_ends_and_is_not_complete(tmp_path: Path) -> None:
    data = bytearray(write_chunks(tmp_path / "a.mcap").read_bytes())
    second = [part for part in read_run(tmp_path / "a.mcap").parts if getattr(part, "opcode", 0) == 6][1]
    data[second.start : second.end] = bytes(second.end - second.start)
    (tmp_path / "hole.mcap").write_bytes(data)
    run = read_run(tmp_path / "hole.mcap")
    assert run.ended and not run.complete and "fdi recover" in run.advice


def bomb(path: Path, size: int, claimed: int) -> Path:
    """A log whose only chunk unpacks to `size` zero bytes while it claims `claimed`."""
    import struct

    compressor = zstandard.ZstdCompressor(level=19).compressobj()
    block = bytes(2**20)
    content = b"".join(compressor.compress(block) for _ in range(size // 2**20)) + compressor.flush()
    body = struct.pack("<QQQI", 0, 0, claimed, zlib.crc32(b"")) + struct.pack("<I", 4) + b"zstd"
    body += struct.pack("<Q", len(content)) + content
    sink = Sink(path, "x")
    sink._file.write(struct.pack("<BQ", 6, len(body)) + body)
    sink.finish()
    return path


@pytest.mark.parametrize("claimed", [600 * 2**20, 1000])
def test_a_bomb_is_not_unpacked(tmp_path: Path, claimed: int) -> None:
    import tracemalloc

    path = bomb(tmp_path / "a.mcap", 600 * 2**20, claimed)
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    with pytest.raises(LogError, match=r"chunk of 629145600 bytes, more than|chunk of another size"):
        list(read_run(path).messages())
    assert list(read_run(path, salvage=True).messages()) == []
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


def test_a_message_on_a_channel_that_nothing_describes(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_message(7, 0, b"{}", 0)
        writer.finish()
    with pytest.raises(LogError, match="message on channel 7, which nothing describes"):
        list(read_run(path).messages())


def test_the_content_hash_does_not_see_chunks(tmp_path: Path) -> None:
    hashes = {content_hash(read_run(write_chunks(tmp_path / f"{n}.mcap", n, 120 // n)).messages()) for n in (1, 3, 40)}
    assert len(hashes) == 1
    other = write_chunks(tmp_path / "other.mcap", 1, 119)
    assert content_hash(read_run(other).messages()) not in hashes


def test_the_content_hash_sees_topic_time_and_payload(tmp_path: Path) -> None:
    def hash_of(time_ns: int, data: bytes) -> str:
        path = tmp_path / "a.mcap"
        path.unlink(missing_ok=True)
        sink = Sink(path, "x")
        sink.message(TRIAL, time_ns, time_ns, 0, data)
        sink.finish()
        return content_hash(read_run(path).messages())

    same = hash_of(1, b'{"a":1,"b":2}')
    assert hash_of(1, b'{"b":2,"a":1,"wall":{"sec":1,"nsec":2}}') == same
    assert len({same, hash_of(2, b'{"a":1,"b":2}'), hash_of(1, b'{"a":1,"b":3}')}) == 3


def test_a_copy_has_all_contents(finished: Path, tmp_path: Path) -> None:
    recover(finished, tmp_path / "copy.mcap")
    copy, original = read_run(tmp_path / "copy.mcap"), read_run(finished)
    assert list(copy.messages()) == list(original.messages())
    assert original.metadata.items() < copy.metadata.items()
    assert all(copy.attachment(name) == original.attachment(name) for name in original.attachments)


def test_following_a_run_yields_every_message_once(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"

    def write() -> None:
        time.sleep(0.1)
        with RunLog(path, "train", **FIXED, flush_seconds=0.04) as log:
            for number in range(40):
                log.trial(number, {"x": 1.0})
                time.sleep(0.01)

    writer = threading.Thread(target=write)
    writer.start()
    arrived = []
    for message in follow(path, idle_seconds=5, poll_seconds=0.01):
        arrived.append((message.payload["trial"], path.exists()))
    writer.join()
    assert [number for number, _ in arrived] == list(range(40))
    assert sum(not finished for _, finished in arrived) > 10, "messages came while the run went on"


def test_following_a_finished_file(finished: Path) -> None:
    assert content_hash(follow(finished)) == content_hash(read_run(finished).messages())
    assert {message.topic for message in follow(finished, topics=["/log"])} == {"/log"}


def test_following_a_dead_run_ends(tmp_path: Path) -> None:
    whole = write_chunks(tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap.partial").write_bytes(whole[: len(whole) // 2])
    arrived = []
    with pytest.raises(LogError, match=r"nothing came for 0\.05 s and the log has no end"):
        for message in follow(tmp_path / "b.mcap", idle_seconds=0.05, poll_seconds=0.01):
            arrived.append(message)
    assert len(arrived) % 20 == 0 and arrived


def test_following_passes_over_damage(tmp_path: Path) -> None:
    data = bytearray(write_chunks(tmp_path / "a.mcap").read_bytes())
    second = [part for part in read_run(tmp_path / "a.mcap").parts if getattr(part, "opcode", 0) == 6][1]
    data[second.end - 5] ^= 0xFF
    (tmp_path / "b.mcap").write_bytes(data)
    damages: list[object] = []
    found = [m.payload["trial"] for m in follow(tmp_path / "b.mcap", on_damage=damages.append)]
    assert found == [*range(20), *range(40, 80)] and len(damages) == 1
