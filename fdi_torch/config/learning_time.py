"""How long the fault-free part of a new monitor should be."""

from __future__ import annotations

import torch

from fdi_torch.monitor.detection import make_detector
from fdi_torch.monitor.fault_free_checks import RATE_FACTOR
from fdi_torch.monitor.samples import usual_interval
from fdi_torch.monitor.whitening import FEWEST_SAMPLES, Whitening
from fdi_torch.recording import Recording


def learning_time(recording: Recording, false_alarms_every: float) -> float:
    """Time from which white noise determines the false-alarm rate within a factor of RATE_FACTOR (95 %), s.

    The recording gives the sampling interval and the number of sensors; correlated noise and random flows need longer.
    false_alarms_every: mean time between false alarms, s. Raises ValueError if it is less than 20 samples.
    """
    interval, sensors = usual_interval(recording.time), len(recording.output_names)
    zero, one = torch.zeros(sensors, dtype=torch.float64), torch.eye(sensors, dtype=torch.float64)
    error = torch.full_like(zero, (2.0 * FEWEST_SAMPLES) ** -0.5)  # of ln of a standard deviation
    white = Whitening(zero, zero.new_zeros(0, sensors, sensors), one, FEWEST_SAMPLES, error)
    draws = torch.Generator().manual_seed(0)
    design = make_detector("cusum", false_alarms_every, interval, sensors, draws, learnt=white).design
    return interval * FEWEST_SAMPLES * max(design.learning_factor(RATE_FACTOR), 1.0)
