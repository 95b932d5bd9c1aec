"""What a monitor costs beside the time that its samples take to come: the observer, and one isolation of a window."""

from __future__ import annotations

from typing import Any

import torch

from benchmarks.timing import seconds_in_rounds
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, placements_for
from fdi_torch.monitor.detection import make_detector
from fdi_torch.monitor.hypothesis import Fault
from fdi_torch.monitor.isolation import isolate
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_settings import usual_settings
from fdi_torch.monitor.monitor_setup import usual_faults
from fdi_torch.monitor.noise_model import NoiseModel, learn_noise
from fdi_torch.monitor.observer_bank import ObserverBank, ObserverWindow
from fdi_torch.monitor.samples import Samples
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.equilibrium import equilibrium

FIVE = ("T1.leak.size", "T3.leak.size", "P13.plugging.size", "Q2.pump_gain.factor", "h3.sensor_bias.bias")
SAMPLES, NOISE = 1000, 1e-3


def measure(seconds: float) -> list[dict[str, Any]]:
    """CPU seconds of one core; readings of the three tanks at rest, once a second."""
    plant = load_plant("three_tank")
    rows = []
    for names in (FIVE, tuple(usual_faults(plant))):
        network = build_network(plant, placements_for(names))
        space = ParameterSpace(network.constants[name] for name in names)
        samples = at_rest(network, SAMPLES + 1)
        noise, _ = learn_noise(network, samples, space, space.nominal())
        observer = ObserverBank(network, space, noise.gain, noise.whitening)
        window = ObserverWindow(samples, samples.readings[0], SAMPLES)
        rows += [isolation(observer, window, slow) for slow in (False, True)]
        rows += [follow(network, space, noise, chunk) for chunk in (10, 10_000)]
    return rows


def isolation(observer: ObserverBank, window: ObserverWindow, slow: bool) -> dict[str, Any]:
    """Every fault alone, sudden; or sudden and slow, alone and in pairs."""
    believed, count = observer.space.nominal(), len(observer.space)
    faults = [Fault(column) for column in range(count)]
    growth_times = usual_settings(observer.network.description).growth_times if slow else None
    (spent,) = seconds_in_rounds(
        [lambda: isolate(observer, window, believed, faults, growth_times, 2 if slow else 1, flows=True)]
    )
    what = "sudden or slow, one or two" if slow else "sudden, one"
    return {"what": f"isolation, {count} faults, {what}", "samples": len(window), "seconds": spent}


def at_rest(network: TankNetwork, count: int) -> Samples:
    inputs = torch.tensor([50e-6, 50e-6], dtype=torch.float64)
    rest = equilibrium(network, inputs)
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Samples(torch.arange(count, dtype=torch.float64), inputs.expand(count, 2), rest + NOISE * noise)


def follow(network: TankNetwork, space: ParameterSpace, noise: NoiseModel, chunk: int) -> dict[str, Any]:
    """10,000 samples without an alarm."""
    detector = make_detector("cusum", 1e9, 1.0, 3, torch.Generator().manual_seed(0))
    samples, watch = at_rest(network, 10_001), Monitor(network, space, noise, detector)

    def run() -> None:
        state = watch.start(samples)
        for first in range(1, len(samples), chunk):
            state, _ = watch.advance(state, samples.segment(first, first + chunk))

    (spent,) = seconds_in_rounds([run], rounds=3)
    return {"what": f"following, {len(space)} faults, {chunk:,} samples at a time", "samples": 10_000, "seconds": spent}


def table(rows: list[dict[str, Any]]) -> str:
    lines = ["| work | samples | CPU seconds | times faster than 1 Hz |", "|---|---|---|---|"]
    for row in rows:
        margin = row["samples"] / row["seconds"]
        lines.append(f"| {row['what']} | {row['samples']:,} | {row['seconds']:.3f} | {margin:,.0f} |")
    return "\n".join(lines)
