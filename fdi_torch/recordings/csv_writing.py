"""Recordings as CSV files whose headers need no mapping."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from fdi_torch.disk import replacing
from fdi_torch.quantities import display_unit, unit_factor
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_text import header_unit


def write_csv(recording: Recording, path: Path | str) -> Path:
    """Write the recording as CSV whose headers need no mapping: t_s, Q1_cm3_s, h1_cm ..., in the units for display.

    Masked readings become empty cells. `read_recording` reads the same recording from it. Returns the path.
    """
    path = Path(path)
    inputs = dict(zip(recording.input_names, recording.input_units, strict=True))
    outputs = dict(zip(recording.output_names, recording.output_units, strict=True))
    factors = [unit_factor(si, _file_unit(name, si)) for name, si in (*inputs.items(), *outputs.items())]
    table = torch.cat([recording.inputs, recording.readings], dim=1).cpu().numpy() * np.asarray(factors)
    with replacing(path) as new, new.open("w", encoding="utf-8", newline="") as handle:
        handle.write(header_of(inputs, outputs) + "\n")
        for t, row in zip(recording.time.tolist(), table, strict=True):
            cells = ("" if np.isnan(value) else f"{value:.12g}" for value in row.tolist())
            handle.write(f"{t:.12g}," + ",".join(cells) + "\n")
    return path


def header_of(inputs: Mapping[str, str], outputs: Mapping[str, str]) -> str:
    """A header that needs no mapping, from names and SI units of channels: t_s,Q1_cm3_s,h1_cm."""
    named = [(name, _file_unit(name, si_unit)) for name, si_unit in (*inputs.items(), *outputs.items())]
    return ",".join(["t_s", *(f"{n}_{u}" if header_unit(f"{n}_{u}") == (n, u) else f"{n} [{u}]" for n, u in named)])


def _file_unit(name: str, si_unit: str) -> str:
    """The unit of a channel in a file: the unit for display, spelled as is usual in headers."""
    unit = display_unit(si_unit, name)[0] or "1"
    return _IN_HEADERS.get(unit, unit)


_IN_HEADERS = {"cm^3/s": "cm3_s", "1/s": "Hz", "1": "pct", "%": "pct"}
