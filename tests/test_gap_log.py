"""The log of a gap diagnosis holds the recording bit for bit, the plant and the whole answer."""

from __future__ import annotations

from pathlib import Path

import torch

from fdi_torch.config import load_plant
from fdi_torch.config.logged import logged_plant
from fdi_torch.gap_job import log_gap
from fdi_torch.logbook import own_signals, read_run
from fdi_torch.recording import Recording
from fdi_torch.report.material import gather
from fdi_torch.report.verdict import headline

ANSWER = {
    "verdict": "named",
    "alarm": {"p_value": 1e-9},
    "where": [{"location": "Q1", "share": 0.9}, {"location": "T1", "share": 0.2}],
    "causes": [{"effect": "pump_lag", "location": "Q1", "parameters": {}}],
    "ambiguity_set": [[{"effect": "pump_lag", "location": "Q1"}]],
    "posterior": [{"causes": [{"effect": "pump_lag", "location": "Q1"}], "probability": 1.0}],
    "closure": {},
}


def test_a_gap_log_says_all_that_was_found(tmp_path: Path) -> None:
    plant = load_plant("three_tank")
    generator = torch.Generator().manual_seed(0)
    time = torch.arange(50.0, dtype=torch.float64)
    inputs, outputs = (torch.rand(50, n, generator=generator, dtype=torch.float64) for n in (2, 3))
    recording = Recording(time, inputs, outputs, ("Q1", "Q2"), ("h1", "h2", "h3"), ("m^3/s",) * 2, ("m",) * 3)
    first, second = (log_gap(tmp_path, plant, recording, ANSWER) for _ in range(2))
    assert (first.name, second.name) == ("gap.mcap", "gap_2.mcap")
    log = read_run(first)
    assert logged_plant(log) == plant
    assert torch.equal(torch.as_tensor(own_signals(log).outputs), outputs)
    found = gather(log, plant)
    assert found.answer == ANSWER and headline(found) == "The gap comes from pump lag at Q1"
    assert [m["location"] for m in found.of("/gap/where")] == ["Q1", "T1"]
