"""Recovery of damaged logs: everything undamaged is saved, nothing damaged is copied, nothing raises."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from example_logs import FIXED, write_chunks, write_everything, write_finished
from mcap.reader import make_reader

from fdi_torch.logbook import LogError, RunLog, read_run, recover

Key = tuple[str, int, int, bytes]


def truth(path: Path) -> list[tuple[int, int, list[Key]]]:
    """Chunks of a whole file by the reference reader: first byte, last byte, messages."""
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        messages = [
            (channel.topic, message.log_time, message.sequence, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
        counts = [_chunk_count(file, index.message_index_offsets) for index in summary.chunk_indexes]
        edges = np.cumsum([0, *counts])
        places = [(i.chunk_start_offset, i.chunk_start_offset + i.chunk_length) for i in summary.chunk_indexes]
    return [(*place, messages[a:b]) for place, a, b in zip(places, edges[:-1], edges[1:], strict=True)]


def _chunk_count(file: object, offsets: dict[int, int]) -> int:
    from mcap.data_stream import ReadDataStream
    from mcap.records import MessageIndex

    count = 0
    for offset in offsets.values():
        file.seek(offset + 9)  # type: ignore[attr-defined]
        count += len(MessageIndex.read(ReadDataStream(file)).records)  # type: ignore[arg-type]
    return count


def saved(path: Path) -> list[Key]:
    """Messages of a recovered file, which must be whole in the reference reader's eyes."""
    with open(path, "rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.sequence, message.data) for _, channel, message in found]


def check(whole: list[tuple[int, int, list[Key]]], broken: bytes, first: int, last: int, folder: Path) -> None:
    """Recover `broken`, whose bytes first..last differ from the whole file's."""
    source, target = folder / "broken.mcap", folder / "saved.mcap"
    source.write_bytes(broken)
    target.unlink(missing_ok=True)
    try:
        done = recover(source, target)
    except LogError as error:
        assert "expected an MCAP file" in str(error) or "empty" in str(error)
        assert all(start < last and end > first for start, end, _ in whole)
        return
    found = saved(target)
    must = [key for start, end, keys in whole if end <= first or start >= last for key in keys]
    assert len(found) == done.messages
    assert is_subsequence(must, found)
    assert is_subsequence(found, [key for *_, keys in whole for key in keys])


def is_subsequence(part: list[Key], sequence: list[Key]) -> bool:
    rest = iter(sequence)
    return all(key in rest for key in part)


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every topic, in several chunks and with attachments."""
    path = tmp_path_factory.mktemp("golden") / "golden.mcap"
    with RunLog(path, "train", **FIXED) as log:
        write_everything(log, 20)
        log.attach("picture.png", bytes(range(256)))
        for number in range(20):
            log.trial(number, {"x": number / 3})
            if number % 5 == 4:
                log.attach(f"{number}.bin", b"x")
    return path


def cuts(path: Path, number: int) -> Iterator[int]:
    yield from np.random.default_rng(1).integers(0, path.stat().st_size, number).tolist()


def test_a_file_cut_at_every_byte_of_its_last_chunk(golden: Path, tmp_path: Path) -> None:
    whole, data = truth(golden), golden.read_bytes()
    start, end, _ = whole[-1]
    assert len(whole) == 5 and end - start > 100
    for cut in range(start, end + 1):
        check(whole, data[:cut], cut, len(data), tmp_path)


@pytest.mark.parametrize("number", [40, pytest.param(400, marks=pytest.mark.slow)])
def test_a_file_cut_anywhere(golden: Path, tmp_path: Path, number: int) -> None:
    whole, data = truth(golden), golden.read_bytes()
    for cut in cuts(golden, number):
        check(whole, data[:cut], cut, len(data), tmp_path)


@pytest.mark.parametrize("number", [60, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("ended", [True, False])
def test_flipped_bits_and_zeroed_ranges(golden: Path, tmp_path: Path, number: int, ended: bool) -> None:
    """Also in a file without end, where no summary repeats the channels."""
    whole, data = truth(golden), golden.read_bytes()
    data = data if ended else data[: whole[-1][1]]
    rng = np.random.default_rng(2 + ended)
    for case in range(number):
        first = int(rng.integers(0, len(data)))
        last = first + 1 if case % 2 else min(first + int(rng.integers(1, 600)), len(data))
        broken = bytearray(data)
        broken[first:last] = bytes([data[first] ^ 1 << int(rng.integers(8))]) if case % 2 else bytes(last - first)
        check(whole, bytes(broken), first, last, tmp_path)


@pytest.mark.slow
def test_a_bit_flipped_in_every_part_of_a_file(golden: Path, tmp_path: Path) -> None:
    whole, data = truth(golden), golden.read_bytes()
    rng = np.random.default_rng(4)
    for place in range(0, len(data), 37):
        broken = bytearray(data)
        broken[place] ^= 1 << int(rng.integers(8))
        check(whole, bytes(broken), place, place + 1, tmp_path)


def test_the_report_tells_what_was_lost(tmp_path: Path) -> None:
    source = write_chunks(tmp_path / "a.mcap")
    chunks = truth(source)
    data = bytearray(source.read_bytes())
    data[chunks[1][1] - 4] ^= 0xFF
    source.write_bytes(data[: chunks[3][0] + 30])
    done = recover(source)
    assert done.target == tmp_path / "a.recovered.mcap" and done.messages == 40 and not done.whole and not done.ended
    assert [(gap.start, gap.end) for gap in done.lost] == [chunks[1][:2], (chunks[3][0], chunks[3][0] + 30)]
    assert "40 messages saved" in done.sentence and "2 damaged stretches" in done.sentence
    assert "did not finish" in done.sentence
    run = read_run(done.target)
    record = run.metadata["fdi_torch.recovery"]
    assert record["lost"] == "2" and record["ended"] == "false" and record["lost.0"].startswith(f"{chunks[1][0]} to ")
    assert run.complete and run.config_text == "a: 1\n"


def test_a_file_cut_between_two_chunks_has_no_damage_and_yet_no_end(tmp_path: Path) -> None:
    source = write_chunks(tmp_path / "a.mcap")
    third = truth(source)[2][0]
    source.write_bytes(source.read_bytes()[:third])
    done = recover(source)
    assert done.messages == 40 and not done.lost and not done.ended and not done.whole
    assert "did not finish" in done.sentence


def test_a_whole_file_is_said_to_be_whole(finished: Path) -> None:
    done = recover(finished)
    assert done.whole and "the file is whole" in done.sentence
    assert saved(done.target) == [key for *_, keys in truth(finished) for key in keys]


def test_partial_files_get_a_name_of_their_own(tmp_path: Path) -> None:
    write_finished(tmp_path / "run.mcap").rename(tmp_path / "run.mcap.partial")
    assert recover(tmp_path / "run.mcap.partial").target == tmp_path / "run.recovered.mcap"
    with pytest.raises(LogError, match="left by a run"):
        recover(tmp_path / "run.mcap.partial")
    assert read_run(tmp_path / "run.recovered.mcap").complete


def test_every_chunk_can_be_read_alone(golden: Path, tmp_path: Path) -> None:
    """Only the last chunk survives, and no summary: its messages do too."""
    whole, data = truth(golden), bytearray(golden.read_bytes())
    start, end, messages = whole[-1]
    data[100:start] = bytes(start - 100)
    (tmp_path / "a.mcap").write_bytes(data[:end])
    assert saved(recover(tmp_path / "a.mcap").target) == messages


def test_a_disk_that_is_full_at_the_last_bytes_leaves_no_torn_copy(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another attempt would take it for the log of a killed run."""

    def full(self: object) -> None:
        raise LogError("the disk is full; free some space")

    target = tmp_path / "saved.mcap"
    with monkeypatch.context() as patch:
        patch.setattr("fdi_torch.logbook.sink.Sink._summary", full)
        with pytest.raises(LogError, match="the disk is full"):
            recover(finished, target)
    assert not target.exists() and recover(finished, target).whole
