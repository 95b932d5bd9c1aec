"""`fdi gap`: what it does and prints. Its options: `options/gap.py`.

Path: cli.gap.run → config.loaded_recordings.named_recordings → jobs.gap.run_gap → gap.problem.problem_of →
gap.diagnose.solve_problem → gap.screening.options_of → gap.structure_search.search → gap.posterior.posterior_of →
gap.hypothesis_search.HypothesisSearch.search → gap.localization.localize.localize → gap.answer_assembly.build_answer
→ gap.holdout.run_reference_models → jobs.gap.log_answer → cli.gap_text.show
"""

from __future__ import annotations

import argparse
import ctypes
import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.adoption import expect_adoptable, write_adopted
from fdi_torch.cli.gap_text import next_steps, show
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.clock import show_clock
from fdi_torch.config.loaded_recordings import named_recordings
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.disk import write_text
from fdi_torch.gap.answer import UNKNOWN, Answer, adopted
from fdi_torch.gap.diagnose import Settings
from fdi_torch.gap.experiment_design import planned_recording
from fdi_torch.gap.free_runs.prediction import predict
from fdi_torch.gap.free_runs.refit import narrowed
from fdi_torch.jobs.gap import library_entries, run_gap
from fdi_torch.jobs.log_paths import free_path
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_writing import write_csv
from fdi_torch.recordings.plant_limits import denied_by

KEPT, LARGE = 1 << 30, 1 << 26  # bytes of free memory to keep, and size from which an array is not kept
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    keep_memory()
    plant = chosen_plant(arguments.plant)
    recordings = named_recordings(arguments.recording, plant, Path.cwd())
    holdouts = [r for name in arguments.holdout for r in named_recordings(name, plant, Path.cwd())]
    for note in dict.fromkeys(note for r in (*recordings, *holdouts) for note in r.notes):
        screen.note(note)
    show_clock((r.clock_zero for r in recordings), (float(r.time[0]) for r in recordings))
    library = library_entries(arguments.library) or None
    settings = Settings(library, arguments.leave_out, arguments.step, arguments.most, arguments.named_only)
    expect_adoptable(arguments.adopt, arguments.replace)
    arguments.with_constants |= arguments.narrow
    log = free_path(Path(arguments.out), "gap")
    with screen.progress("gap") as advance:

        def next_stage(share: float | None, text: str) -> None:
            release_memory()
            advance(share, text)

        answer = run_gap(log, plant, recordings, holdouts, settings, next_stage)
        advance(1.0, "done")
    diff, refused = _adopt(arguments, plant, recordings, answer, screen)
    if refused:
        screen.complain(f"fdi gap: {refused}")
    planned = _written(plant, answer, log)
    adopted_file = arguments.adopt if diff else None
    rim_denied = bool(denied_by(plant, recordings))
    steps = next_steps(answer, bool(holdouts), library, planned, adopted_file, rim_denied, refused)
    show(answer, plant, steps, screen)
    for line in diff:
        screen.say(line)
    screen.say(log_words(log))
    screen.result(answer.to_dict())
    return DONE


def _adopt(
    arguments: argparse.Namespace,
    plant: PlantDescription,
    recordings: Sequence[Recording],
    answer: Answer,
    screen: Screen,
) -> tuple[list[str], str]:
    """Write the adopted plant if requested. Returns the lines of the diff, or why nothing was adopted."""
    if not arguments.adopt:
        return [], ""
    named = any(cause.effect != UNKNOWN for cause in answer.causes)
    if not named and not (arguments.with_constants and answer.verdict == "no_gap"):
        constants = "; --with-constants writes the fitted constants" if answer.verdict == "no_gap" else ""
        return [], f"nothing to adopt: the verdict is {answer.verdict.replace('_', ' ')}{constants}"
    if named and not answer.converged:
        return [], "nothing adopted: the fit of the likeliest explanation has not converged"
    better, errors = adopted(plant, answer, arguments.with_constants), _errors(answer)
    if arguments.narrow:
        better = narrowed(better, errors)
    if named and not _error(better, recordings) <= _error(plant, recordings):
        return [], (
            "nothing adopted: the plant with the causes has a larger free-run error than the plant file; "
            "--with-constants also writes the constants that were fitted together with the causes"
        )
    sources = ", ".join(dict.fromkeys(Path(r.source).name for r in recordings))
    diff = write_adopted(arguments.plant, plant, better, Path(arguments.adopt), screen, errors, sources)
    constants = (
        "as fitted with them" if arguments.with_constants else "unchanged (--with-constants writes the fitted ones)"
    )
    what = f"the causes, its constants {constants}" if named else "its fitted constants; no cause was found"
    screen.note(f"plant file with {what}: {arguments.adopt}")
    return diff, ""


def _errors(answer: Answer) -> dict[str, float]:
    """Standard errors of the fitted values, by full name, SI."""
    causes = {
        str(ParameterName(cause.location, cause.effect, name)): amount.std
        for cause in answer.causes
        for name, amount in cause.parameters.items()
    }
    return causes | {name: float(constant["std"]) for name, constant in answer.constants.items()}


def _written(plant: PlantDescription, answer: Answer, log: Path) -> Path | None:
    """Write gap.json and, if several explanations are plausible, next_input.csv, whose path is returned.

    Beside gap_2.mcap they are gap_2.json and next_input_2.csv, so that no file belongs to another run's log.
    """
    write_text(log.with_suffix(".json"), json.dumps(answer.to_dict(), indent=1) + "\n")
    if not answer.next_input:
        return None
    path = log.with_name(f"{log.stem.replace('gap', 'next_input', 1)}.csv")
    return write_csv(planned_recording(answer.next_input["input"], plant), path)


def _error(plant: PlantDescription, recordings: Sequence[Recording]) -> float:
    """Sum over sensors of the squared free-run error, in units of the standard deviation of the readings."""
    total = 0.0
    for recording in recordings:
        errors = predict(plant, recording).rmse
        for sensor in plant.sensors:
            std = float(recording.valid_readings(sensor.column).std())
            total += (errors[sensor.name] / max(std, 1e-300)) ** 2
    return total


def keep_memory() -> bool:
    """Keep freed memory in the process, arrays from LARGE on excepted. Returns False if the C library cannot.

    Fits of whole trajectories allocate and free the same few large arrays again and again. By default the GNU C library
    maps each of them anew and the system clears every page, which takes a considerable part of a short run.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library; TypeError: Windows wants a name
        return False
    return bool(mallopt(_MMAP_THRESHOLD, LARGE)) and bool(mallopt(_TRIM_THRESHOLD, KEPT))


def release_memory() -> None:
    """Return freed memory to the system, because later stages of a diagnosis may need less."""
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
