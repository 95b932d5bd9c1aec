"""Architecture of the package: import directions, one file per outside library, and printing in cli only."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from fdi_torch.effects import EFFECTS

ROOT = Path(__file__).parents[1] / "fdi_torch"

# Lowest first. A room imports from rooms further down, and sideways only where that closes no circle.
LAYERS = (
    {
        "amounts",
        "capacity",
        "clock",
        "device",
        "disk",
        "interruption",
        "names",
        "untrusted_input",
        "parameters",
        "progress",
        "quantities",
        "recording",
        "sample_noise",
        "tables",
        "units",
    },
    {"plant"},
    {"effects", "simulate"},
    {"estimate", "logbook", "recordings"},
    {"live"},
    {"blind"},
    {"report", "gap", "study", "monitor"},
    {"config"},
    {"jobs"},
    {"view"},
    {"cli", "train", "__main__", "__init__"},
)
RANK = {room: rank for rank, layer in enumerate(LAYERS) for room in layer}

# Outside library -> where it may be imported.
DOORS = {
    "pint": ("units.py",),
    "torchdiffeq": ("simulate/reference_engine.py",),
    "pyarrow": ("recordings/arrow.py",),
    "openpyxl": ("recordings/excel.py",),
    "h5py": ("recordings/hdf5.py",),
    "influxdb_client_3": ("recordings/database.py",),
    "sqlalchemy": ("recordings/database.py",),
    "pandas": (),
    "xarray": (),
    "scipy": (
        "recordings/matlab.py",
        "blind/statistics.py",
        "estimate/ridge_coordinates.py",
        "estimate/state_noise.py",
        "gap/free_runs/between_runs.py",
        "gap/localization/fine_positions.py",
        "logbook/compare.py",
        "monitor/detection.py",
        "monitor/monte_carlo/detection_plan.py",
        "monitor/structural_analysis.py",
        "study/summary.py",
    ),
    "mcap": ("logbook/",),
    "yaml": ("config/",),
    "pydantic": ("config/",),
    "matplotlib": ("report/",),
    "dask": ("study/cluster.py",),
    "distributed": ("study/cluster.py",),
    "rich": ("cli/",),
    "starlette": ("view/server.py",),
    "uvicorn": ("view/server.py",),
    "foxglove": ("logbook/live.py",),
    "paho": ("live/mqtt.py",),
    "asyncua": ("live/opcua.py",),
    "pymodbus": ("live/modbus.py",),
    "prometheus_client": ("live/metrics.py",),
}


@cache
def modules() -> dict[str, ast.Module]:
    """Every module of the package by its path below it: 'plant/network.py' -> syntax tree."""
    paths = sorted(ROOT.rglob("*.py"))
    return {p.relative_to(ROOT).as_posix(): ast.parse(p.read_text(encoding="utf-8")) for p in paths}


def names_in(tree: ast.Module) -> Iterator[str]:
    """Dotted names of everything that a module imports, `from a import b` counted as both a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide which room they point to"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room_of(path: str) -> str:
    return path.split("/")[0].removesuffix(".py")


@cache
def imports() -> dict[str, frozenset[str]]:
    return {path: frozenset(names_in(tree)) for path, tree in modules().items()}


def imported_rooms(path: str) -> set[str]:
    ours = {name.split(".")[1] for name in imports()[path] if name.startswith("fdi_torch.")}
    return ours & RANK.keys()


def test_every_room_is_known_and_none_is_a_drawer_for_leftovers() -> None:
    rooms = {room_of(path) for path in modules()}
    assert rooms <= RANK.keys(), f"unknown rooms {rooms - RANK.keys()}: give them a layer"
    names = {part.removesuffix(".py") for path in modules() for part in path.split("/")}
    assert not names & {"utils", "util", "helpers", "common", "core", "misc"}


def test_imports_point_down() -> None:
    upwards = {
        path: above
        for path in modules()
        if (above := {room for room in imported_rooms(path) if RANK[room] > RANK[room_of(path)]})
    }
    assert not upwards, "modules import rooms from above"


def test_rooms_form_no_circle() -> None:
    graph: dict[str, set[str]] = {}
    for path in modules():
        graph.setdefault(room_of(path), set()).update(imported_rooms(path) - {room_of(path)})
    TopologicalSorter(graph).prepare()  # raises CycleError


def test_one_door_per_outside_library() -> None:
    beside = [
        (path, name)
        for path, names in imports().items()
        for name in names
        if not path.startswith(DOORS.get(name.split(".")[0], (path,)))
    ]
    assert not beside, "modules import libraries whose door is elsewhere"


def test_only_the_command_line_prints() -> None:
    calls = [(path, n.func) for path, tree in modules().items() for n in ast.walk(tree) if isinstance(n, ast.Call)]
    printing = {path for path, f in calls if isinstance(f, ast.Name) and f.id == "print" and room_of(path) != "cli"}
    assert not printing, "modules print; return a value instead"


@pytest.mark.parametrize("room", ["gap", "monitor"])
def test_diagnosis_asks_effects_what_they_are_and_knows_none_by_name(room: str) -> None:
    names = {e.name for e in EFFECTS}
    written = {
        (path, n.value)
        for path, tree in modules().items()
        for n in ast.walk(tree)
        if room_of(path) == room and isinstance(n, ast.Constant) and n.value in names
    }
    assert not written, "give the effect an attribute that says what it shares with others"


@cache
def reachable(path: str) -> frozenset[str]:
    """Files of the package that a module imports, directly or through others."""
    seen: set[str] = set()
    queue = [path]
    while queue:
        for name in imports()[queue.pop()]:
            file = name.removeprefix("fdi_torch.").replace(".", "/")
            for candidate in (f"{file}.py", f"{file}/__init__.py"):
                if name.startswith("fdi_torch.") and candidate in modules() and candidate not in seen:
                    seen.add(candidate)
                    queue.append(candidate)
    return frozenset(seen)


@pytest.mark.parametrize("path", ["estimate/evolution.py", "estimate/levenberg_marquardt.py"])
def test_searchers_know_tensors_and_costs_never_tanks(path: str) -> None:
    if path in modules():
        assert not {room_of(p) for p in reachable(path)} & {"plant", "effects", "simulate", "recording"}


@pytest.mark.parametrize("path", [f"blind/{p.name}" for p in (ROOT / "blind").glob("*.py")])
def test_hidden_rigs_are_written_a_second_time(path: str) -> None:
    """A plant's description is data and may be shared; no equation and no integrator may.

    The kinds of component hold their laws beside their data, so that only their direct import can be forbidden.
    """
    described = reachable("plant/description.py") | {"plant/description.py"}
    assert not {room_of(p) for p in reachable(path) - described} & {"effects", "simulate", "plant"}
    plant = {name for name in imports()[path] if name.startswith("fdi_torch.plant.")}
    assert all(name.startswith(("fdi_torch.plant.description", "fdi_torch.plant.components")) for name in plant)
