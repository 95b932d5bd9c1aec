"""`fdi plan`: what it does and prints. Its options: `options/plan.py`.

Path: cli.plan.run → config.loaded_recordings.planned_recordings → gap.identifiability.planned_identifiability
"""

from __future__ import annotations

import argparse
from pathlib import Path

from fdi_torch.amounts import effect_words
from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.loaded_recordings import planned_recordings
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.config.simulation import reading_noise
from fdi_torch.gap.identifiability import SEPARABLE, Identifiability, planned_identifiability
from fdi_torch.jobs.gap import library_entries, one_thread
from fdi_torch.names import counted


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    plant = chosen_plant(arguments.plant)
    noise = reading_noise(arguments.noise, plant)
    planned = planned_recordings(arguments.recording, plant, Path.cwd())[0]
    for note in planned.notes:
        screen.note(note)
    with one_thread():
        limits = planned_identifiability(plant, planned, noise, library_entries(arguments.library) or None)
    _show(limits, arguments.noise, screen)
    shown = {f"{place}.{name}": residual for (name, place), residual in limits.shown.items()}
    screen.result(
        {"format": "fdi_torch.plan/1", "hidden": limits.hidden, "inseparable": limits.inseparable, "shown": shown}
    )
    return DONE


def _show(limits: Identifiability, noise: str, screen: Screen) -> None:
    screen.say(
        f"of {counted(len(limits.shown), 'effect')} at a usual size, {len(limits.hidden) or 'none'} would be "
        f"hidden by a noise of {noise}; pairs that could not be distinguished: "
        f"{len(limits.inseparable) or 'none'}"
    )
    for name, place in limits.hidden:
        screen.say(f"hidden: {effect_words(name, place)}")
    for (a, at), (b, there), distance in limits.inseparable:
        both = f"{effect_words(a, at)} and {effect_words(b, there)}"
        screen.say(f"not distinguished: {both} (chi-square {distance:.1f}; {SEPARABLE:g} would distinguish them)")
