"""Recordings from a database: equal to the same data as CSV, and no password in any message, log or page."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest
import torch

from fdi_torch.cli import DONE, MISUSE, main
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.recordings.database import expect_no_password, write_query

PASSWORD = "s3cret/of:the%plant"
RUN = """plant: three_tank
recordings: [{file: "sqlite:///plant.db?query=SELECT * FROM run ORDER BY t_s", trusted: true}]
estimate: {parameters: [T1.leak], search: {population: 8, evaluations: 40}}
output: {folder: ., name: own}
"""


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the same recording as rig.csv and in plant.db."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(
        "plant: three_tank\nsimulate: {duration: 200 s, sample_time: 4 s, faults: {T1.leak: 0.3}, "
        "noise: {snr_db: 30}, inputs: {Q1: {value: 50 cm^3/s}, Q2: {value: 50 cm^3/s}}}\nseed: 1\n"
    )
    assert main(["simulate", "--config", "rig.yaml", "--out", ".", "--quiet"]) == DONE
    header, *rows = (line.split(",") for line in Path("rig.csv").read_text().splitlines() if line[0] != "#")
    with sqlite3.connect("plant.db") as database:
        database.execute(f"CREATE TABLE run ({', '.join(f'{name} REAL' for name in header)})")
        database.executemany(f"INSERT INTO run VALUES ({', '.join('?' * len(header))})", reversed(rows))
    database.close()
    return tmp_path


def read(query: str, **keys: object) -> object:
    config = RecordingConfig.model_validate({"file": query, **keys})
    return read_recording(config, load_plant("three_tank"))


def test_a_query_gives_what_the_same_data_as_csv_give(rig: Path) -> None:
    plant = load_plant("three_tank")
    csv = read_recording("rig.csv", plant)
    query = "sqlite:///plant.db?query=SELECT * FROM run WHERE '12:30:00' LIKE '12:%' ORDER BY t_s"
    table = read_recording(query, plant)
    for name in ("time", "inputs", "outputs", "mask"):
        assert torch.equal(getattr(table, name), getattr(csv, name)), name
    assert table.source == query and len(table.sha256) == 64
    assert (
        read_recording(f"sqlite:///{rig}/plant.db?query=SELECT * FROM run ORDER BY t_s", plant).sha256 == table.sha256
    )


def test_a_job_reads_a_query_and_is_replayed_without_the_database(rig: Path) -> None:
    Path("own.yaml").write_text(RUN)
    assert main(["train", "--config", "own.yaml", "--quiet"]) != MISUSE
    Path("plant.db").unlink()
    assert main(["replay", "own.mcap", "--quiet"]) == DONE


def test_the_database_is_only_read(rig: Path) -> None:
    before = Path("plant.db").read_bytes()
    for query in ("DELETE FROM run", "DROP TABLE run"):
        with pytest.raises(ConfigError, match=r"readonly|does not return rows"):
            read(f"sqlite:///plant.db?query={query}")
    assert Path("plant.db").read_bytes() == before
    with pytest.raises(ConfigError, match=r"none\.db: file not found"):
        read("sqlite:///none.db?query=SELECT 1")
    assert not Path("none.db").exists()


@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ("sqlite:///plant.db", "got no query; add it"),
        ("sqlite:///plant.db?query=", "got no query; add it"),
        ("sqlite:///plant.db?query=SELECT * FROM absent", "no such table: absent"),
        ("sqlite:///plant.db?query=SELECT t_s, h1_cm FROM run ORDER BY t_s", "Q1"),
        ("sqlite:///plant.db?query=SELECT * FROM run ORDER BY t_s DESC", "expected time that increases"),
        ("nosuch://host/plant?query=SELECT 1", "nosuch"),
    ],
)
def test_errors_name_the_address(rig: Path, query: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence) as error:
        read(query)
    assert "/tmp" not in str(error.value).replace(str(rig), "") and query.partition("?")[0] in str(error.value)


@pytest.mark.parametrize(
    "address",
    [
        f"postgresql://me:{PASSWORD.replace('/', '%2F')}@host/plant?query=SELECT 1",
        "postgresql://host/plant?user=me&password=s3cret&query=SELECT 1",
        "influxdb://host/plant?TOKEN=s3cret&query=SELECT 1",
    ],
)
def test_a_written_password_is_refused_and_not_repeated(
    address: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("own.yaml").write_text(RUN.replace("sqlite:///plant.db?query=SELECT * FROM run ORDER BY t_s", address))
    for words in (
        ["train", "--config", "own.yaml"],
        ["check", "--config", "own.yaml", "--json"],
        ["check", address, "--plant", "three_tank"],
    ):
        assert main(words) == MISUSE
        shown = "".join(capsys.readouterr())
        assert "s3cret" not in shown and "in an environment variable" in shown, words
    assert not [path for path in here.rglob("*") if path.name != "own.yaml"]


def test_the_value_of_the_variable_is_hidden_in_the_drivers_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A driver that repeats the whole connection in its error, as some do."""
    import sqlalchemy

    monkeypatch.setenv("DB_PASSWORD", PASSWORD)
    given = []

    def create_engine(address: str, **keys: object) -> None:
        given.append(sqlalchemy.make_url(address).password)
        raise RuntimeError(f"cannot connect to {address} with {PASSWORD}")

    monkeypatch.setattr(sqlalchemy, "create_engine", create_engine)
    address = "postgresql://me:${DB_PASSWORD}@host/plant?query=SELECT 1"
    expect_no_password(address)
    with pytest.raises(ValueError, match=r"\*\*\*") as error:
        write_query(address, tmp_path / "table", Path)
    assert given == [PASSWORD] and "s3cret" not in str(error.value) and error.value.__cause__ is None
    monkeypatch.delenv("DB_PASSWORD")
    with pytest.raises(ValueError, match="expected a value of the environment variable DB_PASSWORD, got none; set it"):
        write_query(address, tmp_path / "table", Path)


def test_influxdb_is_queried_over_its_own_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server of Arrow Flight, InfluxDB's protocol for queries, that answers one of them and records the token."""
    import pyarrow as pa
    from pyarrow import flight

    asked: list[tuple[dict[str, str], str]] = []

    class Headers(flight.ServerMiddlewareFactory):  # type: ignore[misc]
        def start_call(self, info: object, headers: dict[str, list[str]]) -> None:
            token.append(headers.get("authorization", [""])[0])

    class Server(flight.FlightServerBase):  # type: ignore[misc]
        def do_get(self, context: object, ticket: flight.Ticket) -> flight.RecordBatchStream:
            question = json.loads(ticket.ticket)
            asked.append((question, token[-1]))
            if "absent" in question["sql_query"]:
                raise flight.FlightUnauthorizedError(f"no table for {token[-1]}")
            stamps = pa.array([0, 2_000_000_000, 4_000_000_000], pa.timestamp("ns"))
            return flight.RecordBatchStream(pa.table({"t": stamps, "h1_cm": [10.0, None, 12.5]}))

    token: list[str] = []
    monkeypatch.setenv("INFLUX_TOKEN", PASSWORD)
    with Server("grpc://127.0.0.1:0", middleware={"headers": Headers()}) as server:
        address = f"influxdb://127.0.0.1:{server.port}/plant?token=${{INFLUX_TOKEN}}&query=SELECT * FROM"
        write_query(f"{address} run", tmp_path / "table", Path)
        with pytest.raises(ValueError, match=r"got an error: .*no table for Bearer \*\*\*") as error:
            write_query(f"{address} absent", tmp_path / "other", Path)
    assert "s3cret" not in str(error.value)
    (question, authorization), _ = asked
    assert (question["sql_query"], question["database"]) == ("SELECT * FROM run", "plant")
    assert authorization == f"Bearer {PASSWORD}"
    lines = (tmp_path / "table").read_text().splitlines()
    assert lines == ["t\th1_cm", "1970-01-01T00:00:00\t10.0", "1970-01-01T00:00:02\t", "1970-01-01T00:00:04\t12.5"]
