"""Architecture of the package: import directions, one file per outside library, and printing in cli only."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "fdi_torch"

# Lowest first. A room imports from rooms further down, and sideways only where that closes no circle.
LAYERS = (
    {"capacity", "disk", "interruption", "names", "untrusted_input", "parameters", "recording", "tables", "units"},
    {"plant"},
    {"effects", "simulate"},
    {"estimate", "logbook", "recordings"},
    {"live"},
    {"blind"},
    {"report", "gap", "study", "monitor"},
    {"config"},
    {"jobs"},
    {"paper", "view"},
    {"cli", "train", "__main__", "__init__"},
)
RANK = {room: rank for rank, layer in enumerate(LAYERS) for room in layer}

# Outside library -> where it may be imported.
DOORS = {
    "pint": ("units.py",),
    "torchdiffeq": ("simulate/reference_engine.py",),
    "pyarrow": ("recordings/parquet.py", "recordings/feather.py"),
    "openpyxl": ("recordings/excel.py",),
    "h5py": ("recordings/hdf5.py",),
    "influxdb_client_3": ("recordings/influx.py",),
    "sqlalchemy": ("recordings/database.py",),
    "pandas": (),
    "xarray": (),
    "scipy": (
        "recordings/matlab.py",
        "blind/statistics.py",
        "estimate/state_noise.py",
        "monitor/monte_carlo/false_alarm_plan.py",
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


def modules() -> dict[str, ast.Module]:
    """Every module of the package by its path below it: 'plant/network.py' -> syntax tree."""
    paths = sorted(ROOT.rglob("*.py"))
    return {p.relative_to(ROOT).as_posix(): ast.parse(p.read_text(encoding="utf-8")) for p in paths}


def imported(tree: ast.Module) -> Iterator[str]:
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


def imported_rooms(tree: ast.Module) -> set[str]:
    ours = {name.split(".")[1] for name in imported(tree) if name.startswith("fdi_torch.")}
    return ours & RANK.keys()


MODULES = modules()


def test_every_room_is_known_and_none_is_a_drawer_for_leftovers() -> None:
    rooms = {room_of(path) for path in MODULES}
    assert rooms <= RANK.keys(), f"unknown rooms {rooms - RANK.keys()}: give them a layer"
    names = {part.removesuffix(".py") for path in MODULES for part in path.split("/")}
    assert not names & {"utils", "util", "helpers", "common", "core", "misc"}


@pytest.mark.parametrize("path", MODULES)
def test_imports_point_down(path: str) -> None:
    upwards = {room for room in imported_rooms(MODULES[path]) if RANK[room] > RANK[room_of(path)]}
    assert not upwards, f"{path} imports {upwards} from above"


def test_rooms_form_no_circle() -> None:
    graph: dict[str, set[str]] = {}
    for path, tree in MODULES.items():
        graph.setdefault(room_of(path), set()).update(imported_rooms(tree) - {room_of(path)})
    TopologicalSorter(graph).prepare()  # raises CycleError


@pytest.mark.parametrize("path", MODULES)
def test_one_door_per_outside_library(path: str) -> None:
    for name in imported(MODULES[path]):
        doors = DOORS.get(name.split(".")[0])
        assert doors is None or path.startswith(doors), f"{path} imports {name}; its door is {doors}"


@pytest.mark.parametrize("path", [path for path in MODULES if room_of(path) != "cli"])
def test_only_the_command_line_prints(path: str) -> None:
    calls = [n.func for n in ast.walk(MODULES[path]) if isinstance(n, ast.Call)]
    printed = [f for f in calls if isinstance(f, ast.Name) and f.id == "print"]
    assert not printed, f"{path} prints; return a value instead"


def reachable(path: str) -> set[str]:
    """Files of the package that a module imports, directly or through others."""
    seen: set[str] = set()
    queue = [path]
    while queue:
        for name in imported(MODULES[queue.pop()]):
            file = name.removeprefix("fdi_torch.").replace(".", "/")
            for candidate in (f"{file}.py", f"{file}/__init__.py"):
                if name.startswith("fdi_torch.") and candidate in MODULES and candidate not in seen:
                    seen.add(candidate)
                    queue.append(candidate)
    return seen


@pytest.mark.parametrize("path", ["estimate/evolution.py", "estimate/levenberg_marquardt.py"])
def test_searchers_know_tensors_and_costs_never_tanks(path: str) -> None:
    if path in MODULES:
        assert not {room_of(p) for p in reachable(path)} & {"plant", "effects", "simulate", "recording"}


@pytest.mark.parametrize("path", [path for path in MODULES if path.startswith("blind/")])
def test_hidden_rigs_are_written_a_second_time(path: str) -> None:
    """A plant's description is data and may be shared; no equation and no integrator may.

    The kinds of component hold their laws beside their data, so that only their direct import can be forbidden.
    """
    described = reachable("plant/description.py") | {"plant/description.py"}
    assert not {room_of(p) for p in reachable(path) - described} & {"effects", "simulate", "plant"}
    imports = {name for name in imported(MODULES[path]) if name.startswith("fdi_torch.plant.")}
    assert all(name.startswith(("fdi_torch.plant.description", "fdi_torch.plant.components")) for name in imports)
