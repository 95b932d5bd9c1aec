"""Recordings in a log: written with the predicted readings, and restored to repeat a run."""

from __future__ import annotations

from typing import Any

import torch

from fdi_torch.clock import of_stamp
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.logbook import RunLog, own_signals
from fdi_torch.recording import Recording


def log_recording(log: RunLog, recording: Recording, group: str) -> None:
    """Log a recording on /plant/input and /plant/output, or on /plant/GROUP/..."""
    r = recording
    names = (r.input_names, r.output_names, r.input_units, r.output_units)
    log.recording(r.time, r.inputs, r.outputs, *names, mask=r.mask, hold=r.hold, group=group)


def log_prediction(log: RunLog, recording: Recording, predicted: Any, group: str, noise_std: Any = None) -> None:
    """Log the readings that a model predicts, and the residuals."""
    r, units = recording, recording.output_units
    log.predictions(r.time, r.outputs, predicted, r.output_names, units, mask=r.mask, noise_std=noise_std, group=group)


def logged_recording(log: LoggedRun, group: str, number: int) -> Recording:
    """A logged recording with name and hash of its original file."""
    signals, about = own_signals(log, group), log.about("data")
    time, inputs, outputs = (torch.as_tensor(a) for a in (signals.time, signals.inputs, signals.outputs))
    names = (*signals.input_names, *signals.output_names)
    stamped = about.get(f"{number}.began")
    began, zone = of_stamp(stamped) if stamped else (None, 0.0)
    return Recording(
        time=time,
        inputs=inputs,
        outputs=outputs,
        input_names=signals.input_names,
        output_names=signals.output_names,
        input_units=signals.input_units,
        output_units=signals.output_units,
        mask=torch.as_tensor(signals.mask),
        hold=signals.hold,  # type: ignore[arg-type]
        source=about.get(f"{number}.path", str(log.path)),
        sha256=about.get(f"{number}.sha256", ""),
        began=began,
        zone=zone,
        written={name: about[f"{number}.unit.{name}"] for name in names if f"{number}.unit.{name}" in about},
    )
