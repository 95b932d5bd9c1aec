"""Untrusted input: safe display of text, limits on sizes, and files that a log may not open."""

from __future__ import annotations

import gzip
import io
import json
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fdi_torch import cli
from fdi_torch.cli.screen import Screen
from fdi_torch.config.logged_config import logged_mapping, logged_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.yaml_files import SHIPPED
from fdi_torch.disk import replacing
from fdi_torch.logbook import LogError, arrays, read_run
from fdi_torch.logbook.sink import Sink
from fdi_torch.logbook.topic_definitions import Channel
from fdi_torch.tables import Table
from fdi_torch.untrusted_input import MOST_LINE, MOST_UNPACKED, printable, printable_json

HEADER = "t_s,Q1_cm3_s,Q2_cm3_s,h1_cm,h2_cm,h3_cm\n"
ROWS = "".join(f"{t},{50 + t % 7},50,{40 + t % 11},{30 + t % 5},{35 + t % 3}\n" for t in range(60))
THREE_TANK = (SHIPPED / "plants" / "three_tank.yaml").read_text()
COMMANDS = "\x1b]0;title\x07\x1b[2J\x9b31m\u202e\u200b\r\x7f"


def test_what_commands_a_terminal_is_spelled_out() -> None:
    assert printable("h1\t5 cm²\nüΩ") == "h1\t5 cm²\nüΩ"
    shown = printable(COMMANDS + "\udc80")
    assert shown.isascii() and shown.isprintable() and "\\x1b]0;title\\x07" in shown
    assert json.loads(printable_json(json.dumps(COMMANDS, ensure_ascii=False))) == COMMANDS


@pytest.mark.parametrize("name", ["[/b]", "[red]T", "[link=http://x]y[/link]", ":smile:", "\x1b[31mT"])
def test_every_way_of_text_to_the_screen_is_plain(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    screen = Screen()
    screen.say(name)
    screen.note(name)
    screen.complain(name)
    screen.show(Table((name, "unit"), [[name, name]], name))
    with screen.progress(name) as advance:
        advance(1.0, name)
    out, err = capsys.readouterr()
    assert out.count(printable(name)) == 5 and err.count(printable(name)) == 5
    assert "\x1b" not in out + err
    Screen(json=True).result({name: name + "\x9b\u202e"})
    text = capsys.readouterr().out
    assert "\x9b" not in text and "\u202e" not in text and json.loads(text) == {name: name + "\x9b\u202e"}


def test_tanks_may_have_any_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.csv").write_text(HEADER + "0,50,50,120,20,120\n1,50,50,121,20,121\n")
    (tmp_path / "plant.yaml").write_text(THREE_TANK.replace("T1", '"[/b]"').replace("T3", '"\\e[31mT"'))
    assert cli.main(["check", str(tmp_path / "rig.csv"), "--plant", str(tmp_path / "plant.yaml")]) == cli.NOT_EXPLAINED
    shown = capsys.readouterr().out
    assert "[/b]" in shown and "\\x1b[31mT" in shown and "\x1b" not in shown


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory of a process is read from /proc")
def test_a_compressed_recording_is_read_no_further_than_it_may_grow(tmp_path: Path) -> None:
    path = tmp_path / "zeros.csv.gz"
    path.write_bytes(gzip.compress(HEADER.encode() + b"0,0,0,0,0,0\n" * (MOST_UNPACKED // 6), 9))
    assert path.stat().st_size < 2**18
    words = ["check", str(path), "--plant", "three_tank"]
    code = (
        f"import sys; from pathlib import Path; from fdi_torch import cli; code = cli.main({words!r}); "
        "print(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0]); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == cli.MISUSE and f"expected at most {MOST_UNPACKED} bytes once unpacked" in done.stderr
    # Not ru_maxrss: a child starts with that of the process that started it.
    assert int(done.stdout.split()[-1]) < 2**20  # kB


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1" * (MOST_LINE + 1), f"row 2: expected at most {MOST_LINE} characters in a line, got more"),
        ('0,"' + "1" * 200_000 + '",1,1,1,1', "row 2: expected cells of a CSV file, got something else: field larger"),
        ("0,1,1,1,1,1\n5e300,1,1,1,1,1", "expected times within 5e+09 s, got 5e+300 s; correct the clock"),
        ("0,1,1,1e300,1,1\n1,1,1,1,1,1", "expected readings within 1e+12 in SI units, got 1e+298"),
    ],
)
def test_a_csv_file_of_odd_size_or_numbers_is_refused(text: str, sentence: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "rig.csv").write_text(HEADER + text + "\n")
    assert cli.main(["check", str(tmp_path / "rig.csv"), "--plant", "three_tank"]) == cli.MISUSE
    assert sentence in capsys.readouterr().err


def test_the_name_of_a_column_is_cut_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.csv").write_text(HEADER.replace("h1_cm", "h1" + "_" * 3000) + ROWS)
    assert cli.main(["check", str(tmp_path / "rig.csv"), "--plant", "three_tank"]) == cli.MISUSE
    error = capsys.readouterr().err
    assert "expected a column for h1" in error and len(error) < 1000


def log_with(path: Path, **attachments: bytes) -> Path:
    sink = Sink(path, "x")
    for name, content in attachments.items():
        sink.attachment(name.replace("__", "."), "", content)
    sink.finish()
    return path


def npy(shape: tuple[int, ...], content: bytes, kind: str = "<f8") -> bytes:
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


@pytest.mark.parametrize(
    "member",
    [
        npy((3_000_000_000,), b"\0" * 24),
        npy((3,), b""),
        npy((-3,), b"\0" * 24),
        npy((1,), b"\0" * 8, "|O"),
        b"",
        b"\x93NUMPY",
    ],
    ids=["claims more", "claims some", "negative", "objects", "empty", "cut"],
)
def test_an_array_whose_header_lies_is_refused(member: bytes, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("x.npy", member)
    with pytest.raises(LogError, match=r"results\.npz is not an \.npz file of plain arrays"):
        arrays(read_run(log_with(tmp_path / "a.mcap", results__npz=buffer.getvalue())))


def test_arrays_that_unpack_to_too_much_are_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, x=np.zeros(10_000_000))
    with pytest.raises(LogError, match=r"expected at most \d+ bytes once unpacked"):
        arrays(read_run(log_with(tmp_path / "a.mcap", results__npz=buffer.getvalue())))


def test_chunks_that_unpack_to_too_much_are_damage(tmp_path: Path) -> None:
    """Each chunk is below its own limit; together they are far more than a log of that size holds."""
    sink = Sink(tmp_path / "a.mcap", "x")
    for k in range(24):
        sink.message(Channel("/x"), 0, 0, k, b'{"a": "' + b"0" * 2**21 + b'"}')
        sink.flush()
    sink.finish()
    assert (tmp_path / "a.mcap").stat().st_size < 2**18
    with pytest.raises(LogError, match="more than the"):
        list(read_run(tmp_path / "a.mcap").messages())
    assert 10 < len(list(read_run(tmp_path / "a.mcap", salvage=True).messages())) < 24


def test_a_log_opens_no_file_that_it_names(tmp_path: Path) -> None:
    plant = tmp_path / "secret.yaml"
    plant.write_text(THREE_TANK)
    for name in (str(plant), "secret.yaml", "../plants/three_tank.yaml", "no_plant"):
        text = f"plant: {name}\nsimulate: {{}}\n".encode()
        log = read_run(log_with(tmp_path / "a.mcap", config__yaml=text))
        for read in (logged_mapping, logged_plant):
            with pytest.raises(ConfigError, match="plant: expected a plant, or a shipped one"):
                read(log)
        (tmp_path / "a.mcap").unlink()
    log = read_run(log_with(tmp_path / "a.mcap", config__yaml=b"plant: three_tank\n"))
    assert logged_plant(log).name == "three_tank"


@pytest.mark.parametrize("name", ["../x", "a/b", "/tmp/x", "..", "a\x1bb", "x" * 300])
def test_the_name_of_a_run_stays_in_its_folder(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["simulate", "--out", str(tmp_path / "out"), "--set", f"output.name={json.dumps(name)}", "--quiet"]
    assert cli.main(words) == cli.MISUSE
    assert "output.name: expected a file's name without folders" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_said_with_the_path() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    sentence = r"/dev/full: the disk is full; free some space"
    with pytest.raises(OSError, match=sentence), replacing(Path("/dev/full")) as path:
        path.write_text("x")


def test_without_a_compiler_the_compiled_engine_is_refused_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CXX", str(tmp_path / "none"))
    monkeypatch.setattr("fdi_torch.simulate.build._packaged_compiler", lambda: None)
    words = ["train", "--out", str(tmp_path), "--set", "engine=compiled", "--quiet"]
    assert cli.main(words) == cli.MISUSE
    assert "expected a C++ compiler, got none" in capsys.readouterr().err
