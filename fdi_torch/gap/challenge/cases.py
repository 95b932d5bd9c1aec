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
from fdi_torch.gap.challenge.kinds import FAINT, KINDS, Chosen, Kind, case_generator, choose
from fdi_torch.gap.challenge.known import KNOWN
from fdi_torch.gap.challenge.laws_sensor import READOUT_LAWS, SENSOR_LAWS
from fdi_torch.gap.challenge.moment import Array, Deviation
from fdi_torch.gap.challenge.plants import Rig
from fdi_torch.gap.challenge.simulator import STEP, HiddenRigs, grouped, simulate
from fdi_torch.gap.challenge.surroundings import Surroundings
from fdi_torch.plant.description import PlantDescription

Off = tuple[Deviation, ...]
"""What is off at a rig."""
HIDDEN = 0.03
"""Share of the noise below which the lack of a cause does not show: it is then not asked for."""
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
    runs = _run(rig, conditions, [_runs_of(KINDS[p.kind], d) for p, d in zip(todo, deviations, strict=True)])
    return [_read(plan, chosen[i], conditions[i], deviations[i], rig, runs[i], seed) for i, plan in enumerate(todo)]


def _conditions(plan: Plan, chosen: Chosen, rig: Rig, seed: int, rest: Array) -> Conditions:
    kind = KINDS[plan.kind]
    rng = case_generator(seed, plan.kind, plan.index, 3)
    resting = channel_to_rest(rig.plant, chosen.place) if chosen.unknown and chosen.unknown.reversing else None
    return draw_conditions(rig, rng, kind.inputs, kind.coloured, rest, resting)


def _deviations(plan: Plan, chosen: Chosen, conditions: Conditions, rig: Rig, sound: Array, seed: int) -> Off:
    kind, asked = KINDS[plan.kind], asked_of_pumps(conditions.built, conditions.commands[0])
    rng = case_generator(seed, plan.kind, plan.index, 4)

    def surroundings(strength: float) -> Surroundings:
        return Surroundings(conditions.built, sound, asked, strength, rng)

    if chosen.unknown:
        return (chosen.unknown.draw(surroundings(kind.strength), chosen.place),)
    strengths = [kind.strength if i < kind.causes else FAINT for i in range(len(chosen.causes))]
    pairs = zip(chosen.causes, strengths, strict=True)
    return tuple(KNOWN[effect](surroundings(strength), place) for (effect, place), strength in pairs)


def _runs_of(kind: Kind, deviations: Off) -> list[tuple[int, Off]]:
    """Which part is run with what: both as the rig is, both with nothing wrong; the recording without each of several
    full causes."""
    without = [(0, (*deviations[:k], *deviations[k + 1 :])) for k in range(kind.causes if kind.causes > 1 else 0)]
    return [(0, deviations), (1, deviations), (0, ()), (1, ()), *without]


def _run(rig: Rig, conditions: Sequence[Conditions], runs: Sequence[Sequence[tuple[int, Off]]]) -> list[Array]:
    """Levels (T, N, runs) m of each case."""
    every = [(c, part, off) for c, own in zip(conditions, runs, strict=True) for part, off in own]
    flows = [asked_of_pumps(c.built, c.commands[part]) for c, part, _ in every]
    asked = np.stack([q[np.minimum(np.arange(RECORDED), len(q) - 1)] for q in flows], axis=-1)
    starts = np.stack([c.starts[part] for c, part, _ in every], axis=-1)
    levels = simulate(HiddenRigs([c.built for c, _, _ in every], [off for _, _, off in every]), asked, starts, STEP)
    return np.split(levels, np.cumsum([len(own) for own in runs])[:-1], axis=-1)


def _read(
    plan: Plan, chosen: Chosen, conditions: Conditions, deviations: Off, rig: Rig, levels: Array, seed: int
) -> Case:
    rng = case_generator(seed, plan.kind, plan.index, 5)
    built, readings, noise_rms, gap_rms, errors = conditions.built, [], {}, {}, []
    for lane, (part, samples) in enumerate(PARTS):
        clean = _sensed(rig, built, levels[:samples, :, lane], deviations)
        sound = _sensed(rig, built, levels[:samples, :, lane + 2], ())
        errors.append(conditions.colour.noise(rng, samples, conditions.noise))
        shown = _applied(READOUT_LAWS, rig, clean + errors[-1], deviations)
        readings.append(shown)
        noise_rms[part] = (rig.scales.length * np.sqrt(np.mean((shown - clean) ** 2, axis=0))).tolist()
        gap_rms[part] = rig.scales.length * float(np.sqrt(np.mean((clean - sound) ** 2)))
    hidden = []
    for k, (_, without) in enumerate(_runs_of(KINDS[plan.kind], deviations)[4:]):
        other = _applied(READOUT_LAWS, rig, _sensed(rig, built, levels[:, :, 4 + k], without) + errors[0], without)
        if np.sqrt(np.mean(((other - readings[0]) / conditions.noise) ** 2)) < HIDDEN:
            hidden.append(k)
    highest = levels[:, :, 0].max(axis=0), levels[: PARTS[1][1], :, 1].max(axis=0)
    truth = _truth(plan, chosen, deviations, hidden) | {
        "noise_rms_m": noise_rms,
        "gap_rms_m": gap_rms,
        "signal": conditions.signal,
        "colour": conditions.colour.name,
        "repeats": conditions.colour.repeats,
        "scales": rig.scales.as_dict(),
        "over_rim": bool((np.array(highest) >= [t.height for t in built.tanks]).any()),
    }
    return Case(plan, conditions.commands, (readings[0], readings[1]), truth)


def _truth(plan: Plan, chosen: Chosen, deviations: Off, hidden: Collection[int]) -> dict[str, Any]:
    """hidden: full causes that the others keep from showing, such as a weir above a level that a leak lowers."""
    full = [d for k, d in enumerate(deviations[: max(KINDS[plan.kind].causes, 1)]) if k not in hidden]
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
