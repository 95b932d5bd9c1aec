"""Check the gap diagnosis on hidden rigs: other equations, another integrator, causes sealed until all is answered.

Recordings, sealed causes, answers and scores go to --out; an interrupted challenge goes on there when started again.
The workers of a cluster have to see that folder.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant import load_plant
from fdi_torch.gap.challenge import challenge
from fdi_torch.gap.challenge.exercise import exercised
from fdi_torch.gap.challenge.kinds import KINDS, STANDARD
from fdi_torch.gap.challenge.plants import RIGS, Rig
from fdi_torch.gap.challenge.run import Each
from fdi_torch.gap.challenge.table import SHOWN, in_words
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.library import STANDARD as LIBRARY
from fdi_torch.gap.one_at_a_time import one_at_a_time
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.study.cluster import connected, each_on

COLUMNS = ("right", "in_set", "place", "named_wrong", "utility")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", metavar="N", type=int, default=18, help="recordings, spread over the kinds (18)")
    parser.add_argument("--seed", metavar="S", type=int, default=0, help="of causes, places, noise and inputs (0)")
    parser.add_argument("--out", metavar="DIR", default="logs/challenge", help="folder (logs/challenge)")
    parser.add_argument("--rig", choices=sorted(RIGS), default="three_tank", help="which hidden rig (three_tank)")
    parser.add_argument("--plant", metavar="NAME|FILE", help="instead: a rig such as this plant file describes")
    parser.add_argument("--kinds", metavar="KIND,...", help=f"of {', '.join(KINDS)}; by default {', '.join(STANDARD)}")
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="deny these, one a case: 'all' in turn")
    parser.add_argument("--no-bic", action="store_true", help="spare the one-at-a-time BIC winner, the dear baseline")
    parser.add_argument("--minutes", metavar="M", type=float, default=math.inf, help="begin no case after so long")
    parser.add_argument("--cluster", metavar="local|ADDRESS", help="diagnose on Dask: local, or tcp://host:8786")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    torch.set_num_threads(1)  # arrays of this size lose more by sharing work than they gain
    rig = exercised(load_plant(arguments.plant)) if arguments.plant else RIGS[arguments.rig]()
    denied = LIBRARY if arguments.leave_out == "all" else tuple(n for n in arguments.leave_out.split(",") if n)
    with _each(arguments.cluster) as each:
        scores = challenge(
            arguments.cases,
            arguments.seed,
            Path(arguments.out),
            partial(_diagnosed, rig.plant),
            rig=rig,
            kinds=tuple(arguments.kinds.split(",")) if arguments.kinds else STANDARD,
            library=LIBRARY,
            leave_out=denied,
            rivals={} if arguments.no_bic else {"one_at_a_time_bic": partial(_textbook, rig.plant)},
            each=each,
            minutes=arguments.minutes,
            tell=screen.note,
        )
    show(scores, rig, screen)
    screen.result({"format": "fdi_torch.challenge/1", "rig": rig.plant.name, "scores": scores})
    return DONE


@contextmanager
def _each(cluster: str | None) -> Iterator[Each]:
    """How to go through the cases: in this process, or on a cluster."""
    if cluster is None:
        yield map
        return
    with connected(cluster) as client:
        yield partial(each_on, client)


def _diagnosed(
    plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: Collection[str] = ()
) -> dict[str, Any]:
    return diagnose(plant, recording, holdout, Settings(leave_out=tuple(leave_out))).to_dict()


def _textbook(
    plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: Collection[str] = ()
) -> dict[str, Any]:
    return one_at_a_time(plant, recording, leave_out=tuple(leave_out))


def show(scores: Mapping[str, Any], rig: Rig, screen: Screen) -> None:
    """Stratum by stratum what the diagnosis got right, and beside it what the baselines did."""
    strata = [stratum for stratum in scores["fdi"] if stratum != "by_effect"]
    rows = [
        [s, str(scores["fdi"][s]["cases"]), *(in_words(scores["fdi"][s].get(name)) for name in COLUMNS)] for s in strata
    ]
    header = ("kind", "cases", *(SHOWN[name] for name in COLUMNS))
    screen.table(f"{rig.plant.name}, with 95 % intervals", header, rows)
    rows = [[s, *(in_words(scores[name].get(s, {}).get("right")) for name in scores)] for s in strata]
    screen.table("right answers, and those of the baselines", ("kind", *scores), rows)
