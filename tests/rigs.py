"""Plants and recordings that tests share, and what holds for every engine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from fdi_torch.effects import build_network, placements_for
from fdi_torch.monitor.whitening import HIGHEST_ORDER, Whitening, score_whitenings
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import FLOW_KINDS, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording

PAPER_PARAMETERS = ("T1.leak.size", "OUT2.net_outlet.size", "T3.leak.size", "P13.openness.size", "P32.openness.size")
REST = (0.589912, 0.393275, 0.491593)  # m; the fault-free steady state at 50 cm3/s into both tanks


def three_tank(start: tuple[float, float, float] = REST, tank_height: float = 1.0) -> PlantDescription:
    references = ("P13", "OUT2", "P32")
    names = ("T1", "T2", "T3")
    return PlantDescription(
        "three_tank",
        tuple(
            Tank(n, 160e-4, tank_height, h, leak_reference=r) for n, h, r in zip(names, start, references, strict=True)
        ),
        (
            Pipe("P13", "T1", "T3", 0.6e-4, 0.6),
            Pipe("P32", "T3", "T2", 0.6e-4, 0.6),
            Pipe("OUT2", "T2", "outside", 0.6e-4, 0.6),
        ),
        (Pump("Q1", "T1", 90e-6), Pump("Q2", "T2", 90e-6)),
        (Sensor("h1", "T1"), Sensor("h2", "T2"), Sensor("h3", "T3")),
    )


def draining_tanks() -> PlantDescription:
    """Two tanks that run dry, one through the other, without any input."""
    tanks = (Tank("A", 0.01, 0.5, 0.45), Tank("B", 0.01, 0.5, 0.3))
    pipes = (Pipe("P", "A", "B", 2e-5, 0.6), Pipe("O", "B", "outside", 2e-5, 0.6))
    return PlantDescription("draining_tanks", tanks, pipes, sensors=(Sensor("a", "A"), Sensor("b", "B")))


def factor(unit: str, metre: float, second: float) -> float:
    """How a number in this unit changes when metres and seconds are rescaled; volts stay."""
    scale, result = {"m": metre, "s": second}, 1.0
    for sign, part in enumerate(unit.replace("/", "*/").split("*")):
        base, _, power = part.removeprefix("/").partition("^")
        result *= scale.get(base, 1.0) ** (float(power or 1) * (-1 if part.startswith("/") else 1))
        assert sign < 4
    return result


def rescaled(plant: PlantDescription, m: float, s: float) -> PlantDescription:
    """The same plant in other metres and seconds."""

    def f(unit: str) -> float:
        return factor(unit, m, s)

    flows: dict[str, Any] = {
        kind.part(): tuple(
            replace(c, **{name: getattr(c, name) * f(unit) for name, unit, _ in c.constants()})
            for c in getattr(plant, kind.part())
        )
        for kind in FLOW_KINDS
    }
    return replace(
        plant,
        tanks=tuple(
            replace(t, area=t.area * m**2, height=t.height * m, start_level=(t.start_level or 0.0) * m)
            for t in plant.tanks
        ),
        sensors=tuple(replace(y, gain=y.gain * f(y.unit) / m, offset=y.offset * f(y.unit)) for y in plant.sensors),
        gravity=plant.gravity * f("m/s^2"),
        **flows,
    )


def paper_network(plant: PlantDescription | None = None) -> tuple[TankNetwork, ParameterSpace]:
    """The three tanks with the paper's five fault parameters."""
    network = build_network(plant or three_tank(), placements_for(PAPER_PARAMETERS))
    return network, ParameterSpace(network.constants[name] for name in PAPER_PARAMETERS)


def whitening_of(residual: Tensor, highest_order: int = HIGHEST_ORDER) -> Whitening:
    """The best whitening of residuals (S, C)."""
    return score_whitenings(residual, highest_order)[0][1]


def blank_recording(
    plant: PlantDescription, inputs: torch.Tensor, time: torch.Tensor, hold: str = "zero_order"
) -> Recording:
    """Inputs (T, channels) without readings."""
    unread = torch.full((len(time), len(plant.sensors)), float("nan"), dtype=torch.float64)
    return plant.recording(time, inputs, unread, hold=hold)  # type: ignore[arg-type]


def constant_inputs(plant: PlantDescription, duration: float, sample: float = 1.0, flow: float = 50e-6) -> Recording:
    time = torch.arange(round(duration / sample) + 1, dtype=torch.float64) * sample
    return blank_recording(plant, torch.full((len(time), len(plant.channels())), flow, dtype=torch.float64), time)


def random_steps(plant: PlantDescription, duration: float, seed: int = 0, sample: float = 1.0) -> Recording:
    """Held inputs that switch at random samples between 10 and 90 cm3/s."""
    generator = torch.Generator().manual_seed(seed)
    time = torch.arange(round(duration / sample) + 1, dtype=torch.float64) * sample
    columns = []
    for _ in plant.channels():
        switch = torch.rand(len(time), generator=generator) < sample / 60.0
        values = 10e-6 + 80e-6 * torch.rand(len(time), generator=generator, dtype=torch.float64)
        columns.append(values[torch.cumsum(switch, 0)])
    return blank_recording(plant, torch.stack(columns, dim=1), time)


def assert_lanes_stand_alone(run: Callable[[Tensor], Tensor], theta: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same bits alone, beside lanes of NaN, and with two threads; a lane of NaN does not come out finite."""
    broken = theta.clone()
    broken[1::2] = torch.nan
    together = run(theta)
    assert torch.equal(run(broken)[::2], together[::2])
    assert torch.equal(run(theta[40:41])[0], together[40])
    assert not torch.isfinite(run(broken)[1::2]).all(dim=-1).all()
    with monkeypatch.context() as two_threads:
        two_threads.setattr(torch, "get_num_threads", lambda: 2)
        assert torch.equal(run(theta), together)
