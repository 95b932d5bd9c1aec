"""What large networks cost: a simulated hour, and a compiler's time for the kernels of a fit."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from unittest.mock import patch

import torch

from benchmarks.timing import seconds_in_rounds
from fdi_torch.effects import build_network, placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.recording import Recording
from fdi_torch.simulate import compiled_engine
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.simulated_recording import clean_readings

SIZES = (3, 10, 30)
Row = tuple[int, float, float, float]


def branched(tanks: int) -> PlantDescription:
    """A tree of tanks, every third with an outlet; where nothing flows through, levels come to rest at the same."""
    basins = tuple(Tank(f"T{i}", 0.012 + 0.002 * (i % 7), 1.0, start_level=0.3) for i in range(1, tanks + 1))
    pipes = [Pipe(f"P{i}", f"T{max(1, i - i % 2)}", f"T{i + 1}", 6e-5, 0.6) for i in range(1, tanks)]
    pipes += [Pipe(f"OUT{i}", f"T{i}", OUTSIDE, 7e-5, 0.6) for i in range(1, tanks + 1, 3)]
    pumps = tuple(Pump(f"Q{i}", f"T{i}", 4e-4) for i in range(2, tanks + 1, 3))
    return PlantDescription("tree", basins, tuple(pipes), pumps, tuple(Sensor(f"h{t.name}", t.name) for t in basins))


def an_hour(plant: PlantDescription) -> Recording:
    """Samples each second, pumps that switch each ten minutes."""
    time, tanks = torch.arange(3601, dtype=torch.float64), len(plant.tanks)
    flows = 2e-5 + 8e-5 * torch.rand(7, len(plant.pumps), generator=torch.Generator().manual_seed(0)).double()
    nothing = torch.full((len(time), tanks), torch.nan, dtype=torch.float64)
    return plant.recording(time, flows[time.long() // 600], nothing)


def compiler_seconds(work: Callable[[], object]) -> float:
    """CPU seconds of processes that some work starts, with nothing in the cache yet."""
    compiled_engine._kernel.cache_clear()
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, XDG_CACHE_HOME=folder):
        before = os.times()
        work()
        after = os.times()
    compiled_engine._kernel.cache_clear()
    return after.children_user + after.children_system - before.children_user - before.children_system


def measure(budget: float) -> list[Row]:
    """Tanks, CPU seconds of an hour, of the compiler for it, of the compiler for fixed steps with their Jacobian."""
    rows: list[Row] = []
    for tanks in SIZES:
        plant, faults = branched(tanks), {"T1.leak.size": 0.3, "P1.plugging.size": 0.4}
        network, recording = build_network(plant, placements_for(faults)), an_hour(plant)
        space = ParameterSpace(network.constants[name] for name in faults)
        engine = CompiledEngine(network, space, lay_out(recording, plant.channels(), 1.0))

        def simulate(network=network, recording=recording, faults=faults) -> object:  # type: ignore[no-untyped-def]
            return clean_readings(network, recording, faults)

        first = compiler_seconds(simulate)
        with_jacobian = compiler_seconds(lambda engine=engine: engine.prepare(tangent=True))  # type: ignore[misc]
        (seconds,) = seconds_in_rounds([simulate], budget, 3)
        rows.append((tanks, seconds, first, with_jacobian))
    return rows


def table(rows: list[Row]) -> str:
    lines = ["| tanks | an hour, CPU s | over three tanks | compiler, CPU s | compiler, with Jacobian, CPU s |"]
    lines.append("|---|---|---|---|---|")
    for tanks, seconds, first, with_jacobian in rows:
        ratio = seconds / rows[0][1]
        lines.append(f"| {tanks} | {seconds:.3f} | {ratio:.1f} | {first:.1f} | {with_jacobian:.1f} |")
    return "\n".join(lines)
