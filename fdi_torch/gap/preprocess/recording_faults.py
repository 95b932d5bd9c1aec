"""Faults of a recording, as opposed to faults of the plant: each is a hypothesis that can be tested.

    wrong unit, swapped channels   `channel_assignment.py`
    clock offset                   `clock_offset.py`
    silent sensor                  `silent_sensors.py`

Another, commands that move faster than their samples, shows in the readings alone (`recordings/input_sampling.py`).

A hypothesis undoes its fault in the recording; only the clock offset has a parameter to fit. Its weight is the
log-likelihood of the corrected recording (`blockwise_likelihood.py`) plus the log prior. A hypothesis is fitted only if
its gain in log-likelihood, to first order in the constants, exceeds the cost of its prior.
`recording_fault_decision.py` compares the weights with those of the unchanged recording.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from fdi_torch.gap.preprocess.channel_assignment import (
    swapped_inputs,
    swapped_sensors,
    units_of_inputs,
    units_of_sensors,
)
from fdi_torch.gap.preprocess.clock_offset import clock_offsets
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Suspicion
from fdi_torch.gap.preprocess.silent_sensors import silent_sensors


def suspicions(fits: CorrectedFits, constant: Collection[str]) -> Iterator[Suspicion]:
    """All hypotheses that are worth a fit. constant: columns of sensors that never move."""
    yield from units_of_sensors(fits)
    yield from swapped_sensors(fits)
    yield from clock_offsets(fits)
    yield from silent_sensors(fits, constant)
    yield from units_of_inputs(fits)
    yield from swapped_inputs(fits)
