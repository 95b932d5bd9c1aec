"""`fdi challenge`: what it does and prints. Its options: `options/challenge.py`.

Path: cli.challenge.run → blind.benchmark.blind_benchmark → blind.benchmark.seal → blind.benchmark.answer_all →
gap.diagnose.diagnose → jobs.blind_results.write_results
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from fdi_torch.blind.benchmark import Diagnosis, Each, blind_benchmark
from fdi_torch.blind.conditions import exercised
from fdi_torch.blind.networks import Networks
from fdi_torch.blind.plants import RIGS, Rig, scales_of
from fdi_torch.blind.score import Row
from fdi_torch.blind.scored_rows import Tables, joined, misses, sheets
from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.library import STANDARD as LIBRARY
from fdi_torch.interruption import Terminated
from fdi_torch.jobs.blind_results import LOG, write_plants, write_results
from fdi_torch.logbook.provenance import git_state
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.recording import Recording
from fdi_torch.study.cluster import connected, each_on

CASES = 22
NETWORK = "network"


def run(arguments: argparse.Namespace, screen: Screen, rivals: Mapping[str, Diagnosis] | None = None) -> int:
    """rivals: competing methods that answer the same cases."""
    out = Path(arguments.out)
    if arguments.join:
        rows, scores = _merged(arguments, out)
    else:
        rows, scores = _benchmarked(arguments, out, screen, rivals)
    show(scores, rows, screen)
    screen.say(f"tables: {out / 'scores.md'}; {log_words(out / LOG)}")
    screen.result({"format": "fdi_torch.challenge/2", "answers": len(rows), "tables": scores})
    return DONE


def _merged(arguments: argparse.Namespace, out: Path) -> tuple[Sequence[Row], Tables]:
    """Rows and scores of several folders together."""
    excluded = {"cases", "seed", "rig", "plant", "tanks", "kinds", "leave_out", "cluster"}
    if given := sorted(name for name in excluded if getattr(arguments, name)):
        raise ValueError(f"--join: expected folders only, got also --{given[0].replace('_', '-')}; leave that out")
    folders = [Path(name) for name in arguments.join]
    rows = joined(folders)
    return rows, write_results(out, rows, {"join": arguments.join}, [folder / "rows.jsonl" for folder in folders])


def _benchmarked(
    arguments: argparse.Namespace, out: Path, screen: Screen, rivals: Mapping[str, Diagnosis] | None
) -> tuple[Sequence[Row], Tables]:
    """Rows and scores of a new or resumed benchmark."""
    torch.set_num_threads(1)  # faster for arrays of this size
    cases, seed = (CASES if arguments.cases is None else arguments.cases), arguments.seed or 0
    if cases < 1:
        raise ValueError(f"--cases: expected at least one case, got {cases}")
    if arguments.plant and arguments.rig:
        raise ValueError("expected --rig or --plant, got both; leave one out")
    rig = _rig(arguments)
    left_out = LIBRARY if arguments.leave_out == ("all",) else arguments.leave_out
    code = git_state()
    with _mapper(arguments.cluster) as each, screen.progress("blind benchmark") as advance, _resumable(out):
        rows = blind_benchmark(
            cases,
            seed,
            out,
            _diagnose,
            rig=rig,
            kinds=arguments.kinds,
            library=LIBRARY,
            leave_out=left_out,
            rivals=rivals,
            each=each,
            minutes=arguments.minutes,
            code=code["commit"][:12] + ("+" if code["changed"] == "yes" else ""),
            tell=advance,
        )
    config = {"cases": cases, "seed": seed, "rig": rig.name, "leave_out": list(left_out)}
    write_plants(out)
    return rows, write_results(out, rows, config, [out / "manifest.jsonl", out / "key.jsonl"])


def _rig(arguments: argparse.Namespace) -> Rig | Networks:
    tanks, ends = arguments.tanks, (arguments.tanks or "").split("..")
    if tanks and arguments.plant != NETWORK:
        raise ValueError(f"--tanks: expected --plant {NETWORK} with it; add that or leave --tanks out")
    if tanks and (not all(end.isdigit() for end in ends) or len(ends) > 2):
        raise ValueError(f"--tanks: expected a number or a range, got '{tanks}'; write for example 6 or 3..12")
    if arguments.plant == NETWORK:
        return Networks(int(ends[0]), int(ends[-1])) if tanks else Networks()
    if not arguments.plant:
        return RIGS[arguments.rig or "three_tank"]()
    plant = chosen_plant(arguments.plant)
    return exercised(plant, scales_of(plant, time_scale(plant)))


@contextmanager
def _resumable(out: Path) -> Iterator[None]:
    """Add to an interruption where the answers are and how to resume."""
    try:
        yield
    except (KeyboardInterrupt, Terminated) as error:
        error.add_note(f"the answers so far are in {out}")
        error.add_note("the same command continues from there")
        raise


@contextmanager
def _mapper(cluster: str | None) -> Iterator[Each]:
    """The `map` over cases: in this process, or on a cluster."""
    if cluster is None:
        yield map
        return
    with connected(cluster) as client:
        yield partial(each_on, client)


def _diagnose(
    plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: Collection[str] = ()
) -> dict[str, Any]:
    return diagnose(plant, recording, holdout, Settings(leave_out=tuple(leave_out))).to_dict()


def show(scores: Tables, rows: Sequence[Row], screen: Screen) -> None:
    """Print all tables of every rig, then every wrong answer."""
    for group, by in scores.items():
        screen.say(f"{group}, {by['fdi']['strata']['all']['cases']} cases, with 95 % intervals")
        for sheet in sheets(by):
            screen.show(sheet)
            screen.say()
    screen.show(misses(rows))
