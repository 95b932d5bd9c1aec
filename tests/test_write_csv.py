"""A recording written to a file reads back the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from rigs import random_steps, three_tank

from fdi_torch.recordings.csv_files import read_csv
from fdi_torch.recordings.csv_writing import write_csv


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    plant = three_tank()
    blank = random_steps(plant, 200.0)
    outputs = torch.rand(len(blank), 3, dtype=torch.float64)
    outputs[17, 1] = float("nan")
    recording = replace(blank, outputs=outputs, mask=torch.isfinite(outputs))
    again = read_csv(write_csv(recording, tmp_path / "new" / "run.csv"), plant.channels(), ("h1", "h2", "h3"))
    assert torch.equal(again.mask, recording.mask)
    assert torch.allclose(again.inputs, recording.inputs, rtol=1e-11, atol=0)
    assert torch.allclose(again.outputs, recording.outputs, rtol=1e-11, atol=0, equal_nan=True)
    assert again.output_units == ("m", "m", "m")
