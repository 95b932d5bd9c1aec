"""Fuzzing of file readers: each generated file is read, or refused in sentences, without a traceback, a hang or too
much memory.

The quick profile draws a few hundred files. The long one runs for half a minute, or as long as `--fuzz-minutes` states,
in rounds of 4000 files:

    python -m pytest tests/test_hostile_files.py -m slow -s --fuzz-minutes 60 --fuzz-seed 2

Reduced counterexamples are kept in tests/corpus.
"""

from __future__ import annotations

import itertools
import json
import resource
import signal
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hostile_files as drawn
import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from fdi_torch.config.loaded_recordings import known_segments_of, read_recording
from fdi_torch.config.logged_config import logged_plant
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.problems import Source
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.config.run_file import build_run
from fdi_torch.config.simulation import planned_recording
from fdi_torch.config.study_file import build_study
from fdi_torch.config.yaml_files import parse_yaml
from fdi_torch.effects import build_network
from fdi_torch.jobs.logged_recordings import logged_recording
from fdi_torch.jobs.replay import logged_run
from fdi_torch.jobs.run_setup import requested_space
from fdi_torch.logbook import inspect_log, read_run
from fdi_torch.logbook.schemas import json_schema
from fdi_torch.logbook.sink import EPOCH_NS, Sink
from fdi_torch.logbook.topic_definitions import Channel, topic_definition
from fdi_torch.recordings.check import check_recording
from fdi_torch.report.material import gather

CORPUS = Path(__file__).with_name("corpus")
MOST_SECONDS, MOST_WAITED = 10, 600
"""Of CPU for a file, and of time, on a machine that may have other work."""
MOST_BYTES = 2**30
PLANT = load_plant("three_tank")
CSV = "t_s,Q1_cm3_s,Q2_cm3_s,h1_cm,h2_cm,h3_cm\n" + "".join(
    f"{t},{50 + t % 7},50,{40 + t % 11},{30 + t % 5},{35 + t % 3}\n" for t in range(50)
)


def read_plant(data: bytes, folder: Path) -> None:
    plant = build_plant({"name": "plant"} | parse_yaml(data, "plant.yaml"), "plant.yaml")
    network = build_network(plant)
    assert len(network.constants) > 0
    again = build_plant(parse_yaml(dump_plant(plant).encode(), "again.yaml"), "again.yaml")
    assert [t.name for t in again.tanks] == [t.name for t in plant.tanks]


def read_run_file(data: bytes, folder: Path) -> None:
    run = build_run(parse_yaml(data, "run.yaml"), folder, Source("run.yaml"))
    requested_space(run)
    if run.config.simulate is not None:
        planned_recording(run.config.simulate, run.plant)
    for config in run.config.recordings:
        known_segments_of(read_recording(config, run.plant, folder), config, run.plant)


def read_study(data: bytes, folder: Path) -> None:
    build_study(parse_yaml(data, "study.yaml"), folder, Source("study.yaml"))


def read_csv(data: bytes, folder: Path) -> None:
    (folder / "recording.csv").write_bytes(data)
    config = RecordingConfig(file="recording.csv")
    recording = read_recording(config, PLANT, folder)
    check_recording(recording, PLANT)
    known_segments_of(recording, config, PLANT)


def read_log(data: bytes, folder: Path) -> None:
    """All that `inspect`, `report`, `replay` and a recording in MCAP read of a log; each part may refuse by itself."""
    path = folder / "log.mcap"
    path.write_bytes(data)
    run = read_run(path, salvage=True)
    readers: list[Callable[[], Any]] = [
        lambda: inspect_log(path),
        lambda: logged_plant(run),
        lambda: logged_run(run),
        lambda: check_recording(logged_recording(run, "", 0), PLANT),
        lambda: read_recording(RecordingConfig(file="log.mcap"), PLANT, folder),
    ]
    refused = 0
    for read in readers:
        try:
            read()
        except (ValueError, OSError):
            refused += 1
    material = gather(run)
    for part in ("groups", "recordings", "arrays", "residuals", "truth", "answer"):
        try:
            getattr(material, part)
        except (ValueError, OSError):
            refused += 1
    if refused > 4:
        raise ValueError("hardly anything in it")


@st.composite
def logs(draw: st.DrawFn, folder: Path) -> bytes:
    """A log of ours: a plant or a run as its configuration, messages of ours or others, now and then damaged."""
    path = folder / "drawn.mcap"
    path.unlink(missing_ok=True)
    sink = Sink(path, "fuzz")
    sink.metadata("fdi_torch.run", {"kind": draw(st.sampled_from(["train", "gap", "study", "monitor", "x"]))})
    sink.attachment("config.yaml", "", draw(drawn.spoiled(drawn.run_files())))
    for k in range(draw(st.integers(2, 6))):
        for topic, names in (("/plant/input", ("Q1", "Q2")), ("/plant/output", ("h1", "h2", "h3"))):
            put(sink, topic, {"t": float(k)} | dict.fromkeys(names, 0.3 + 0.01 * k), names)
    for topic, payload in draw(drawn.own_messages()):
        put(sink, topic, payload, tuple(payload))
    sink.finish()
    data = path.read_bytes()
    return draw(drawn.damaged(data)) if draw(st.integers(1, 4)) == 1 else data


def put(sink: Sink, topic: str, payload: dict[str, Any], names: tuple[str, ...]) -> None:
    definition = topic_definition(topic)
    schema = json_schema(definition, dict.fromkeys(names, "number"))
    pairs = tuple((f"unit.{name}", "m^3/s" if name.startswith("Q") else "m") for name in names)
    sink.message(
        Channel(topic, "json", definition.schema, "jsonschema", schema, pairs), EPOCH_NS, EPOCH_NS, 0, as_json(payload)
    )


def as_json(payload: dict[str, Any]) -> bytes:
    return (
        json.dumps(payload, default=str)
        .replace("NaN", "null")
        .replace("-Infinity", "-1e400")
        .replace("Infinity", "1e400")
        .encode()
    )


Kind = tuple[Callable[[bytes, Path], None], Callable[[Path], st.SearchStrategy[bytes]], int]
KINDS: dict[str, Kind] = {
    "plants": (read_plant, lambda folder: drawn.spoiled(drawn.plants()), 600),
    "runs": (read_run_file, lambda folder: drawn.spoiled(drawn.run_files()), 600),
    "studies": (read_study, lambda folder: drawn.spoiled(drawn.run_files(study=True)), 60),
    "recordings": (read_csv, lambda folder: drawn.csv_files(), 2400),
    "logs": (read_log, logs, 340),
}
"""Reader, strategy, and files in a round, fewer of those that take longer."""


@contextmanager
def limited() -> Iterator[None]:
    """Raises AssertionError after too long, and MemoryError at more memory beyond what the process has."""

    def stop(number: int, _: Any) -> None:
        raise AssertionError(f"took too long: {signal.Signals(number).name}")

    timers = {signal.SIGPROF: (signal.ITIMER_PROF, MOST_SECONDS), signal.SIGALRM: (signal.ITIMER_REAL, MOST_WAITED)}
    handlers = {number: signal.signal(number, stop) for number in timers}
    memory, pages = resource.getrlimit(resource.RLIMIT_AS), int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, memory[1]))
    for timer, seconds in timers.values():
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for timer, _ in timers.values():
            signal.setitimer(timer, 0)
        resource.setrlimit(resource.RLIMIT_AS, memory)
        for number, handler in handlers.items():
            signal.signal(number, handler)


def taken(read: Callable[[bytes, Path], None], data: bytes, folder: Path) -> bool:
    """Whether the file was taken; refused is what raises ValueError or OSError with sentences that are not empty."""
    with limited(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            read(data, folder)
        except (ValueError, OSError) as error:
            assert str(error).strip() and len(str(error)) < 20_000
            return False
    return True


def fuzz(kind: str, folder: Path, examples: int, start: int, quick: bool) -> Counter[str]:
    """Draws files of a kind and reads them. Returns how many were taken and refused."""
    read, strategy, _ = KINDS[kind]
    (folder / "rig.csv").write_text(CSV)
    seen: Counter[str] = Counter()

    @seed(start)
    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink] if quick else [Phase.generate],
    )
    @given(strategy(folder))
    def each(data: bytes) -> None:
        seen["taken" if taken(read, data, folder) else "refused"] += 1

    each()
    return seen


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_is_taken_or_refused_in_sentences(kind: str, tmp_path: Path) -> None:
    seen = fuzz(kind, tmp_path, max(30, KINDS[kind][2] // 10), 1, quick=True)
    assert seen["taken"] >= 0.5 * seen.total(), f"{dict(seen)}: too few reach what lies behind the schema"


def test_a_file_may_take_so_much_time_and_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MemoryError):
        taken(lambda data, folder: bytearray(2 * MOST_BYTES) and None, b"", tmp_path)
    monkeypatch.setattr("test_hostile_files.MOST_SECONDS", 0.05)
    with pytest.raises(AssertionError, match="took too long: SIGPROF"):
        taken(lambda data, folder: next(k for k in itertools.count() if k < 0), b"", tmp_path)


@pytest.mark.parametrize("path", sorted(p for p in CORPUS.glob("*/*")), ids=lambda p: f"{p.parent.name}/{p.name}")
def test_what_once_went_wrong_is_taken_or_refused_in_sentences(path: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.csv").write_text(CSV)
    taken(KINDS[path.parent.name][0], path.read_bytes(), tmp_path)


@pytest.mark.slow
def test_files_for_minutes(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    ends = time.monotonic() + 60.0 * pytestconfig.getoption("--fuzz-minutes")
    seen = {kind: Counter[str]() for kind in KINDS}
    for start in itertools.count(pytestconfig.getoption("--fuzz-seed")):
        for kind, counts in seen.items():
            begun = time.process_time()
            counts += fuzz(kind, tmp_path, KINDS[kind][2], start, quick=False)
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            print(start, kind, dict(counts), f"{time.process_time() - begun:.1f} s, {memory} MB", flush=True)
            if time.monotonic() > ends:
                assert all(c["taken"] >= 0.5 * c.total() for c in seen.values() if c)
                return
