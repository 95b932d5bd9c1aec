"""The gap job: a diagnosis, logged with everything that a report page, a viewer or a replay needs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fdi_torch.config.plant_writer import dump_plant, plant_mapping
from fdi_torch.gap.answer import Answer
from fdi_torch.gap.diagnose import solve_problem
from fdi_torch.gap.problem import DEFAULT_SETTINGS, Settings, problem_of
from fdi_torch.gap.stage_progress import SO_FAR
from fdi_torch.jobs.log_paths import STARTS_OVER
from fdi_torch.jobs.logged_recordings import log_prediction, log_recording
from fdi_torch.logbook import KEPT, RunLog
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.progress import Tell, silent
from fdi_torch.recording import Recording

NO_ANSWER = "no answer was computed{}; recordings and progress messages are"
"""What is said of an interrupted diagnosis, before the name of its log."""


def run_gap(
    path: Path,
    plant: PlantDescription,
    recording: Recording | Sequence[Recording],
    holdouts: Sequence[Recording] = (),
    settings: Settings = DEFAULT_SETTINGS,
    tell: Tell = silent,
    parent_run_id: str | None = None,
) -> Answer:
    """Diagnose the gap, and write the log `path`: recordings, progress messages and the answer."""
    recordings = (recording,) if isinstance(recording, Recording) else tuple(recording)
    every = (*recordings, *holdouts)
    settings = replace(settings, trusted=settings.trusted or any(r.trusted for r in every))
    with one_thread():
        case = problem_of(plant, recordings, holdouts, settings)
    sources = [r.origin for r in every]
    config = {"settings": asdict(settings), "recordings": len(recordings), "plant": plant_mapping(plant)}
    text = dump_plant(plant)
    with RunLog(
        path,
        "gap",
        config_text=text,
        config=config,
        data=sources,
        parent_run_id=parent_run_id,
        after_interruption=STARTS_OVER,
    ) as log:
        for group, each in zip(groups(len(holdouts), len(recordings)), every, strict=True):
            log_recording(log, each, group)
        log.flush()

        said, log.kept = "", NO_ANSWER.format("")

        def say(share: float | None, text: str) -> None:
            nonlocal said
            if text != said:
                log.say(text)
            if likeliest := text.partition(SO_FAR)[2]:
                log.kept = NO_ANSWER.format(f", the likeliest so far was {likeliest}")
            said = text
            tell(share, text)

        with one_thread():
            answer = solve_problem(case, say)
        log_answer(log, answer.to_dict(), answer.arrays)
        log.kept = KEPT
        for group, each in zip(groups(len(holdouts), len(recordings)), every, strict=True):
            predicted = answer.arrays.get(f"{group}_augmented" if group else "augmented")
            if predicted is not None and predicted.shape == each.outputs.shape:
                log_prediction(log, each, predicted, group)
    return answer


def library_entries(names: Sequence[str]) -> tuple[str, ...]:
    """The entries of a library: an effect at one place may be called T1.leak, as in files, and is leak@T1."""
    at = {name: ParameterName.of_effect(name) for name in names if "." in name}
    return tuple(f"{at[name].effect}@{at[name].place}" if name in at else name for name in names)


def groups(holdouts: int, recordings: int = 1) -> tuple[str, ...]:
    """Log groups of the recordings: "" for the first diagnosed one, then those of further ones and of the hold-outs."""
    further = (f"recording_{k + 1}" for k in range(1, recordings))
    return ("", *further, *("holdout" if k == 0 else f"holdout_{k + 1}" for k in range(holdouts)))


def log_answer(log: RunLog, answer: Mapping[str, Any], arrays: Mapping[str, Tensor]) -> None:
    """Log the answer (as JSON) and its arrays, which the report page draws."""
    for place in answer.get("where", ()):
        log.gap_where(place["location"], place["share"])
    log.gap_verdict(answer)
    log.result({"verdict": answer["verdict"], "closed": (answer.get("closure") or {}).get("closed")})
    log.result_arrays(**arrays)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: faster for arrays of this size, and sums are reproducible to the last bit."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
