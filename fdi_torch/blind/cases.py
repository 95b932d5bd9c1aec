"""Makes cases: draws them, runs the hidden rigs in one batch, reads their sensors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fdi_torch.blind.case_kinds import FAINT, KINDS, Chosen, Kind, case_generator, choose
from fdi_torch.blind.conditions import (
    COARSE,
    HELD_OUT,
    RECORDED,
    Conditions,
    commands_of_pumps,
    controlled,
    disturbed,
    draw_conditions,
    kept_within,
    levels_at_rest,
    moved_by,
    nominal_runs,
)
from fdi_torch.blind.deviation import Array, Deviation
from fdi_torch.blind.inputs import channel_to_rest
from fdi_torch.blind.laws_sensor import READOUT_LAWS, SENSOR_LAWS
from fdi_torch.blind.named_effects import NAMED
from fdi_torch.blind.networks import Networks, with_unmeasured
from fdi_torch.blind.nominal_run import NominalRun
from fdi_torch.blind.plants import Rig
from fdi_torch.blind.random_flows import draw_disturbance
from fdi_torch.blind.simulator import STEP, HiddenRigs, SimulatedRun, grouped, simulate
from fdi_torch.plant.description import PlantDescription

Off = tuple[Deviation, ...]
"""What is off at a rig."""
HIDDEN = 0.03
"""Share of the noise below which the lack of a cause does not show: it is then not asked for."""
SHOWS = 0.5
"""Root mean square, over noise and what random flows move, of the reading that a cause moves most: it then shows."""
MOST_TRIALS = 8
PARTS = (("recording", RECORDED), ("holdout", HELD_OUT))


@dataclass(frozen=True)
class CasePlan:
    """Which case: `index` counts within its kind, `number` within the benchmark."""

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

    plan: CasePlan
    rig: Rig
    commands: tuple[Array, Array]
    readings: tuple[Array, Array]
    truth: dict[str, Any]


@dataclass(frozen=True)
class CaseDraft:
    """A case whose rig has not run yet. nominal: the recording without any effect and disturbance."""

    plan: CasePlan
    conditions: Conditions
    nominal: SimulatedRun
    chosen: Chosen
    deviations: Off = ()
    shows: bool = True

    @property
    def kind(self) -> Kind:
        return KINDS[self.plan.kind]

    @property
    def full(self) -> list[int]:
        """Which of the deviations are full causes."""
        faint = range(self.chosen.full, len(self.chosen.causes))
        return [k for k in range(len(self.deviations)) if k not in faint]

    def without(self, k: int) -> Off:
        return (*self.deviations[:k], *self.deviations[k + 1 :])


def plans(cases: int, seed: int, kinds: Sequence[str]) -> list[CasePlan]:
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
        out.append(CasePlan(number, kinds[int(order[at])], turn))
    return out


def make(
    todo: Sequence[CasePlan],
    rigs: Rig | Networks,
    seed: int,
    library: Collection[str] = (),
    leave_out: Sequence[str] = (),
) -> list[Case]:
    """The cases of these plans, all rigs in one batch. A case is the same in whatever company it is made."""
    own = [_rig(plan, rigs, seed) for plan in todo]
    rest = _rests(own)
    chosen = [choose(KINDS[p.kind], rig, seed, p.index, library, leave_out) for p, rig in zip(todo, own, strict=True)]
    conditions = kept_within([_conditions(*each, seed) for each in zip(todo, own, chosen, rest, strict=True)])
    conditions, nominal = _looped(todo, conditions, seed)
    conditions = _disturbed(todo, conditions, seed)
    drafts = [CaseDraft(*each) for each in zip(todo, conditions, nominal, chosen, strict=True)]
    drafts = _shown([_drawn(d, d.chosen, seed) for d in drafts], seed, library, leave_out)
    return [_read(draft, runs) for draft, runs in zip(drafts, _run(drafts), strict=True)]


def _rig(plan: CasePlan, rigs: Rig | Networks, seed: int) -> Rig:
    rig = rigs.rig(case_generator(seed, plan.kind, plan.index, 6)) if isinstance(rigs, Networks) else rigs
    share = KINDS[plan.kind].unmeasured
    return with_unmeasured(rig, share, case_generator(seed, plan.kind, plan.index, 7)) if share else rig


def _rests(rigs: Sequence[Rig]) -> list[Array]:
    """Levels at rest of each; rigs of one plant rest alike."""
    known: dict[int, Array] = {}
    for rig in rigs:
        known.setdefault(id(rig.plant.tanks), levels_at_rest(rig))
    return [known[id(rig.plant.tanks)] for rig in rigs]


def _conditions(plan: CasePlan, rig: Rig, chosen: Chosen, rest: Array, seed: int) -> Conditions:
    kind = KINDS[plan.kind]
    rng = case_generator(seed, plan.kind, plan.index, 3)
    resting = channel_to_rest(rig.plant, chosen.place) if chosen.unknown and chosen.unknown.reversing else None
    drawn = draw_conditions(rig, rng, kind.inputs, kind.coloured, rest, resting)
    rng = case_generator(seed, plan.kind, plan.index, 5)
    return replace(drawn, errors=tuple(drawn.correlation.noise(rng, samples, drawn.noise) for _, samples in PARTS))


def _looped(
    todo: Sequence[CasePlan], conditions: Sequence[Conditions], seed: int
) -> tuple[list[Conditions], list[SimulatedRun]]:
    """Closes the loop of those that have one; with each recording without any effect."""
    out, nominal = list(conditions), nominal_runs(conditions, 0)
    looped = [i for i, plan in enumerate(todo) if KINDS[plan.kind].looped]
    held_out = nominal_runs([conditions[i] for i in looped], 1)
    for i, other in zip(looped, held_out, strict=True):
        out[i] = controlled(out[i], case_generator(seed, todo[i].kind, todo[i].index, 8), (nominal[i], other))
    for i, ran in zip(looped, nominal_runs([out[i] for i in looped], 0), strict=True):
        nominal[i] = ran
    return out, nominal


def _disturbed(todo: Sequence[CasePlan], conditions: Sequence[Conditions], seed: int) -> list[Conditions]:
    out = list(conditions)
    some = [i for i, plan in enumerate(todo) if KINDS[plan.kind].disturbed]
    generators = [case_generator(seed, todo[i].kind, todo[i].index, 9) for i in some]
    found = [draw_disturbance(rng, len(out[i].rig.plant.tanks)) for i, rng in zip(some, generators, strict=True)]
    for i, changed in zip(some, disturbed([out[i] for i in some], found, generators), strict=True):
        out[i] = changed
    return out


def _drawn(draft: CaseDraft, chosen: Chosen, seed: int, trial: int = 0) -> CaseDraft:
    """With the numbers of its causes."""
    rng = case_generator(seed, draft.plan.kind, draft.plan.index, 4, *([trial] if trial else []))
    built, nominal = draft.conditions.built, draft.nominal

    def around(strength: float) -> NominalRun:
        return NominalRun(built, nominal.levels, nominal.asked, strength, rng)

    strengths = [draft.kind.strength if i < chosen.full else FAINT for i in range(len(chosen.causes))]
    pairs = zip(chosen.causes, strengths, strict=True)
    deviations = tuple(NAMED[effect](around(strength), place) for (effect, place), strength in pairs)
    if chosen.unknown:
        deviations += (chosen.unknown.draw(around(draft.kind.strength), chosen.place),)
    return replace(draft, chosen=chosen, deviations=deviations)


def _shown(
    drafts: Sequence[CaseDraft], seed: int, library: Collection[str], leave_out: Sequence[str]
) -> list[CaseDraft]:
    """Draws the causes anew of those that have to show and do not."""
    out = list(drafts)
    todo = [i for i, draft in enumerate(out) if draft.kind.shows]
    for trial in range(1, MOST_TRIALS + 1):
        todo = [i for i, shows in zip(todo, _all_show([out[i] for i in todo]), strict=True) if not shows]
        for i in todo:
            if trial == MOST_TRIALS:
                out[i] = replace(out[i], shows=False)
                continue
            draft = out[i]
            about = (draft.kind, draft.conditions.rig, seed, draft.plan.index)
            out[i] = _drawn(draft, choose(*about, library, leave_out, trial), seed, trial)
    return out


def _all_show(drafts: Sequence[CaseDraft]) -> list[bool]:
    """Whether the lack of any full cause moves some reading by `SHOWS`, in coarse runs."""
    if not drafts:
        return []
    sets = [[d.deviations, *(d.without(k) for k in d.full)] for d in drafts]
    runs = _simulated(
        [(d.conditions, 0, off, False) for d, own in zip(drafts, sets, strict=True) for off in own], COARSE
    )
    found, at = [], 0
    for draft, own in zip(drafts, sets, strict=True):
        shown = [_readings(draft, ran, 0, off)[0] for ran, off in zip(runs[at : at + len(own)], own, strict=True)]
        at += len(own)
        c = draft.conditions
        scale = c.noise * np.hypot(1.0, c.disturbance.ratio if c.disturbance else 0.0)
        moved = [np.sqrt(np.mean(((other - shown[0]) / scale) ** 2, axis=0)).max() for other in shown[1:]]
        found.append(bool(min(moved) > SHOWS))
    return found


def _lanes(draft: CaseDraft) -> list[tuple[Conditions, int, Off, bool]]:
    """Which part is run with what: both as the rig is, both without any effect; the recording without each of several
    full causes; the recording without any effect and undisturbed, where flows are disturbed.
    """
    c, off = draft.conditions, draft.deviations
    without = [(c, 0, draft.without(k), True) for k in (draft.full if len(draft.full) > 1 else [])]
    undisturbed: list[tuple[Conditions, int, Off, bool]] = [(c, 0, (), False)] if c.disturbances else []
    return [(c, 0, off, True), (c, 1, off, True), (c, 0, (), True), (c, 1, (), True), *without, *undisturbed]


def _run(drafts: Sequence[CaseDraft]) -> list[list[SimulatedRun]]:
    """The runs of each case, a lane each."""
    lanes = [_lanes(draft) for draft in drafts]
    runs = iter(_simulated([lane for own in lanes for lane in own], STEP))
    return [[next(runs) for _ in own] for own in lanes]


def _simulated(lanes: Sequence[tuple[Conditions, int, Off, bool]], step: float) -> list[SimulatedRun]:
    rigs = HiddenRigs([c.built for c, *_ in lanes], [off for _, _, off, _ in lanes])
    return simulate(rigs, [c.drive(part, disturbed) for c, part, _, disturbed in lanes], step)


def _readings(draft: CaseDraft, ran: SimulatedRun, part: int, off: Off) -> tuple[Array, Array]:
    """Readings with noise, and without noise and readout, (T, S) m each."""
    c = draft.conditions
    clean = _sensed(c.rig, c.built, ran.levels, off)
    return _applied(READOUT_LAWS, c.rig, clean + c.errors[part], off), clean


def _read(draft: CaseDraft, runs: Sequence[SimulatedRun]) -> Case:
    c, rig, readings, noise_rms, gap_rms = draft.conditions, draft.conditions.rig, [], {}, {}
    for part, (name, _) in enumerate(PARTS):
        shown, clean = _readings(draft, runs[part], part, draft.deviations)
        _, sound = _readings(draft, runs[part + 2], part, ())
        readings.append(shown)
        noise_rms[name] = (rig.scales.length * np.sqrt(np.mean((shown - clean) ** 2, axis=0))).tolist()
        gap_rms[name] = rig.scales.length * float(np.sqrt(np.mean((clean - sound) ** 2)))
    hidden = []
    for k, ran in zip(draft.full, runs[4:], strict=False) if len(draft.full) > 1 else ():
        other, _ = _readings(draft, ran, 0, draft.without(k))
        if np.sqrt(np.mean(((other - readings[0]) / c.noise) ** 2)) < HIDDEN:
            hidden.append(k)
    highest = np.maximum(*(ran.levels.max(axis=0) for ran in runs[:2]))
    truth = _truth(draft, hidden) | {
        "noise_rms_m": noise_rms,
        "gap_rms_m": gap_rms,
        "signal": c.signal,
        "colour": c.correlation.name,
        "repeats": c.correlation.repeats,
        "scales": rig.scales.as_dict(),
        "over_rim": bool((highest >= [t.height for t in c.built.tanks]).any()),
    }
    if c.disturbance:
        moved = moved_by(c, runs[2].levels, runs[-1].levels)
        truth["disturbance"] = c.disturbance.as_dict() | {"moves_levels_by_noise": moved}
    if c.control:
        truth["control"] = {"law": c.control[0].law, "pump": rig.plant.pumps[c.control[0].pump].name}
    if not draft.shows:
        truth["shows"] = False
    commands = c.commands
    if c.control:
        asked = (runs[part].asked for part in (0, 1))
        commands = tuple(commands_of_pumps(c.built, q) for q in asked)  # type: ignore[assignment]
    return Case(draft.plan, rig, commands, (readings[0], readings[1]), truth)


def _truth(draft: CaseDraft, hidden: Collection[int]) -> dict[str, Any]:
    """hidden: full causes that the others keep from showing, such as a weir above a level that a leak lowers."""
    full = [draft.deviations[k] for k in draft.full if k not in hidden]
    return {
        "case": draft.plan.name,
        "kind": draft.plan.kind,
        "index": draft.plan.index,
        "causes": [
            {"effect": d.effect, "location": d.location} | ({"really": d.law} if d.effect == "unknown" else {})
            for d in full
        ],
        "leave_out": list(draft.chosen.leave_out),
        "deviations": [d.as_dict() for d in draft.deviations],
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
    for group in grouped(laws, [[s.name for s in rig.plant.sensors]], [tuple(deviations)]):
        out[:, group.spot] = group.law(out[:, group.spot], time, group.numbers)
    return out
