"""Cases of the blind benchmark: drafts are simulated in one batch, and their sensors are read."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdi_torch.blind.case_drafts import CaseDraft, CasePlan, draft_cases
from fdi_torch.blind.case_readings import PARTS, Lane, noisy_readings, simulated
from fdi_torch.blind.conditions import commands_of_pumps, moved_by
from fdi_torch.blind.deviation import Array
from fdi_torch.blind.networks import Networks
from fdi_torch.blind.plants import Rig
from fdi_torch.blind.simulator import STEP, SimulatedRun

INVISIBLE = 0.03
"""If a cause moves the readings by less than this share of the noise beside the other causes, it is not asked for."""


@dataclass(frozen=True)
class Case:
    """A simulated case; its truth will be sealed.

    commands, readings: of recording and hold-out, (T, C) in the header's unit and (T, S) m.
    """

    plan: CasePlan
    rig: Rig
    commands: tuple[Array, Array]
    readings: tuple[Array, Array]
    truth: dict[str, Any]


def make(
    todo: Sequence[CasePlan],
    rigs: Rig | Networks,
    seed: int,
    library: Collection[str] = (),
    leave_out: Sequence[str] = (),
) -> list[Case]:
    """Make the planned cases, with all rigs simulated in one batch. A case does not depend on the others."""
    drafts = draft_cases(todo, rigs, seed, library, leave_out)
    return [_case(draft, runs) for draft, runs in zip(drafts, _run(drafts), strict=True)]


def _lanes(draft: CaseDraft) -> list[Lane]:
    """The simulations of a case: recording and hold-out with the deviations; both without; the recording without each
    one of several full causes; and, with random flows, the recording without deviations and without random flows.
    """
    c, off = draft.conditions, draft.deviations
    without = [(c, 0, draft.without(k), True) for k in (draft.full if len(draft.full) > 1 else [])]
    undisturbed: list[Lane] = [(c, 0, (), False)] if c.disturbances else []
    return [(c, 0, off, True), (c, 1, off, True), (c, 0, (), True), (c, 1, (), True), *without, *undisturbed]


def _run(drafts: Sequence[CaseDraft]) -> list[list[SimulatedRun]]:
    """The runs of each case in the order of its lanes."""
    lanes = [_lanes(draft) for draft in drafts]
    runs = iter(simulated([lane for case_lanes in lanes for lane in case_lanes], STEP))
    return [[next(runs) for _ in case_lanes] for case_lanes in lanes]


def _case(draft: CaseDraft, runs: Sequence[SimulatedRun]) -> Case:
    """Readings, commands and truth of a case."""
    c, rig, readings, noise_rms, gap_rms = draft.conditions, draft.conditions.rig, [], {}, {}
    for part, (name, _) in enumerate(PARTS):
        noisy, clean = noisy_readings(c, runs[part], part, draft.deviations)
        _, nominal = noisy_readings(c, runs[part + 2], part, ())
        readings.append(noisy)
        noise_rms[name] = (rig.scales.length * np.sqrt(np.mean((noisy - clean) ** 2, axis=0))).tolist()
        gap_rms[name] = rig.scales.length * float(np.sqrt(np.mean((clean - nominal) ** 2)))
    invisible = []
    for k, run in zip(draft.full, runs[4:], strict=False) if len(draft.full) > 1 else ():
        other, _ = noisy_readings(c, run, 0, draft.without(k))
        if np.sqrt(np.mean(((other - readings[0]) / c.noise) ** 2)) < INVISIBLE:
            invisible.append(k)
    highest = np.maximum(*(run.levels.max(axis=0) for run in runs[:2]))
    truth = _truth(draft, invisible) | {
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


def _truth(draft: CaseDraft, invisible: Collection[int]) -> dict[str, Any]:
    """The key of a case. invisible: full causes masked by the others, such as a weir above a level that
    a leak lowers.
    """
    full = [draft.deviations[k] for k in draft.full if k not in invisible]
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
