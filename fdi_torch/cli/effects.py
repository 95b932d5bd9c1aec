"""`fdi effects`: what it does and prints. Its options: `options/effects.py`.

Path: cli.effects.run → effects.catalogue.effects
"""

from __future__ import annotations

import argparse
from typing import Any

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.effects.catalogue import Entry, effects
from fdi_torch.tables import Table


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    catalogue = effects(chosen_plant(arguments.plant) if arguments.plant else None)
    entries = [catalogue[name] for name in arguments.names] or list(catalogue.entries)
    if arguments.names:
        for entry in entries:
            _show(entry, bool(arguments.plant), screen)
    else:
        rows = [[e.name, ", ".join(e.at if arguments.plant else e.kinds), e.meaning] for e in entries]
        header = ("effect", "at" if arguments.plant else "location", "description")
        screen.show(Table(header, rows, catalogue.headline, words=len(header)))
        screen.say("fdi effects NAME shows the equation, parameters and units of an effect, and how to write it")
    screen.result({"format": "fdi_torch.effects/1", "effects": [_as_json(entry) for entry in entries]})
    return DONE


def _show(entry: Entry, of_plant: bool, screen: Screen) -> None:
    screen.say(f"{entry.name}: {entry.meaning}")
    screen.say(f"  location: {entry.where}" + (f": {', '.join(entry.at)}" if of_plant else ""))
    screen.say(f"  acts {entry.begins}")
    screen.show(entry.table())
    screen.say(f"  in simulate.faults:     {entry.in_a_run_file}")
    screen.say(f"  in estimate.parameters: {entry.at[0]}.{entry.name}")
    screen.say(f"  in a plant's effects:   {entry.in_a_plant_file}")
    if entry.mistaken_for:
        screen.say(f"  easily mistaken for: {', '.join(entry.mistaken_for)}")
    for line in entry.law.splitlines():
        screen.say(f"  | {line}".rstrip())
    screen.say()


def _as_json(entry: Entry) -> dict[str, Any]:
    shown = ("meaning", "law", "stage", "kinds", "at", "begins", "mistaken_for")
    of_parameters = ("name", "unit", "nominal", "low", "high", "meaning")
    parameters = [{name: getattr(p, name) for name in of_parameters} for p in entry.parameters]
    return {"effect": entry.name, **{name: getattr(entry, name) for name in shown}, "parameters": parameters}
