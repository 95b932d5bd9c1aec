"""`fdi simulate`: what it does and prints. Its options: `options/simulate.py`.

Path: cli.simulate.run → config.run_file.load_run → jobs.run_setup.simulate_recording →
simulate.simulated_recording.clean_readings → simulate.simulated_recording.with_noise →
recordings.csv_writing.write_csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

from fdi_torch.cli.options import overrides
from fdi_torch.cli.screen import Screen
from fdi_torch.config.run_file import load_run
from fdi_torch.jobs.log_paths import free_path
from fdi_torch.jobs.run_setup import simulate_recording
from fdi_torch.recordings.csv_writing import write_csv


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    job = load_run(arguments.config, overrides(arguments))
    with screen.progress(job.name) as advance:
        advance(0.0, "integrating")
        recording = simulate_recording(job)
        named = Path(job.config.output.folder) / f"{job.name}.csv"
        path = write_csv(recording, named if arguments.replace else free_path(named.parent, job.name, "csv"))
        advance(1.0, "done")
    if job.config.device != "cpu":
        screen.note(
            f"device: {job.config.device} is for fdi train and fdi study; one simulation is computed on the CPU"
        )
    for note in recording.notes:
        screen.note(note)
    screen.say(f"{len(recording)} samples, {float(recording.time[-1]):g} s: {path}")
    if path != named:
        screen.say(f"- {named} existed and was kept; with --replace it is overwritten")
    screen.result({"format": "fdi_torch.simulate/1", "recording": str(path), "samples": len(recording)})
    return 0
