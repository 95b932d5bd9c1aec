"""Recordings restored from a log, to repeat a run."""

from __future__ import annotations

import torch

from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.logbook import own_signals
from fdi_torch.recording import Recording


def logged_recording(log: LoggedRun, group: str, number: int) -> Recording:
    """A logged recording with name and hash of its original file."""
    signals, about = own_signals(log, group), log.metadata.get("fdi_torch.data", {})
    time, inputs, outputs = (torch.as_tensor(a) for a in (signals.time, signals.inputs, signals.outputs))
    names = (*signals.input_names, *signals.output_names)
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
        written={name: about[f"{number}.unit.{name}"] for name in names if f"{number}.unit.{name}" in about},
    )
