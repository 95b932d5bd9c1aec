"""Makes cases: draws them, runs the hidden rigs in one batch, reads their sensors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdi_torch.gap.challenge.conditions import (
    HELD_OUT,
    RECORDED,
    Conditions,
    asked_of_pumps,
    draw_conditions,
    kept_below_the_rim,
    levels_at_rest,
)
from fdi_torch.gap.challenge.inputs import channel_to_rest
from fdi_torch.gap.challenge.kinds import FAINT, KINDS, Chosen, case_generator, choose
from fdi_torch.gap.challenge.known import KNOWN
from fdi_torch.gap.challenge.laws_sensor import READOUT_LAWS, SENSOR_LAWS
from fdi_torch.gap.challenge.moment import Array, Deviation
from fdi_torch.gap.challenge.plants import Rig
from fdi_torch.gap.challenge.simulator import STEP, HiddenRigs, grouped, simulate
from fdi_torch.gap.challenge.surroundings import Surroundings
from fdi_torch.plant.description import PlantDescription

PARTS = (("recording", RECORDED), ("holdout", HELD_OUT))


@dataclass(frozen=True)
class Plan:
    """Which case: `index` counts within its kind, `number` within the challenge."""

    number: int
    kind: str
    index: int

    @property
    def name(self) -> str:
        return f"case{self.number + 1:04d}"


@dataclass(frozen=True)
class Case:
    """A case as it was made; its truth goes under seal.

    commands, readings: of recording and hold-out, (T, C) in the header's unit and (T, S) m.
    """

    plan: Plan
    commands: tuple[Array, Array]
    readings: tuple[Array, Array]
    truth: dict[str, Any]


def plans(cases: int, seed: int, kinds: Sequence[str]) -> list[Plan]:
    """Kinds in turn, in an order shuffled anew each round, so that a case's number does not give its kind away."""
    strange = [k for k in kinds if k not in KINDS]
    if strange or not kinds:
        raise ValueError(
            f"expected kinds among {', '.join(KINDS)}, got {', '.join(strange) or 'none'}; name some of these"
        )
    out = []
    for number in range(cases):
        turn, at = divmod(number, len(kinds))
        order = case_generator(seed, "order", turn).permutation(len(kinds))
        out.append(Plan(number, kinds[int(order[at])], turn))
    return out


def make(
    todo: Sequence[Plan], rig: Rig, seed: int, library: Collection[str] = (), leave_out: Sequence[str] = ()
) -> list[Case]:
    """The cases of these plans, all rigs in one batch. A case is the same in whatever company it is made."""
    rest = levels_at_rest(rig)
    chosen = [choose(KINDS[p.kind], rig, seed, p.index, library, leave_out) for p in todo]
    drawn = [_conditions(p, c, rig, seed, rest) for p, c in zip(todo, chosen, strict=True)]
    conditions, sound = kept_below_the_rim(rig, drawn)
    deviations = [_deviations(plan, chosen[i], conditions[i], rig, sound[:, :, i], seed) for i, plan in enumerate(todo)]
    levels = _run(rig, conditions, deviations)
    return [
        _read(plan, chosen[i], conditions[i], deviations[i], rig, levels[:, :, 4 * i : 4 * i + 4], seed)
        for i, plan in enumerate(todo)
    ]


def _conditions(plan: Plan, chosen: Chosen, rig: Rig, seed: int, rest: Array) -> Conditions:
    kind = KINDS[plan.kind]
    rng = case_generator(seed, plan.kind, plan.index, 3)
    resting = channel_to_rest(rig.plant, chosen.place) if chosen.unknown and chosen.unknown.reversing else None
    return draw_conditions(rig, rng, kind.inputs, kind.coloured, rest, resting)


def _deviations(
    plan: Plan, chosen: Chosen, conditions: Conditions, rig: Rig, sound: Array, seed: int
) -> tuple[Deviation, ...]:
    kind, asked = KINDS[plan.kind], asked_of_pumps(conditions.built, conditions.commands[0])
    rng = case_generator(seed, plan.kind, plan.index, 4)

    def surroundings(strength: float) -> Surroundings:
        return Surroundings(conditions.built, sound, asked, strength, rng)

    if chosen.unknown:
        return (chosen.unknown.draw(surroundings(kind.strength), chosen.place),)
    strengths = [kind.strength if i < kind.causes else FAINT for i in range(len(chosen.causes))]
    pairs = zip(chosen.causes, strengths, strict=True)
    return tuple(KNOWN[effect](surroundings(strength), place) for (effect, place), strength in pairs)


def _run(rig: Rig, conditions: Sequence[Conditions], deviations: Sequence[tuple[Deviation, ...]]) -> Array:
    """Levels (T, N, 4 cases) m: recording and hold-out of the rig as it is, then of the same rig with nothing wrong."""
    asked = np.empty((RECORDED, len(rig.plant.pumps), 4 * len(conditions)))
    starts, built, lanes = [], [], []
    for i, c in enumerate(conditions):
        for j, commands in enumerate((*c.commands, *c.commands)):
            flow = asked_of_pumps(c.built, commands)
            asked[:, :, 4 * i + j] = flow[np.minimum(np.arange(RECORDED), len(flow) - 1)]
        starts += [c.starts[0], c.starts[1]] * 2
        built += [c.built] * 4
        lanes += [deviations[i]] * 2 + [()] * 2
    return simulate(HiddenRigs(built, lanes), asked, np.stack(starts, axis=-1), STEP)


def _read(
    plan: Plan,
    chosen: Chosen,
    conditions: Conditions,
    deviations: tuple[Deviation, ...],
    rig: Rig,
    levels: Array,
    seed: int,
) -> Case:
    rng = case_generator(seed, plan.kind, plan.index, 5)
    readings, noise_rms, gap_rms, highest = [], {}, {}, []
    for lane, (part, samples) in enumerate(PARTS):
        clean = _sensed(rig, conditions.built, levels[:samples, :, lane], deviations)
        sound = _sensed(rig, conditions.built, levels[:samples, :, lane + 2], ())
        noisy = clean + conditions.colour.noise(rng, samples, conditions.noise)
        shown = _applied(READOUT_LAWS, rig, noisy, deviations)
        readings.append(shown)
        noise_rms[part] = np.sqrt(np.mean((shown - clean) ** 2, axis=0)).tolist()
        gap_rms[part] = float(np.sqrt(np.mean((clean - sound) ** 2)))
        highest.append(levels[:samples, :, lane].max(axis=0))
    truth = _truth(plan, chosen, deviations) | {
        "noise_rms_m": noise_rms,
        "gap_rms_m": gap_rms,
        "signal": conditions.signal,
        "colour": conditions.colour.name,
        "repeats": conditions.colour.repeats,
        "over_rim": bool((np.array(highest) >= [t.height for t in conditions.built.tanks]).any()),
    }
    return Case(plan, conditions.commands, (readings[0], readings[1]), truth)


def _truth(plan: Plan, chosen: Chosen, deviations: tuple[Deviation, ...]) -> dict[str, Any]:
    kind = KINDS[plan.kind]
    full = deviations[: max(kind.causes, 1)]
    really = {"really": chosen.unknown.law} if chosen.unknown else {}
    return {
        "case": plan.name,
        "kind": plan.kind,
        "index": plan.index,
        "causes": [{"effect": d.effect, "location": d.location} | really for d in full],
        "leave_out": list(chosen.leave_out),
        "deviations": [d.as_dict() for d in deviations],
    }


def _sensed(rig: Rig, built: PlantDescription, levels: Array, deviations: Sequence[Deviation]) -> Array:
    """(T, N) m -> (T, S) m: the level that each reading stands for by what is believed of its sensor."""
    tanks = [t.name for t in rig.plant.tanks]
    shown = _applied(SENSOR_LAWS, rig, levels[:, [tanks.index(s.tank) for s in rig.plant.sensors]], deviations)
    pairs = list(zip(built.sensors, rig.plant.sensors, strict=True))
    gain = np.array([true.gain / believed.gain for true, believed in pairs])
    return shown * gain + np.array([(true.offset - believed.offset) / believed.gain for true, believed in pairs])


def _applied(laws: Any, rig: Rig, signal: Array, deviations: Sequence[Deviation]) -> Array:
    """Each of these laws that is at work, at its sensor. signal (T, S)."""
    time, out = np.arange(len(signal), dtype=np.float64), signal.copy()
    for group in grouped(laws, [s.name for s in rig.plant.sensors], [tuple(deviations)]):
        out[:, group.rows] = group.law(out[:, group.rows], time, group.numbers)
    return out
