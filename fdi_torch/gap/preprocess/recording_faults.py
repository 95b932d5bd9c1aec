"""Faults of a recording, as opposed to faults of the plant: each is a hypothesis that can be tested.

    wrong unit, swapped channels   `channel_assignment.py`
    clock offset                   `clock_offset.py`
    silent sensor                  `silent_sensors.py`

A hypothesis undoes its fault in the recording; only the clock offset has a parameter to fit. Its weight is the
log-likelihood of the corrected recording (`blockwise_likelihood.py`) plus the log prior. A hypothesis is fitted only if
its gain in log-likelihood, to first order in the constants, exceeds the cost of its prior.
`recording_fault_decision.py` compares the weights with those of the recording as it is.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator

from fdi_torch.gap.preprocess.channel_assignment import (
    swapped_inputs,
    swapped_sensors,
    units_of_inputs,
    units_of_sensors,
)
from fdi_torch.gap.preprocess.clock_offset import clock_offsets
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, WeightedFault
from fdi_torch.gap.preprocess.silent_sensors import silent_sensors

MOST_EXPLAINED = 0.8
"""If a sensor fault explains this share of the lacking log-likelihood, faults of inputs are not tested. A budget of
computing: each of them needs a fit of its own, and another fault that explains as much changes the sentence, not the
refusal."""


def weighted_faults(fits: CorrectedFits, constant: Collection[str]) -> Iterator[WeightedFault]:
    """All fitted hypotheses. constant: columns of sensors that never move.

    Faults of inputs come last because each needs a fit of its own; they are skipped if a fault of a sensor already
    explains most of the misfit.
    """
    as_is, best = fits.as_is, -math.inf
    for each in _of_sensors(fits, constant):
        best = max(best, each.log_weight - fits.prior)
        yield each
    if best <= as_is.log_likelihood + MOST_EXPLAINED * (as_is.most - as_is.log_likelihood):
        yield from units_of_inputs(fits)
        yield from swapped_inputs(fits)


def _of_sensors(fits: CorrectedFits, constant: Collection[str]) -> Iterator[WeightedFault]:
    yield from units_of_sensors(fits)
    yield from swapped_sensors(fits)
    yield from clock_offsets(fits)
    yield from silent_sensors(fits, constant)
