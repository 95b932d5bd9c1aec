"""Inspection of logs, and export from them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import orjson
import pytest
from example_logs import FIXED, write_chunks
from mcap.reader import make_reader

from fdi_torch.logbook import LogError, RunLog, export, export_attachment, inspect_log, read_run
from fdi_torch.logbook.export import FORMATS, safe_name
from fdi_torch.logbook.reader import Run
from fdi_torch.logbook.sink import Sink
from fdi_torch.logbook.topic_definitions import TOPICS


def test_a_whole_log_on_one_screen(finished: Path) -> None:
    found = inspect_log(finished)
    assert found.ours and found.health.sound and found.advice == ""
    assert found.about["run"]["kind"] == "train" and found.about["status"]["status"] == "completed"
    assert set(found.topics) == set(TOPICS)
    with open(finished, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    assert found.messages == summary.statistics.message_count
    assert found.health.chunks == len(summary.chunk_indexes)
    output = found.topics["/plant/output"]
    assert (output.messages, output.first, output.units["h1"]) == (50, 0.0, "m")
    assert output.last == pytest.approx(4.9)
    assert found.attachments["config.yaml"].size == len("plant: three_tank\n")


def test_a_foreign_file_is_described_too(tmp_path: Path) -> None:
    sink = Sink(tmp_path / "a.mcap", "recorder 3", profile="ros2")
    sink.metadata("rig", {"place": "hall 4"})
    sink.finish()
    found = inspect_log(tmp_path / "a.mcap")
    assert not found.ours and found.about == {} and found.library == "recorder 3"
    assert found.other_metadata == {"rig": {"place": "hall 4"}} and found.health.sound


def test_a_torn_file_is_not_sound(tmp_path: Path) -> None:
    path = write_chunks(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[:-200])
    found = inspect_log(path)
    assert not found.health.ended and not found.health.sound and "fdi recover" in found.advice
    assert any("the file has no end" in problem for problem in found.health.problems)


def test_every_kind_of_damage_is_named(tmp_path: Path) -> None:
    path = write_chunks(tmp_path / "a.mcap")
    parts = read_run(path).parts
    chunk = next(part for part in parts if getattr(part, "opcode", 0) == 6)
    data = bytearray(path.read_bytes())
    data[chunk.end - 4] ^= 1
    path.write_bytes(data)
    problems = " | ".join(inspect_log(path).health.problems)
    assert f"bytes {chunk.start} to {chunk.end}" in problems
    assert "the CRC over the data differs" in problems
    assert "the summary counts 80 messages, the file holds 60" in problems


def test_a_flip_in_metadata_is_seen_by_the_crc_over_the_data(finished: Path) -> None:
    data = finished.read_bytes()
    finished.write_bytes(data.replace(b"rig.csv", b"rag.csv"))
    found = inspect_log(finished)
    assert found.health.problems == ("the CRC over the data differs",) and "is damaged" in found.advice


def test_a_wrong_index_is_seen(tmp_path: Path) -> None:
    path = write_chunks(tmp_path / "a.mcap")
    index = next(part for part in read_run(path).parts if getattr(part, "opcode", 0) == 8)
    data = bytearray(path.read_bytes())
    data[index.start + 9 + 16] ^= 1
    path.write_bytes(data)
    assert "the index names 4 chunks, 3 of the file's 4 among them" in inspect_log(path).health.problems


def test_a_run_that_does_not_say_how_it_ended(tmp_path: Path) -> None:
    sink = Sink(tmp_path / "a.mcap", "x")
    sink.finish()
    assert inspect_log(tmp_path / "a.mcap").health.problems == ("the run does not say how it ended",)


def test_csv_holds_the_numbers_and_names_their_units(finished: Path) -> None:
    stream = io.BytesIO()
    assert export(read_run(finished), "/plant/output", "csv", stream) == 50
    rows = list(csv.reader(io.StringIO(stream.getvalue().decode())))
    assert rows[0] == ["t_s", "h1_m", "h2_m", "h3_m", "masked"]
    messages = list(read_run(finished).messages(["/plant/output"]))
    assert [float(row[1]) for row in rows[1:]] == [message.payload["h1"] for message in messages]
    assert rows[4][2] == "nan" and rows[6][4] == '["h1"]'
    stream = io.BytesIO()
    export(read_run(finished), "/plant/input", "csv", stream)
    assert stream.getvalue().startswith(b"t_s,Q1_m3_s,Q2_m3_s")


def test_ndjson_is_the_messages(finished: Path) -> None:
    stream = io.BytesIO()
    count = export(read_run(finished), "/estimate/final", "ndjson", stream)
    (line,) = stream.getvalue().splitlines()
    assert count == 1 and orjson.loads(line)["non_finite"] == ["values[1]=nan", "std[1]=inf"]


def test_npz_holds_numbers_and_texts(finished: Path) -> None:
    stream = io.BytesIO()
    export(read_run(finished), "/study/trial", "npz", stream)
    with np.load(io.BytesIO(stream.getvalue()), allow_pickle=False) as found:
        assert found["trial"] == [0.0] and found["group"].tolist() == ["snr 50"]
    stream = io.BytesIO()
    export(read_run(finished), "/estimate/final", "npz", stream)
    with np.load(io.BytesIO(stream.getvalue()), allow_pickle=False) as found:
        assert "values" not in found and found["status"].tolist() == ["converged"]


@pytest.mark.parametrize("form", FORMATS)
def test_an_export_reads_the_log_once(finished: Path, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    passes: list[Path] = []
    walk = Run.walk
    monkeypatch.setattr(Run, "walk", lambda self: passes.append(self.path) or walk(self))
    assert export(read_run(finished), "/estimate/final", form, io.BytesIO()) == 1
    assert len(passes) == 1


@pytest.mark.parametrize("form", FORMATS)
def test_a_topic_that_is_not_there(finished: Path, form: str) -> None:
    with pytest.raises(LogError, match=r"expected one of the topics /diagnosis/fault, .*, got /no"):
        export(read_run(finished), "/no", form, stream := io.BytesIO())
    assert stream.getvalue() == b""
    with pytest.raises(ValueError, match=r"expected one of the formats .*, got xls"):
        export(read_run(finished), "/log", "xls", io.BytesIO())


def test_what_is_no_json_is_not_exported(tmp_path: Path) -> None:
    from fdi_torch.logbook.topic_definitions import Channel

    sink = Sink(tmp_path / "a.mcap", "x")
    sink.message(Channel("/a", "cdr"), 0, 0, 0, b"\x00")
    sink.message(Channel("/b", "json"), 0, 0, 0, b"\x00")
    sink.finish()
    for topic, reason in (("/a", "is in cdr"), ("/b", "is not JSON")):
        with pytest.raises(LogError, match=reason):
            export(read_run(tmp_path / "a.mcap"), topic, "ndjson", io.BytesIO())


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("results.npz", "results.npz"),
        ("../../etc/passwd", "passwd"),
        ("/etc/passwd", "passwd"),
        ("..", "attachment"),
        ("C:\\windows\\x.ini", "x.ini"),
        ("<script>.html", "_script_.html"),
        (".bashrc", "bashrc"),
        ("a\x00b\n", "a_b_"),
        ("", "attachment"),
        ("x" * 300, "x" * 100),
    ],
)
def test_attachments_stay_in_their_folder(tmp_path: Path, name: str, safe: str) -> None:
    assert safe_name(name) == safe
    with RunLog(tmp_path / "a.mcap", "train", **FIXED) as log:
        log.attach(name, b"content")
    target = export_attachment(read_run(tmp_path / "a.mcap"), name, tmp_path / "out")
    assert target == tmp_path / "out" / safe and target.read_bytes() == b"content"
    with pytest.raises(LogError, match="exists already"):
        export_attachment(read_run(tmp_path / "a.mcap"), name, tmp_path / "out")
    with pytest.raises(LogError, match="a part of the path is a file"):
        export_attachment(read_run(tmp_path / "a.mcap"), name, tmp_path / "a.mcap")
