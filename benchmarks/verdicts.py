"""Studies of the gap diagnosis on cases of the blind benchmark that no table of the docs contains.

    python -m benchmarks.verdicts --kinds dnull --cases 30 --seed 7 --seconds 300 --out DIR
    python -m benchmarks.verdicts --descents DIR

The first form diagnoses sealed cases whose recordings are cut to the first --seconds. The second form opens the key of
a folder, also one of `fdi challenge`, and asks whether the fits of single effects reached their minimum: each is
compared with the best of 20 descents from other starts, the truth among them. Rows are kept in the folder as JSON
lines, and counts are printed with exact 95 % intervals.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fdi_torch.blind.benchmark import blind_benchmark
from fdi_torch.blind.cases import lines_of, manifest, open_key, read_plant, read_recording
from fdi_torch.blind.plants import RIGS, Scales
from fdi_torch.blind.scored_rows import scores_of
from fdi_torch.blind.sizes import COMPARABLE
from fdi_torch.blind.statistics import clopper_pearson
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.diagnose import diagnose, recalibrate
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.library import STANDARD as LIBRARY
from fdi_torch.gap.problem import Settings, problem_of
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.screening import Option, options_of
from fdi_torch.gap.structure_search import search
from fdi_torch.logbook.provenance import git_state
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.operating_range import operating_range_of_all, with_simulated_levels
from fdi_torch.recording import Recording

STARTS = 20
REACHED = 0.5
"""Chi-square above the best descent that counts as reached."""


def diagnosis(
    plant: PlantDescription,
    recording: Recording,
    holdout: Recording,
    leave_out: Sequence[str] = (),
    seconds: float = float("inf"),
) -> dict[str, Any]:
    """Diagnose the first `seconds` of a recording."""
    cut = recording.window(stop=seconds)
    return diagnose(plant, cut, holdout, Settings(leave_out=tuple(leave_out))).to_dict()


def excess_of(plant: PlantDescription, recording: Recording, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Chi-square of the fitted true effect above the best of STARTS descents. Empty if the search did not fit it."""
    problem = problem_of(plant, (recording,), (), Settings())
    fitter, null, _ = recalibrate(problem.data)
    reach = with_simulated_levels(operating_range_of_all(problem.recordings, plant), plant, null.linearised.levels[0])
    options = options_of([p for p in problem.library if not p.effect.quantizes], fitter, reach)
    pool = ExplanationPool(fitter, null, len(problem.library))
    search(pool, options, most=1)
    (cause,) = truth["causes"]
    key = frozenset([(cause["effect"], cause["location"])])
    if key not in pool.explanations:
        return {"fitted": False}
    explanation = pool.explanations[key]
    starts = _starts(explanation, [o for o in options if o.cause in key], truth, plant)
    candidate = Candidate(explanation.fit.candidate.placements, starts)
    best = explanation.fitter.fit(candidate, pool.explanations[frozenset()].fit)
    cost = explanation.fitter.cost(explanation.fit)
    return {"fitted": True, "converged": explanation.fit.converged, "excess": cost - best.cost}


def _starts(
    explanation: RankedExplanation, options: Sequence[Option], truth: Mapping[str, Any], plant: PlantDescription
) -> tuple[Mapping[str, float], ...]:
    """The end point with the true size in it, if the hidden law has that number, and random starts: those of the
    library with each deviation multiplied by a log-normal factor of one e-fold."""
    rng, (d, *_) = np.random.default_rng(len(options)), truth["deviations"]
    starts: list[Mapping[str, float]] = []
    if (d["effect"], d["law"]) in COMPARABLE:
        name, _, value = COMPARABLE[d["effect"], d["law"]]
        true = value(d["numbers"], plant, d["location"], Scales())
        parameter = f"{d['location']}.{d['effect']}.{name}"
        if np.isfinite(true) and parameter in explanation.fit.effect_values:
            starts.append({**explanation.fit.effect_values, parameter: true})
    while len(starts) < STARTS:
        option = options[len(starts) % len(options)]
        by_name = {p.name: p for p in option.parameters}
        start = {}
        for full, at in option.start.items():
            p = by_name[full.rpartition(".")[2]]
            start[full] = float(np.clip(p.nominal + (at - p.nominal) * np.exp(rng.normal()), p.low, p.high))
        starts.append(start)
    return tuple(starts)


def descents(out: Path) -> list[dict[str, Any]]:
    """Rows of `excess_of` for all cases of a folder with exactly one effect of the library."""
    rows, truths = [], open_key(out)
    path = out / "descents.jsonl"
    done = {row["case"] for row in lines_of(path)}
    rows = lines_of(path)
    for case, line in manifest(out).items():
        truth = truths[case]
        if case in done or len(truth["causes"]) != 1 or truth["causes"][0]["effect"] not in LIBRARY:
            continue
        plant = read_plant(out, line)
        rows.append(
            {"case": case, **truth["causes"][0]}
            | excess_of(plant, read_recording(out, line, "recording", plant), truth)
        )
        with path.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
    return rows


def say(name: str, hits: int, of: int) -> None:
    low, high = clopper_pearson(hits, of)
    print(f"{name}: {hits} of {of}, {100 * low:.1f} to {100 * high:.1f} %")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verdicts", description=__doc__)
    parser.add_argument("--rig", choices=sorted(RIGS), default="three_tank")
    parser.add_argument("--kinds", default="single,dnull,dsingle,null", help="kinds of `fdi challenge`")
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="length of the recordings; all by default")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no case after this time")
    parser.add_argument("--leave-out", default="", help="effects to remove from the library, one per case; or all")
    parser.add_argument("--out", type=Path, help="folder of the cases, answers and rows")
    parser.add_argument("--descents", type=Path, help="folder whose fits are compared with descents from other starts")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.descents:
        rows = [row for row in descents(arguments.descents) if row["fitted"]]
        say("converged", sum(row["converged"] for row in rows), len(rows))
        say(f"within {REACHED} of the best of {STARTS}", sum(row["excess"] < REACHED for row in rows), len(rows))
        return
    rows = blind_benchmark(
        arguments.cases,
        arguments.seed,
        arguments.out,
        partial(diagnosis, seconds=arguments.seconds),
        rig=RIGS[arguments.rig](),
        kinds=tuple(arguments.kinds.split(",")),
        library=LIBRARY,
        leave_out=LIBRARY if arguments.leave_out == "all" else tuple(n for n in arguments.leave_out.split(",") if n),
        minutes=arguments.minutes,
        code=git_state()["commit"][:12],
    )
    for kind, shares in scores_of([row for row in rows if row["by"] == "fdi"])["strata"].items():
        for name in ("right", "in_set", "named_wrong", "false_alarm"):
            if name in shares:
                say(f"{kind}, {name}", shares[name]["hits"], shares[name]["of"])


if __name__ == "__main__":
    main()
