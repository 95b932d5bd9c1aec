"""Simulation of cases and the readings of their sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_torch.blind.conditions import HELD_OUT, RECORDED, Conditions
from fdi_torch.blind.deviation import Array, Deviation
from fdi_torch.blind.laws_sensor import READOUT_LAWS, SENSOR_LAWS
from fdi_torch.blind.plants import Rig
from fdi_torch.blind.simulator import HiddenRigs, SimulatedRun, grouped, simulate
from fdi_torch.plant.description import PlantDescription

PARTS = (("recording", RECORDED), ("holdout", HELD_OUT))
Deviations = tuple[Deviation, ...]
"""Differences of a rig from its plant file."""
Lane = tuple[Conditions, int, Deviations, bool]
"""One simulation: conditions, part (0 recording, 1 hold-out), deviations, whether random flows act."""


def simulated(lanes: Sequence[Lane], step: float) -> list[SimulatedRun]:
    """All simulations in one batch, with integration steps of `step` s."""
    rigs = HiddenRigs([c.built for c, *_ in lanes], [off for _, _, off, _ in lanes])
    return simulate(rigs, [c.drive(part, disturbed) for c, part, _, disturbed in lanes], step)


def noisy_readings(c: Conditions, run: SimulatedRun, part: int, deviations: Deviations) -> tuple[Array, Array]:
    """Readings with noise, and those without noise and readout effects, (T, S) m each."""
    clean = _measured_levels(c.rig, c.built, run.levels, deviations)
    return _with_laws(READOUT_LAWS, c.rig, clean + c.errors[part], deviations), clean


def _measured_levels(rig: Rig, built: PlantDescription, levels: Array, deviations: Sequence[Deviation]) -> Array:
    """(T, N) m -> (T, S) m: the level that follows from each reading with the sensor's nominal constants."""
    sensed = _with_laws(SENSOR_LAWS, rig, levels[:, rig.measured_tanks], deviations)
    pairs = list(zip(built.sensors, rig.plant.sensors, strict=True))
    gain = np.array([true.gain / nominal.gain for true, nominal in pairs])
    return sensed * gain + np.array([(true.offset - nominal.offset) / nominal.gain for true, nominal in pairs])


def _with_laws(laws: Any, rig: Rig, signal: Array, deviations: Sequence[Deviation]) -> Array:
    """The signal (T, S) after each active law of a group of laws, at its sensor."""
    time, result = np.arange(len(signal), dtype=np.float64), signal.copy()
    for group in grouped(laws, [[s.name for s in rig.plant.sensors]], [tuple(deviations)]):
        result[:, group.spot] = group.law(result[:, group.spot], time, group.numbers)
    return result
