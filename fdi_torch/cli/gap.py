"""Where a plant file falls short of a recording, which unmodelled effect causes it, and how far the gap then closes.

The answer is one of four: no gap; a named cause; several explanations that stand (with the input that would part them);
or a gap that no effect of the library explains (with its place and shape). Calibration constants that the plant file
lists under tolerances, and the start levels, are refitted throughout and are no gap.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.allocation import keep_memory
from fdi_torch.cli.gap_refit import add_refit_arguments, run_refit
from fdi_torch.cli.gap_text import next_steps, show, show_plan
from fdi_torch.cli.screen import Screen
from fdi_torch.config.loaded_recordings import named_recordings
from fdi_torch.config.plant import load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.gap.answer import Answer, adopted
from fdi_torch.gap.diagnose import Settings
from fdi_torch.gap.next_input import planned
from fdi_torch.gap.plan import plan
from fdi_torch.gap.which import DEEPEST
from fdi_torch.jobs.gap import one_thread, run_gap
from fdi_torch.jobs.log_paths import free_path
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recordings.csv_files import write_csv

EXAMPLES = """
examples:
  fdi gap --plant three_tank --recording run.csv                       where, and which effect
  fdi gap --plant three_tank --recording run.csv --holdout other.csv   also how far the gap closes on other.csv
  fdi gap --plant rig.yaml --recording run.csv --adopt better.yaml     write the plant file with the causes in it
  fdi gap --plant rig.yaml --recording run.csv --library pump_lag,leak@T1
  fdi gap --plant rig.yaml --recording runs.yaml --most 8               several recordings as one, many causes
  fdi gap --plant rig.yaml --recording planned.csv --plan              before any reading: what the inputs cannot tell

CSV headers are name_unit, as in t_s,Q1_cm3_s,h1_cm. `fdi report LOG` makes a page of the answer, `fdi replay LOG` does
it again from its log alone.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EXAMPLES
    parser.add_argument("--plant", metavar="NAME|FILE", required=True, help="a shipped plant, or a plant file")
    parser.add_argument(
        "--recording", metavar="FILE", required=True, help="CSV or MCAP file, or a YAML file with `recordings`"
    )
    parser.add_argument(
        "--holdout", metavar="FILE", nargs="+", default=[], help="other recordings of the same rig, for closure only"
    )
    parser.add_argument("--library", metavar="EFFECT,...", help="effects to search (EFFECT@PLACE for one), or all")
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="effects to deny the diagnosis")
    parser.add_argument("--step", metavar="S", type=float, help="of the simulation, s (as sampled, on a bench <= 5)")
    parser.add_argument("--most", metavar="N", type=int, default=DEEPEST, help=f"effects at once, at most ({DEEPEST})")
    parser.add_argument("--named-only", action="store_true", help="never unknown: the best that has a name, on the way")
    parser.add_argument(
        "--cross-validate",
        action="store_true",
        help="choose among explanations by free runs along stretches that they were not fitted to (minutes)",
    )
    parser.add_argument("--adopt", metavar="FILE", help="write the plant file with the causes found among its effects")
    parser.add_argument(
        "--with-constants", action="store_true", help="--adopt also writes the constants as fitted beside the causes"
    )
    add_refit_arguments(parser)
    parser.add_argument("--plan", action="store_true", help="only say what the inputs of the recording can never show")
    parser.add_argument("--noise", metavar="STD", type=float, default=1e-3, help="for --plan: of a reading, SI (0.001)")
    parser.add_argument("--out", metavar="DIR", default="logs", help="folder for log, gap.json and next_input.csv")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    keep_memory()
    plant = load_plant(arguments.plant)
    recordings = named_recordings(arguments.recording, plant, Path.cwd())
    holdouts = [r for name in arguments.holdout for r in named_recordings(name, plant, Path.cwd())]
    for note in dict.fromkeys(note for r in (*recordings, *holdouts) for note in r.notes):
        screen.note(note)
    library = _names(arguments.library) or None
    if arguments.plan:
        with one_thread():
            return show_plan(plan(plant, recordings[0], arguments.noise, library), screen)
    if arguments.step is not None and not arguments.step > 0.0:
        raise ValueError(f"--step: expected a positive number of seconds, got {arguments.step:g}")
    if arguments.most < 1:
        raise ValueError(f"--most: expected at least one effect, got {arguments.most}")
    left_out = _names(arguments.leave_out)
    if arguments.refit:
        with one_thread():
            return run_refit(plant, recordings, holdouts, left_out, arguments, screen)
    folder = Path(arguments.out)
    log = free_path(folder, "gap")
    with screen.progress("gap") as advance:
        asked = arguments.named_only, arguments.cross_validate
        settings = Settings(library, left_out, arguments.step, arguments.most, *asked)
        answer = run_gap(log, plant, recordings, holdouts, settings, advance)
        advance(1.0, "done")
    written = _keep(arguments, plant, answer, screen)
    show(answer, screen)
    for sentence in next_steps(answer, bool(holdouts), library, written, arguments.adopt):
        screen.say(f"- {sentence}")
    screen.say(f"log: {log} (fdi report {log} makes the page)")
    screen.result(answer.to_dict())
    return DONE


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def _keep(arguments: argparse.Namespace, plant: PlantDescription, answer: Answer, screen: Screen) -> Path | None:
    """gap.json and, where rivals stand, next_input.csv in the output folder; the plant with the causes where that was
    asked for. Returns the path of the input."""
    folder = Path(arguments.out)
    (folder / "gap.json").write_text(json.dumps(answer.to_dict(), indent=1) + "\n", encoding="utf-8")
    if arguments.adopt and answer.causes:
        target = Path(arguments.adopt)
        target.parent.mkdir(parents=True, exist_ok=True)
        better = adopted(plant, answer, arguments.with_constants)
        target.write_text(dump_plant(better), encoding="utf-8")
        constants = (
            "as fitted beside them" if arguments.with_constants else "as they were (--with-constants: as fitted)"
        )
        screen.note(f"plant file with the causes, its constants {constants}: {target}")
    elif arguments.adopt and arguments.with_constants and answer.verdict == "no_gap":
        Path(arguments.adopt).write_text(dump_plant(adopted(plant, answer, True)), encoding="utf-8")
        screen.note(f"plant file with its constants as fitted, for no cause was found: {arguments.adopt}")
    elif arguments.adopt:
        screen.complain(f"fdi gap: nothing to adopt: the verdict is {answer.verdict.replace('_', ' ')}")
    if not answer.next_input:
        return None
    return write_csv(planned(answer.next_input["input"], plant), folder / "next_input.csv")
