"""`fdi check`: what it does and prints. Its options: `options/check.py`.

Path: cli.check.run → config.plant_file.chosen_plant → jobs.recording_check.checked →
config.loaded_recordings.read_recording → recordings.check.check_recording → gap.preprocess.acquisition.examined →
recordings.plant_units.wrong_units → recordings.volume_balance.balance_along
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fdi_torch.cli import DONE, NOT_EXPLAINED
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant_file import PLACEHOLDERS, chosen_plant, placeholders
from fdi_torch.config.yaml_files import find_plant
from fdi_torch.names import counted
from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.plant.scales import tank_table
from fdi_torch.recordings.csv_writing import header_of

if TYPE_CHECKING:
    from fdi_torch.config.recording_config import RecordingConfig
    from fdi_torch.recording import Recording
    from fdi_torch.recordings.check import RecordingCheck

WRONG = ("empty", "range", "slip", "unit")  # findings that no diagnosis accepts or survives


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    plant, recordings, base = _wanted(arguments)
    checks = []
    guesses = [] if arguments.plant is None else placeholders(find_plant(arguments.plant, Path.cwd()))
    if guesses:
        screen.say(f"{arguments.plant}: {PLACEHOLDERS}")
        screen.points(guesses)
        screen.say()
    _show_plant(plant, screen)
    if not recordings:
        screen.say(f"columns of a recording: {header_of(plant.channel_units(), plant.output_units())}")
    if arguments.picture:
        from fdi_torch.report.schematic import schematic
        from fdi_torch.report.style import save

        screen.say(f"picture: {save(schematic(plant), Path(arguments.picture))}")
    for config in recordings:
        from fdi_torch.jobs.recording_check import checked, usable_spans

        with screen.progress("check") as advance:
            advance(0.0, config.file)
            recording, check = checked(config, plant, base)
            advance(1.0, "done")
        checks.append(check)
        _show(recording, check, screen)
        if spans := usable_spans(recording, config, plant):
            screen.say(f"usable with all inputs known: {spans}")
    wrong = bool(guesses) or any(f.kind in WRONG for check in checks for f in check.findings)
    few = arguments.config is None and len(checks) == 1 and any(f.kind == "few" for f in checks[0].findings)
    if checks and arguments.config is None:
        named = f"--plant {arguments.plant} --recording {arguments.recording or arguments.file}"
        first = "correct the plant file or the columns, then check again; " if wrong else ""
        then = f"fdi gap {named} says whether the plant file explains it"
        if few:
            then = "record longer or more often; until then fdi gap and fdi refit refuse the recording"
        screen.say(f"next: {first}{then}")
    screen.result({"format": "fdi_torch.check/1", "plant": plant, "recordings": checks, "placeholders": guesses})
    return NOT_EXPLAINED if wrong else DONE


def _wanted(arguments: argparse.Namespace) -> tuple[PlantDescription, list[RecordingConfig], Path]:
    if arguments.config is not None:
        from fdi_torch.config.run_file import load_run

        run_file = load_run(arguments.config, arguments.set)
        if not run_file.config.recordings:
            raise ValueError("expected recordings in the run file, got a simulation; fdi simulate writes its recording")
        return run_file.plant, run_file.config.recordings, run_file.base
    recording = arguments.recording or arguments.file
    if arguments.recording and arguments.file:
        raise ValueError(f"expected one recording, got {arguments.file} and --recording {arguments.recording}")
    if arguments.plant is None:
        raise ValueError(
            "expected --plant, --plant and --recording, or --config; without a plant file, "
            "fdi new plant --recording FILE writes one from the columns of a recording"
        )
    plant, folder = chosen_plant(arguments.plant, unfinished=True), Path.cwd()
    if recording is None:
        return plant, [], folder
    from fdi_torch.config.loaded_recordings import listed_recordings

    return plant, *listed_recordings(recording, plant, folder)


def _show_plant(plant: PlantDescription, screen: Screen) -> None:
    screen.say(f"{plant.title}: {plant.counts}, {counted(len(plant.tolerances), 'constant')} with a tolerance")
    screen.show(tank_table(plant))
    if closed := _without_outlet(plant):
        screen.say(f"- {', '.join(closed)}: no water leaves but over a rim; if there is an outlet, add it under pipes")


def _without_outlet(plant: PlantDescription) -> list[str]:
    """The tanks from which no flow leads outside, by whatever way; a pipe leads both ways unless it falls freely."""
    flows = [(c.source, c.target) for c in plant.flow_components()]
    flows += [(p.target, p.source) for p in plant.pipes if not p.free_fall]
    drained = {OUTSIDE}
    for _ in plant.tanks:
        drained |= {source for source, target in flows if target in drained}
    return [tank.name for tank in plant.tanks if tank.name not in drained]


def _show(recording: Recording, check: RecordingCheck, screen: Screen) -> None:
    screen.say()
    screen.say(recording.headline)
    screen.show(check.table())
    for finding in check.findings:
        screen.say(f"- {finding.channel}: {finding.text}")
    if not check.findings:
        screen.say("nothing odd was found")
