"""Networks of many tanks: their own code path agrees with torchdiffeq and with the unrolled equations."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from own_steps import factored, solved
from rigs import assert_lanes_stand_alone
from torch import Tensor

from fdi_torch.effects import build_network, placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled_engine import MOST_UNROLLED, CompiledEngine
from fdi_torch.simulate.elimination import eliminate
from fdi_torch.simulate.engine import Readings, gram_of
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.simulated_recording import clean_readings
from fdi_torch.simulate.traced_engine import TracedEngine

TANKS = MOST_UNROLLED + 2
NAMES = ("T1.leak.size", "P1.plugging.size", "T2.area", "T1.start_level", "Q1.pump_lag.time_constant")


def branched(tanks: int = TANKS) -> PlantDescription:
    """A tree of tanks whose last one has the outlet; the others come to rest at equal levels."""
    basins = tuple(Tank(f"T{i}", 0.015 + 0.002 * (i % 3), 1.0, start_level=0.3) for i in range(1, tanks + 1))
    pipes = [Pipe(f"P{i}", f"T{max(1, i // 2)}", f"T{i + 1}", 6e-5, 0.6) for i in range(1, tanks)]
    pipes.append(Pipe("OUT", "T1", OUTSIDE, 8e-5, 0.6))
    pumps = (Pump("Q1", "T1", 4e-4), Pump("Q2", f"T{tanks}", 4e-4))
    return PlantDescription(
        "branched", basins, tuple(pipes), pumps, tuple(Sensor(f"h{t.name}", t.name) for t in basins)
    )


def rig(names: tuple[str, ...] = NAMES) -> tuple[TankNetwork, ParameterSpace]:
    network = build_network(branched(), placements_for(n for n in names if n.count(".") == 2))
    return network, ParameterSpace(network.constants[n] for n in names)


def planned(samples: int = 61, interval: float = 5.0) -> Recording:
    """Two pumps that switch now and then."""
    plant, time = branched(), interval * torch.arange(samples, dtype=torch.float64)
    flows = 2e-5 + 8e-5 * torch.rand(samples, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    held, nothing = flows[torch.arange(samples) // 12 * 12], torch.full((samples, TANKS), torch.nan).double()
    return plant.recording(time, held, nothing)


def several(space: ParameterSpace, count: int = 50) -> Tensor:
    share = torch.rand(count, len(space), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    nominal = space.nominal()
    return nominal + share * torch.where(nominal > 0, 0.3 * nominal, 0.4)


@pytest.mark.parametrize(("interval", "step"), [(5.0, 1.0), (1.0, 2.5)])
def test_engines_agree(interval: float, step: float) -> None:
    """In steps between samples, and at samples within steps."""
    network, space = rig()
    e, theta = lay_out(planned(31, interval), branched().channels(), step), several(space, 5)
    compiled, traced = CompiledEngine(network, space, e), TracedEngine(network, space, e)
    truth, jacobian = ReferenceEngine(network, space, e).linearise(theta)
    readings, slopes = compiled.linearise(theta)
    torch.testing.assert_close(compiled.readings(theta), truth, rtol=0, atol=1e-12)
    torch.testing.assert_close(readings, truth, rtol=0, atol=1e-12)
    torch.testing.assert_close(traced.readings(theta), truth, rtol=0, atol=1e-12)
    for q in range(len(space)):
        size = float(jacobian[..., q].abs().max())
        assert size > 0.0, space.names[q]
        torch.testing.assert_close(slopes[..., q], jacobian[..., q], rtol=0, atol=1e-9 * size)


def test_sums_are_those_of_readings_and_jacobian_and_no_lane_knows_its_neighbours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, space = rig()
    engine = CompiledEngine(network, space, lay_out(planned(21), branched().channels(), 1.0))
    theta, data = several(space), Readings(torch.rand(21, TANKS).double(), torch.ones(21, TANKS).double())
    torch.testing.assert_close(engine.gram(theta, data), gram_of(*engine.linearise(theta), data), rtol=1e-9, atol=0)
    assert_lanes_stand_alone(lambda t: engine.gram(t, data), theta, monkeypatch)


def test_a_clean_recording_is_exact() -> None:
    """Against steps so short that the explicit method is exact beside levels that are equal to a nanometre."""
    names = {"T1.leak.size": 0.3, "P1.plugging.size": 0.4}
    network, space = rig(tuple(names))
    recording = planned(25, 2.0)
    fine = lay_out(recording, branched().channels(), 2e-4)
    sharp = replace(fine, resolution=torch.tensor(0.01, dtype=torch.float64))
    truth = CompiledEngine(network, space, sharp).readings(space.vector(names)[None])[0]
    assert float((clean_readings(network, recording, names) - truth).abs().max()) < 1e-9


def test_a_clean_recording_needs_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    network, _ = rig(("T1.leak.size",))
    recording = planned(4, 2.0)
    expected = clean_readings(network, recording, {"T1.leak.size": 0.2})

    def refuse(*_: object) -> None:
        raise BuildError("expected a C++ compiler, got none")

    monkeypatch.setattr("fdi_torch.simulate.compiled_engine._kernel", refuse)
    found = clean_readings(network, recording, {"T1.leak.size": 0.2})
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("size", [1, 2, 7, 20])
def test_elimination_solves_what_it_is_told_the_pattern_of(size: int) -> None:
    generator = torch.Generator().manual_seed(size)
    dense = torch.rand(3, size, size, generator=generator, dtype=torch.float64)
    dense = torch.where(torch.rand(size, size, generator=generator) < 0.25, dense, 0.0)
    dense = dense + torch.diag_embed(1.0 + dense.sum(-2))
    pattern = [(i, j) for i in range(size) for j in range(size) if bool((dense[:, i, j] != 0).any()) and i != j]
    work = eliminate(size, pattern)
    right = torch.rand(3, size, generator=generator, dtype=torch.float64)
    matrix = [dense[:, i, j] for i, j in work.entries]
    found = torch.stack(solved(work, factored(work, matrix), list(right.unbind(-1))), dim=-1)
    torch.testing.assert_close(found, torch.linalg.solve(dense, right), rtol=1e-10, atol=1e-12)
    assert [work.given[work.entries.index(at)] for at in pattern] == list(range(len(pattern)))


def test_a_chain_of_tanks_is_eliminated_without_fill_in() -> None:
    pattern = [(i, j) for i in range(100) for j in (i - 1, i, i + 1) if 0 <= j < 100]
    work = eliminate(100, pattern)
    assert len(work.entries) == len(pattern) and sorted(work.order) == list(range(100))
