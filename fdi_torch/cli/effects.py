"""`fdi effects`: what it does and prints. Its options: `options/effects.py`.

Path: cli.effects.run → effects.catalogue.effects
"""

from __future__ import annotations

import argparse
import math
from typing import Any

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.effects.catalogue import Entry, effects
from fdi_torch.quantities import display_unit


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    catalogue = effects(chosen_plant(arguments.plant) if arguments.plant else None)
    entries = [catalogue[name] for name in arguments.names] or list(catalogue.entries)
    if arguments.names:
        for entry in entries:
            _show(entry, bool(arguments.plant), screen)
    else:
        rows = [[e.name, ", ".join(e.at if arguments.plant else e.kinds), e.meaning] for e in entries]
        screen.table(
            catalogue.headline, ("effect", "at" if arguments.plant else "location", "description"), rows, left=3
        )
        screen.say("fdi effects NAME shows the equation, parameters and units of an effect, and how to write it")
    screen.result({"format": "fdi_torch.effects/1", "effects": [_as_json(entry) for entry in entries]})
    return DONE


def _show(entry: Entry, of_plant: bool, screen: Screen) -> None:
    screen.say(f"{entry.name}: {entry.meaning}")
    screen.say(f"  location: {entry.where}" + (f": {', '.join(entry.at)}" if of_plant else ""))
    screen.say(f"  acts {entry.begins}")
    screen.table("", ("parameter", "unit", "nominal", "range", "meaning"), _rows(entry), left=5)
    screen.say(f"  in simulate.faults:     {entry.in_a_run_file}")
    screen.say(f"  in estimate.parameters: {entry.at[0]}.{entry.name}")
    screen.say(f"  in a plant's effects:   {entry.in_a_plant_file}")
    if entry.mistaken_for:
        screen.say(f"  easily mistaken for: {', '.join(entry.mistaken_for)}")
    for line in entry.law.splitlines():
        screen.say(f"  | {line}".rstrip())
    screen.say()


def _rows(entry: Entry) -> list[list[str]]:
    """A row per parameter; a row per unit, with its places, for one that has several, as readings of sensors have."""
    rows = []
    for k, first in enumerate(entry.parameters):
        places: dict[str, list[str]] = {}
        for place, parameters in entry.by_place.items():
            unit, _ = display_unit(parameters[k].unit, f"{place}.{entry.name}.{first.name}")
            places.setdefault(unit, []).append(place)
        for unit, at in places.items():
            p = entry.by_place[at[0]][k]
            _, scale = display_unit(p.unit, f"{at[0]}.{entry.name}.{p.name}")
            low, high = (f"{scale * v:.4g}" if math.isfinite(v) else "" for v in (p.low, p.high))
            ends = f"{low} to {high}" if low and high else f"from {low}" if low else f"to {high}" if high else "any"
            name = p.name if len(places) == 1 else f"{p.name} at {', '.join(at)}"
            rows.append([name, unit or "1", f"{scale * p.nominal:.4g}", ends, p.meaning])
    return rows


def _as_json(entry: Entry) -> dict[str, Any]:
    parameters = [
        {"name": p.name, "unit": p.unit, "nominal": p.nominal, "low": p.low, "high": p.high, "meaning": p.meaning}
        for p in entry.parameters
    ]
    return {
        "effect": entry.name,
        "meaning": entry.meaning,
        "law": entry.law,
        "stage": entry.stage,
        "kinds": list(entry.kinds),
        "at": list(entry.at),
        "begins": entry.begins,
        "parameters": parameters,
        "mistaken_for": list(entry.mistaken_for),
    }
