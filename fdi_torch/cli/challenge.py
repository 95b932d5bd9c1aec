"""Check the gap diagnosis on hidden rigs: other equations, another integrator, causes sealed until all is answered.

Recordings are made, their causes sealed (the hash of the key stands in each recording), every recording is diagnosed
without the key, then the key is opened and the answers are judged: by kind of case, with 95 % intervals, beside
baselines. All of it is kept in --out, where an interrupted challenge goes on when it is started again.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant import load_plant
from fdi_torch.gap.challenge import Row, Tables, challenge, joined
from fdi_torch.gap.challenge.bench import Scales
from fdi_torch.gap.challenge.exercise import exercised
from fdi_torch.gap.challenge.kinds import STANDARD
from fdi_torch.gap.challenge.plants import RIGS, Rig
from fdi_torch.gap.challenge.run import Each
from fdi_torch.gap.challenge.table import misses, sheets
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.library import STANDARD as LIBRARY
from fdi_torch.gap.one_at_a_time import one_at_a_time
from fdi_torch.jobs.challenge import LOG, conclude
from fdi_torch.logbook.provenance import git_state
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.pace import area_scale, length_scale, time_scale
from fdi_torch.recording import Recording
from fdi_torch.study.cluster import connected, each_on

CASES = 18
EXAMPLES = f"""
kinds of cases:
  single    one effect of usual strength          pair      two effects
  weak      a fifth of that                       messy     one full effect among three faint ones
  coloured  noise that is not white               poor      inputs that excite little
  null      nothing is wrong                      twins     one of a family that is nearly collinear
  unknown   a law that no effect of the library has: `unknown` at its place is right
  left_out  an effect that the diagnosis is denied (--leave-out)

examples:
  fdi challenge                                            {CASES} cases, two a kind, about three minutes on one core
  fdi challenge --cases 450 --seed 7 --out logs/seven      fifty a kind; Ctrl-C and the same words again go on
  fdi challenge --cases 450 --seed 7 --out logs/seven --minutes 30      what is answered in half an hour is scored
  fdi challenge --rig quadruple_tank --kinds single,pair --no-bic
  fdi challenge --plant my_rig.yaml                        hidden rigs built as a plant file of yours describes
  fdi challenge --leave-out all --cases 24 --out logs/denied
  fdi challenge --join logs/seven logs/denied --out docs/gap     one set of tables from several folders

--out then holds rows.jsonl (a line an answer), scores.json, scores.md and {LOG} (`fdi report` makes the page).
The workers of a --cluster have to see that folder.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EXAMPLES
    parser.add_argument("--cases", metavar="N", type=int, help=f"recordings, spread over the kinds ({CASES})")
    parser.add_argument("--seed", metavar="S", type=int, help="of causes, places, noise and inputs (0)")
    parser.add_argument("--out", metavar="DIR", default="logs/challenge", help="folder (logs/challenge)")
    parser.add_argument("--rig", choices=sorted(RIGS), help="which hidden rig (three_tank)")
    parser.add_argument("--plant", metavar="NAME|FILE", help="instead: a rig such as this plant file describes")
    parser.add_argument("--kinds", metavar="KIND,...", help=f"by default {','.join(STANDARD)}")
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="deny these, one a case: 'all' in turn")
    parser.add_argument("--no-bic", action="store_true", help="spare the one-at-a-time BIC winner, the dear baseline")
    parser.add_argument("--minutes", metavar="M", type=float, default=math.inf, help="begin no case after so long")
    parser.add_argument("--cluster", metavar="local|ADDRESS", help="diagnose on Dask: local, or tcp://host:8786")
    parser.add_argument("--join", metavar="DIR", nargs="+", help="diagnose nothing: join the answers of these folders")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    out = Path(arguments.out)
    if arguments.join:
        rows, found = _joined(arguments, out)
    else:
        rows, found = _challenged(arguments, out, screen)
    show(found, rows, screen)
    screen.say(f"tables: {out / 'scores.md'}; log: {out / LOG} (fdi report {out / LOG} makes the page)")
    screen.result({"format": "fdi_torch.challenge/2", "answers": len(rows), "tables": found})
    return DONE


def _joined(arguments: argparse.Namespace, out: Path) -> tuple[Sequence[Row], Tables]:
    asked = {"cases", "seed", "rig", "plant", "kinds", "leave_out", "cluster"}
    if told := sorted(name for name in asked if getattr(arguments, name)):
        raise ValueError(f"--join: expected folders only, got --{told[0].replace('_', '-')} beside it; leave that out")
    folders = [Path(name) for name in arguments.join]
    rows = joined(folders)
    return rows, conclude(out, rows, {"join": arguments.join}, [folder / "rows.jsonl" for folder in folders])


def _challenged(arguments: argparse.Namespace, out: Path, screen: Screen) -> tuple[Sequence[Row], Tables]:
    torch.set_num_threads(1)  # arrays of this size lose more by sharing work than they gain
    cases, seed = (CASES if arguments.cases is None else arguments.cases), arguments.seed or 0
    if cases < 1:
        raise ValueError(f"--cases: expected at least one case, got {cases}")
    if arguments.plant and arguments.rig:
        raise ValueError("expected --rig or --plant, got both; leave one out")
    rig = _rig_like(load_plant(arguments.plant)) if arguments.plant else RIGS[arguments.rig or "three_tank"]()
    denied = LIBRARY if arguments.leave_out == "all" else tuple(n for n in arguments.leave_out.split(",") if n)
    code = git_state()
    with _each(arguments.cluster) as each, screen.progress("challenge") as advance:
        rows = challenge(
            cases,
            seed,
            out,
            partial(_diagnosed, rig.believed),
            rig=rig,
            kinds=tuple(arguments.kinds.split(",")) if arguments.kinds else STANDARD,
            library=LIBRARY,
            leave_out=denied,
            rivals={} if arguments.no_bic else {"one_at_a_time_bic": partial(_textbook, rig.believed)},
            each=each,
            minutes=arguments.minutes,
            code=code["commit"][:12] + ("+" if code["changed"] == "yes" else ""),
            tell=advance,
        )
    config = {"cases": cases, "seed": seed, "rig": rig.plant.name, "leave_out": list(denied)}
    return rows, conclude(out, rows, config, [out / "manifest.jsonl", out / "key.jsonl"])


def _rig_like(plant: PlantDescription) -> Rig:
    return exercised(plant, Scales(time_scale(plant), length_scale(plant), area_scale(plant)))


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


def show(found: Tables, rows: Sequence[Row], screen: Screen) -> None:
    """Every table of every rig, then every miss."""
    for group, by in found.items():
        screen.say(f"{group}, {by['fdi']['strata']['all']['cases']} cases, with 95 % intervals")
        for sheet in sheets(by):
            screen.table(sheet.title, sheet.header, sheet.rows, sheet.left)
            screen.say()
    missed = misses(rows)
    if missed.rows:
        screen.table(missed.title, missed.header, missed.rows, missed.left)
