"""Recordings out of a log, as they were read, so that a run can be done again."""

from __future__ import annotations

import torch

from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.logbook import own_signals
from fdi_torch.recording import Recording


def recording_in(log: LoggedRun, group: str, number: int) -> Recording:
    """A logged recording, with the name and the fingerprint of the file that it was read from."""
    signals, about = own_signals(log, group), log.metadata.get("fdi_torch.data", {})
    time, inputs, outputs = (torch.as_tensor(a) for a in (signals.time, signals.inputs, signals.outputs))
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
    )
