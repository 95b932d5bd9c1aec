"""The kinds of cases (strata), and which causes a case of each kind gets: names and places only, before any number."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from fdi_torch.gap.challenge.places import EFFECTS, TWINS, Cause, are_twins, canonical, effect_places, places
from fdi_torch.gap.challenge.plants import Rig
from fdi_torch.gap.challenge.unknown import Unknown, unknown_to
from fdi_torch.plant.description import PlantDescription


@dataclass(frozen=True)
class Kind:
    """strength of its full effects (1 is usual). causes: how many. faint: how many more at an eighth of usual strength.

    inputs: as in `draw_conditions`. coloured: chance of coloured noise.
    """

    name: str
    strength: float = 1.0
    causes: int = 1
    faint: int = 0
    inputs: str = "rich"
    coloured: float = 0.0


FAINT = 0.125
KINDS = {
    kind.name: kind
    for kind in (
        Kind("single"),
        Kind("weak", strength=0.2),
        Kind("coloured", coloured=1.0),
        Kind("null", causes=0, coloured=0.3),
        Kind("pair", causes=2),
        Kind("unknown"),
        Kind("messy", faint=3),
        Kind("poor", inputs="poor"),
        Kind("twins", strength=0.6),
        Kind("left_out"),
    )
}
STANDARD = tuple(name for name in KINDS if name != "left_out")


@dataclass(frozen=True)
class Chosen:
    """What is wrong with a rig, by name: full causes, then faint ones; or an effect that no library names."""

    causes: tuple[Cause, ...] = ()
    unknown: Unknown | None = None
    place: str = ""
    leave_out: tuple[str, ...] = ()


def case_generator(seed: int, kind: str, index: int, *more: int) -> np.random.Generator:
    """The generator of one case: it depends on no other case, nor on how many there are."""
    return np.random.default_rng([seed, zlib.crc32(kind.encode()), index, *more])


def in_turn(items: Sequence[str], seed: int, kind: str, index: int) -> str:
    """Item of this index in a sequence of shuffled rounds, so that all come up equally often."""
    turn, at = divmod(index, len(items))
    order = case_generator(seed, kind, turn, 1).permutation(len(items))
    return items[int(order[at])]


def choose(kind: Kind, rig: Rig, seed: int, index: int, library: Collection[str], leave_out: Sequence[str]) -> Chosen:
    """The causes of case `index` of this kind."""
    rng, plant = case_generator(seed, kind.name, index, 2), rig.plant
    if kind.name == "unknown":
        return _unknown(plant, seed, index, library, rng)
    if kind.name == "twins":
        return Chosen((_twin(plant, index, rng),))
    if kind.name == "left_out":
        return _left_out(plant, seed, index, leave_out, rng)
    causes: list[Cause] = []
    if kind.causes:
        present = [e for e in EFFECTS if places(plant, EFFECTS[e])]
        effect = in_turn(present, seed, kind.name, index)
        causes.append((effect, str(rng.choice(places(plant, EFFECTS[effect])))))
    while len(causes) < kind.causes + kind.faint:
        causes.append(_another(plant, causes, rng))
    return Chosen(tuple(causes))


def _another(plant: PlantDescription, causes: Sequence[Cause], rng: np.random.Generator) -> Cause:
    """A further cause: another effect, and not a twin of one that is there."""
    free = [c for c in effect_places(plant) if all(c[0] != o[0] and not are_twins(c, o, plant) for o in causes)]
    return free[int(rng.integers(len(free)))]


def _unknown(
    plant: PlantDescription, seed: int, index: int, library: Collection[str], rng: np.random.Generator
) -> Chosen:
    found = {u.law: u for u in unknown_to(library) if places(plant, u.at)}
    if not any(not p.is_outlet for p in plant.pipes):
        found = {name: u for name, u in found.items() if not u.reversing}
    unknown = found[in_turn(sorted(found), seed, "unknown", index)]
    return Chosen(unknown=unknown, place=str(rng.choice(places(plant, unknown.at))))


def _twin(plant: PlantDescription, index: int, rng: np.random.Generator) -> Cause:
    families = [(effects, places(plant, (at,))) for effects, at in TWINS if places(plant, (at,))]
    effects, at = families[index % len(families)]
    return str(rng.choice(effects)), str(rng.choice(at))


def _left_out(
    plant: PlantDescription, seed: int, index: int, leave_out: Sequence[str], rng: np.random.Generator
) -> Chosen:
    """An effect the diagnosis is denied, where nothing left is the same thing under another name."""
    alike = {canonical(c, plant) for c in effect_places(plant) if canonical(c, plant) != c}
    found = {e: places(plant, EFFECTS.get(e, ())) for e in leave_out}
    free = {e: [p for p in at if canonical((e, p), plant) not in alike] for e, at in found.items()}
    possible = [e for e in leave_out if free[e]]
    if not possible:
        raise ValueError("expected an effect to leave out that has a place in this plant, got none; name one")
    effect = in_turn(possible, seed, "left_out", index)
    return Chosen(((effect, str(rng.choice(free[effect]))),), leave_out=(effect,))
