"""Where a plant file falls short of a recording, which unmodelled effect causes it, and how far the gap then closes."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant import load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.recordings import RecordingConfig, read_recording
from fdi_torch.gap.answer import Answer, adopted
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.plan import Plan, plan
from fdi_torch.gap_job import log_gap
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plant", metavar="NAME|FILE", required=True, help="a shipped plant, or a plant file")
    parser.add_argument("--recording", metavar="FILE", required=True, help="CSV or MCAP file to diagnose")
    parser.add_argument("--holdout", metavar="FILE", help="another recording of the same rig, for closure only")
    parser.add_argument("--library", metavar="EFFECT,...", help="effects to search (EFFECT@PLACE for one), or all")
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="effects to deny the diagnosis")
    parser.add_argument("--adopt", metavar="FILE", help="write the plant file with the causes found")
    parser.add_argument("--plan", action="store_true", help="only say what the inputs of the recording can never show")
    parser.add_argument("--noise", metavar="STD", type=float, default=1e-3, help="for --plan: of a reading, SI (0.001)")
    parser.add_argument("--out", metavar="DIR", default="logs", help="folder for the answer")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    torch.set_num_threads(1)  # arrays of this size lose more by sharing work than they gain
    plant = load_plant(arguments.plant)
    recording = read_recording(RecordingConfig(file=arguments.recording), plant, Path.cwd())
    library = tuple(arguments.library.split(",")) if arguments.library else None
    if arguments.plan:
        return show_plan(plan(plant, recording, arguments.noise, library), screen)
    holdout = read_recording(RecordingConfig(file=arguments.holdout), plant, Path.cwd()) if arguments.holdout else None
    settings = Settings(
        library=library,
        leave_out=tuple(name for name in arguments.leave_out.split(",") if name),
    )
    with screen.progress("gap") as advance:
        answer = diagnose(plant, recording, holdout, settings, advance)
    _keep(arguments, plant, answer, screen)
    show(answer, screen)
    log = log_gap(Path(arguments.out), plant, recording, answer.to_dict(), holdout, vars(settings))
    screen.say(f"log: {log}")
    screen.result(answer.to_dict())
    return DONE


def _keep(arguments: argparse.Namespace, plant: PlantDescription, answer: Answer, screen: Screen) -> None:
    """The answer as gap.json in the output folder, and the plant with the causes where that was asked for."""
    folder = Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "gap.json").write_text(json.dumps(answer.to_dict(), indent=1) + "\n", encoding="utf-8")
    if arguments.adopt and answer.causes:
        Path(arguments.adopt).write_text(dump_plant(adopted(plant, answer)), encoding="utf-8")
        screen.note(f"plant file with the causes: {arguments.adopt}")
    elif arguments.adopt:
        screen.complain(f"fdi gap: nothing to adopt: the verdict is {answer.verdict.replace('_', ' ')}")


def show(answer: Answer, screen: Screen) -> None:
    """The verdict in words, causes with units, rivals, closure."""
    verdict = answer.verdict.replace("_", " ")
    screen.say(f"verdict: {verdict} (chance of such a gain by noise alone {answer.p_value:.1g})")
    rows = []
    for cause in answer.causes:
        for name, amount in cause.parameters.items():
            unit, scale = display_unit(amount.unit)
            rows.append(
                [cause.effect, cause.location, name, f"{scale * amount.value:.4g}", f"{scale * amount.std:.2g}", unit]
            )
    if rows:
        screen.table("causes", ("effect", "at", "parameter", "value", "std error", "unit"), rows, left=3)
    screen.table("where", ("place", "share of the gap"), [[p, f"{100 * s:.1f} %"] for p, s in answer.where[:5]])
    names = [[_words(e.causes, e.unknown_at), f"{100 * e.probability:.2f} %"] for e in answer.posterior[:5]]
    screen.table("explanations", ("causes", "probability"), names)
    if answer.closure:
        c = answer.closure
        parts = ", ".join(f"{n} {c[n]:.4g}" for n in ("nominal", "recalibrated", "augmented", "noise_floor"))
        closed = "undefined" if c["closed"] is None else f"{100 * c['closed']:.1f} %"
        screen.say(f"hold-out, free-run RMSE in {c['unit']}: {parts}; gap closed: {closed}")
    for remark in answer.remarks:
        screen.say(f"- {remark}")


def show_plan(found: Plan, screen: Screen) -> int:
    """What the planned inputs hide and what they cannot tell apart."""
    for name, place in found.hidden:
        screen.say(f"does not show at its typical size: {name} at {place}")
    for (a, at), (b, there), left in found.twins:
        screen.say(f"cannot be told apart: {a} at {at} and {b} at {there} ({left:.1f} chi-square units between them)")
    if not found.hidden and not found.twins:
        screen.say("every effect of the library shows at its typical size and can be told from every other")
    screen.result(
        {"format": "fdi_torch.gap_plan/1", "hidden": found.hidden, "twins": found.twins, "shown": found.shown}
    )
    return DONE


def _words(causes: tuple[tuple[str, str], ...], unknown_at: str | None) -> str:
    if unknown_at:
        return f"something unknown at {unknown_at}"
    return " and ".join(f"{effect} at {place}" for effect, place in causes) or "nothing beyond tolerances"
