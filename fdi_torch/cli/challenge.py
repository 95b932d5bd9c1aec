"""Check the gap diagnosis on hidden rigs: other equations, another integrator, causes sealed until all is answered.

Recordings, sealed causes, answers and scores go to --out; an interrupted challenge goes on there when started again.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.effects import EFFECTS
from fdi_torch.gap.challenge import challenge
from fdi_torch.gap.challenge.kinds import KINDS, STANDARD
from fdi_torch.gap.challenge.plants import RIGS
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.recording import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", metavar="N", type=int, default=18, help="recordings, spread over the kinds (18)")
    parser.add_argument("--seed", metavar="S", type=int, default=0, help="of causes, places, noise and inputs (0)")
    parser.add_argument("--out", metavar="DIR", default="logs/challenge", help="folder (logs/challenge)")
    parser.add_argument("--rig", choices=sorted(RIGS), default="three_tank", help="which hidden rig (three_tank)")
    parser.add_argument("--kinds", metavar="KIND,...", help=f"of {', '.join(KINDS)}; by default {', '.join(STANDARD)}")
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="deny these, one a case: 'all' in turn")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    torch.set_num_threads(1)  # arrays of this size lose more by sharing work than they gain
    rig = RIGS[arguments.rig]()
    every = tuple(effect.name for effect in EFFECTS)
    denied = every if arguments.leave_out == "all" else tuple(n for n in arguments.leave_out.split(",") if n)

    def answer(recording: Recording, holdout: Recording, leave_out: Collection[str] = ()) -> dict[str, Any]:
        return diagnose(rig.plant, recording, holdout, Settings(leave_out=tuple(leave_out))).to_dict()

    kinds = tuple(arguments.kinds.split(",")) if arguments.kinds else STANDARD
    scores = challenge(
        arguments.cases,
        arguments.seed,
        Path(arguments.out),
        answer,
        rig=rig,
        kinds=kinds,
        library=every,
        leave_out=denied,
        tell=screen.note,
    )
    show(scores, screen)
    screen.result({"format": "fdi_torch.challenge/1", "scores": scores})
    return DONE


def show(scores: dict[str, Any], screen: Screen) -> None:
    """The share of right answers, stratum by stratum, beside those of diagnoses without skill."""
    names = list(scores)
    strata = [stratum for stratum in scores[names[0]] if stratum != "by_effect"]
    rows = [[stratum, *(_share(scores[name].get(stratum, {}).get("right")) for name in names)] for stratum in strata]
    screen.table("right answers, 95 % interval", ("kind", *names), rows)


def _share(score: Any) -> str:
    if not score:
        return ""
    low, high = score["ci95"]
    return f"{100 * score['share']:.0f} % ({100 * low:.0f} .. {100 * high:.0f})"
