"""Costs of many lanes without keeping a trajectory, with sensitivities, and of a plant whose effects have memory."""

from __future__ import annotations

import resource

import torch

from benchmarks.simulators import NAMES, experiment, plant
from benchmarks.timing import best_seconds
from fdi_torch.config.plant import load_plant
from fdi_torch.effects import placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.compiled import CompiledEngine
from fdi_torch.simulate.engine import Readings

STEP = 10.0
EIGHT = ("Q1.pump_lag", "Q2.pump_lag", "Q1.pump_delay", "Q2.pump_delay", "h1.sensor_lag", "h2.sensor_lag")
EIGHT += ("h3.sensor_lag", "h1.sensor_delay")
Row = tuple[str, str, int, float, float]


def with_memory() -> tuple[TankNetwork, ParameterSpace]:
    """The three tanks with the paper's faults and eight lags and delays, all of them estimated."""
    network = TankNetwork(load_plant("three_tank"), placements_for([*NAMES, *(f"{e}.size" for e in EIGHT)]))
    names = [n for n in network.constants.names if n in NAMES or n.rpartition(".")[0] in EIGHT]
    return network, ParameterSpace(network.constants[n] for n in names)


def measure(budget: float) -> list[Row]:
    """Plant, what is computed, lanes, trajectories per CPU second, peak memory of the process in MiB."""
    rows: list[Row] = []
    for name, make in {"three tanks": plant, "three tanks, eight effects with memory": with_memory}.items():
        network, space = make()
        engine = CompiledEngine(network, space, experiment(STEP))
        values = engine.readings(space.nominal())
        data = Readings(values, torch.ones_like(values))
        for lanes in (1_000, 10_000, 100_000, 1_000_000) if make is plant else (1_000, 10_000):
            theta = space.nominal().expand(lanes, -1).contiguous()
            for what, run in {"moments": engine.moments, "gram": engine.gram}.items():
                if lanes <= (100_000 if what == "gram" else 1_000_000):
                    seconds = best_seconds(lambda run=run, theta=theta, data=data: run(theta, data), budget, 3)
                    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                    rows.append((f"{name}, {len(space)} parameters", what, lanes, lanes / seconds, peak))
    return rows


def table(rows: list[Row]) -> str:
    lines = ["| plant | sums | lanes | trajectories/s | peak memory, MiB |", "|---|---|---|---|---|"]
    return "\n".join(lines + [f"| {p} | {w} | {n:,} | {r:,.0f} | {m:,.0f} |" for p, w, n, r, m in rows])
