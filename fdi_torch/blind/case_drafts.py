"""Drafts of cases: conditions and causes are drawn, but the rig has not been simulated yet."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdi_torch.blind.case_causes import Chosen, case_generator, choose
from fdi_torch.blind.case_readings import PARTS, noisy_readings
from fdi_torch.blind.conditions import (
    COARSE,
    Conditions,
    Deviations,
    controlled,
    disturbed,
    draw_conditions,
    kept_within,
    levels_at_rest,
    nominal_runs,
    simulated,
)
from fdi_torch.blind.deviation import Array
from fdi_torch.blind.inputs import channel_to_rest
from fdi_torch.blind.kinds import FAINT, KINDS, Kind
from fdi_torch.blind.named_effects import NominalRun, draw_effect
from fdi_torch.blind.networks import Networks, with_unmeasured
from fdi_torch.blind.plants import Rig
from fdi_torch.blind.random_flows import draw_disturbance
from fdi_torch.blind.simulator import SimulatedRun

VISIBLE = 0.5
"""A cause is visible if, without it, some reading moves by this root mean square, in units of the noise including that
of random flows."""
MOST_DRAWS = 8
"""Number of draws of the causes of one case, after which they are kept although one is not visible."""


@dataclass(frozen=True)
class CasePlan:
    """Which case to make. number: within the benchmark; index: within its kind."""

    number: int
    kind: str
    index: int

    @property
    def name(self) -> str:
        return f"case{self.number + 1:04d}"


@dataclass(frozen=True)
class CaseDraft:
    """A case before its simulation. nominal: coarse run of the recording without any effect or disturbance."""

    plan: CasePlan
    conditions: Conditions
    nominal: SimulatedRun
    chosen: Chosen
    deviations: Deviations = ()
    shows: bool = True

    @property
    def kind(self) -> Kind:
        return KINDS[self.plan.kind]

    @property
    def full(self) -> list[int]:
        """Indices of the deviations that are full causes, not faint ones."""
        faint = range(self.chosen.full, len(self.chosen.causes))
        return [k for k in range(len(self.deviations)) if k not in faint]

    def without(self, k: int) -> Deviations:
        return (*self.deviations[:k], *self.deviations[k + 1 :])


def plans(cases: int, seed: int, kinds: Sequence[str]) -> list[CasePlan]:
    """Plans of cases: rounds with one case of each kind, in random order, so that a number does not reveal its kind."""
    unknown = [k for k in kinds if k not in KINDS]
    if unknown or not kinds:
        raise ValueError(
            f"expected kinds among {', '.join(KINDS)}, got {', '.join(unknown) or 'none'}; name some of these"
        )
    result = []
    for number in range(cases):
        turn, position = divmod(number, len(kinds))
        order = case_generator(seed, "order", turn).permutation(len(kinds))
        result.append(CasePlan(number, kinds[int(order[position])], turn))
    return result


def draft_cases(
    todo: Sequence[CasePlan], rigs: Rig | Networks, seed: int, library: Collection[str], leave_out: Sequence[str]
) -> list[CaseDraft]:
    """Draw rigs, conditions and causes of the planned cases."""
    case_rigs = [_rig(plan, rigs, seed) for plan in todo]
    rest = _equilibria(case_rigs)
    chosen = [
        choose(KINDS[p.kind], rig, seed, p.index, library, leave_out) for p, rig in zip(todo, case_rigs, strict=True)
    ]
    conditions = kept_within([_conditions(*each, seed) for each in zip(todo, case_rigs, chosen, rest, strict=True)])
    conditions, nominal = _with_level_control(todo, conditions, seed)
    conditions = _with_random_flows(todo, conditions, seed)
    drafts = [CaseDraft(*each) for each in zip(todo, conditions, nominal, chosen, strict=True)]
    return _with_visible_causes([_with_sizes(d, d.chosen, seed) for d in drafts], seed, library, leave_out)


def _rig(plan: CasePlan, rigs: Rig | Networks, seed: int) -> Rig:
    rig = rigs.rig(case_generator(seed, plan.kind, plan.index, 6)) if isinstance(rigs, Networks) else rigs
    share = KINDS[plan.kind].unmeasured
    return with_unmeasured(rig, share, case_generator(seed, plan.kind, plan.index, 7)) if share else rig


def _equilibria(rigs: Sequence[Rig]) -> list[Array]:
    """Equilibrium levels of each rig, computed once for each plant."""
    computed = {key: levels_at_rest(rig) for key, rig in {id(rig.plant.tanks): rig for rig in rigs}.items()}
    return [computed[id(rig.plant.tanks)] for rig in rigs]


def _conditions(plan: CasePlan, rig: Rig, chosen: Chosen, rest: Array, seed: int) -> Conditions:
    kind = KINDS[plan.kind]
    rng = case_generator(seed, plan.kind, plan.index, 3)
    resting = channel_to_rest(rig.plant, chosen.place) if chosen.unknown and chosen.unknown.reversing else None
    drawn = draw_conditions(rig, rng, kind.inputs, kind.coloured, rest, resting)
    rng = case_generator(seed, plan.kind, plan.index, 5)
    return replace(drawn, errors=tuple(drawn.correlation.noise(rng, samples, drawn.noise) for _, samples in PARTS))


def _with_level_control(
    todo: Sequence[CasePlan], conditions: Sequence[Conditions], seed: int
) -> tuple[list[Conditions], list[SimulatedRun]]:
    """The conditions with a level control where the kind asks for it, and nominal runs of the recordings."""
    result, nominal = list(conditions), nominal_runs(conditions, 0)
    looped = [i for i, plan in enumerate(todo) if KINDS[plan.kind].looped]
    held_out = nominal_runs([conditions[i] for i in looped], 1)
    for i, other in zip(looped, held_out, strict=True):
        result[i] = controlled(result[i], case_generator(seed, todo[i].kind, todo[i].index, 8), (nominal[i], other))
    for i, run in zip(looped, nominal_runs([result[i] for i in looped], 0), strict=True):
        nominal[i] = run
    return result, nominal


def _with_random_flows(todo: Sequence[CasePlan], conditions: Sequence[Conditions], seed: int) -> list[Conditions]:
    """The conditions with random disturbance flows where the kind asks for them."""
    result = list(conditions)
    rows = [i for i, plan in enumerate(todo) if KINDS[plan.kind].disturbed]
    generators = [case_generator(seed, todo[i].kind, todo[i].index, 9) for i in rows]
    flows = [draw_disturbance(rng, len(result[i].rig.plant.tanks)) for i, rng in zip(rows, generators, strict=True)]
    for i, changed in zip(rows, disturbed([result[i] for i in rows], flows, generators), strict=True):
        result[i] = changed
    return result


def _with_sizes(draft: CaseDraft, chosen: Chosen, seed: int, trial: int = 0) -> CaseDraft:
    """The draft with the sizes of the chosen causes drawn."""
    rng = case_generator(seed, draft.plan.kind, draft.plan.index, 4, *([trial] if trial else []))
    built, nominal = draft.conditions.built, draft.nominal

    def nominal_run(strength: float) -> NominalRun:
        return NominalRun(built, nominal.levels, nominal.asked, strength, rng)

    strengths = [draft.kind.strength if i < chosen.full else FAINT for i in range(len(chosen.causes))]
    pairs = zip(chosen.causes, strengths, strict=True)
    deviations = tuple(draw_effect(effect, nominal_run(strength), place) for (effect, place), strength in pairs)
    if chosen.unknown:
        deviations += (chosen.unknown.draw(nominal_run(draft.kind.strength), chosen.place),)
    return replace(draft, chosen=chosen, deviations=deviations)


def _with_visible_causes(
    drafts: Sequence[CaseDraft], seed: int, library: Collection[str], leave_out: Sequence[str]
) -> list[CaseDraft]:
    """Draw causes again where the kind requires visible ones and they are not."""
    result = list(drafts)
    todo = [i for i, draft in enumerate(result) if draft.kind.shows]
    for trial in range(1, MOST_DRAWS + 1):
        todo = [i for i, visible in zip(todo, _all_visible([result[i] for i in todo]), strict=True) if not visible]
        for i in todo:
            if trial == MOST_DRAWS:
                result[i] = replace(result[i], shows=False)
                continue
            draft = result[i]
            about = (draft.kind, draft.conditions.rig, seed, draft.plan.index)
            result[i] = _with_sizes(draft, choose(*about, library, leave_out, trial), seed, trial)
    return result


def _all_visible(drafts: Sequence[CaseDraft]) -> list[bool]:
    """Whether every full cause of a draft is visible, by coarse runs with and without it."""
    sets = [[d.deviations, *(d.without(k) for k in d.full)] for d in drafts]
    runs = simulated(
        [(d.conditions, 0, off, False) for d, variants in zip(drafts, sets, strict=True) for off in variants], COARSE
    )
    result, first = [], 0
    for draft, variants in zip(drafts, sets, strict=True):
        part = runs[first : first + len(variants)]
        readings = [noisy_readings(draft.conditions, run, 0, off)[0] for run, off in zip(part, variants, strict=True)]
        first += len(variants)
        c = draft.conditions
        scale = c.noise * np.hypot(1.0, c.disturbance.ratio if c.disturbance else 0.0)
        moved = [np.sqrt(np.mean(((other - readings[0]) / scale) ** 2, axis=0)).max() for other in readings[1:]]
        result.append(bool(min(moved) > VISIBLE))
    return result
