"""The blind benchmark: make and seal, diagnose without the key, open, score."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import Any

from fdi_torch.blind.cases import make, plans
from fdi_torch.blind.files import (
    answers,
    append,
    lines_of,
    manifest,
    read_plant,
    read_recording,
    write_cases,
)
from fdi_torch.blind.kinds import ON_NETWORKS, STANDARD
from fdi_torch.blind.networks import Networks
from fdi_torch.blind.plants import Rig, three_tank
from fdi_torch.blind.rivals import Diagnosis, always_null, random_pair
from fdi_torch.blind.rows import Row, judged

Task = tuple[str, Mapping[str, Any]]
"""Whose diagnosis, and a case's line of the manifest."""
Done = tuple[str, dict[str, Any]]
Each = Callable[[Callable[[Task], Done], Iterable[Task]], Iterable[Done]]
Tell = Callable[[float, str], None]
CHUNK = 200


def blind_benchmark(
    cases: int,
    seed: int,
    out: Path | str,
    diagnose: Diagnosis,
    *,
    rig: Rig | Networks | None = None,
    kinds: Sequence[str] = (),
    library: Collection[str] = (),
    leave_out: Sequence[str] = (),
    rivals: Mapping[str, Diagnosis] | None = None,
    each: Each = map,
    minutes: float = math.inf,
    code: str = "",
    tell: Tell = lambda share, text: None,
) -> list[Row]:
    """Has `diagnose` and its rivals answer `cases` recordings, kinds in turn; resumes where it was interrupted.

    diagnose(plant, recording, holdout[, leave_out=(effect,)]) -> answer in the format `fdi_torch.gap/1` or `/2`.
    rig: one, or random networks. kinds: by default those usual for it.
    library: effects that `diagnose` can name; those are not drawn as unknown.
    leave_out: effects to deny it, one a case.
    rivals: further diagnoses scored beside the two without skill. each: map over tasks, for example an executor's.
    minutes: after which no further case is begun; what is answered by then is judged. code: state of the code that
    answers, kept with each answer. tell(share, text): how far it is.
    Returns a judged row an answer; see `rows`.
    """
    rig, out = rig or three_tank(), Path(out)
    usual = ON_NETWORKS if isinstance(rig, Networks) else STANDARD
    kinds = ("left_out",) if leave_out else tuple(kinds) or usual
    stop = time.perf_counter() + 60 * minutes
    seal(cases, seed, out, rig, kinds, library, leave_out, tell)
    diagnoses = {"always_null": always_null, "random": random_pair(seed), "fdi": diagnose, **(rivals or {})}
    answer_all(diagnoses, cases, out, each, stop, code, tell)
    return judged(tuple(diagnoses), cases, out)


def seal(
    cases: int,
    seed: int,
    out: Path,
    rig: Rig | Networks,
    kinds: Sequence[str],
    library: Collection[str] = (),
    leave_out: Sequence[str] = (),
    tell: Tell = lambda share, text: None,
) -> None:
    """Makes what is missing of the first `cases` cases and seals it.

    Raises ValueError where `out` holds another benchmark.
    """
    out.mkdir(parents=True, exist_ok=True)
    spec = {
        "seed": seed,
        "rig": rig.name,
        "kinds": list(kinds),
        "library": sorted(library),
        "leave_out": list(leave_out),
    } | ({"tanks": [rig.fewest, rig.most]} if isinstance(rig, Networks) else {})
    known = out / "spec.json"
    if known.exists() and json.loads(known.read_text()) != spec:
        raise ValueError(f"{out}: expected the benchmark {spec}, got {known.read_text().strip()}; take another folder")
    known.write_text(json.dumps(spec) + "\n")
    done = manifest(out)
    todo = [plan for plan in plans(cases, seed, kinds) if plan.name not in done]
    for at in range(0, len(todo), CHUNK):
        tell(0.0, f"making {min(CHUNK, len(todo) - at)} recordings, about a minute")
        chunk, start = todo[at : at + CHUNK], time.perf_counter()
        write_cases(out, make(chunk, rig, seed, library, leave_out), [token_hex(16) for _ in chunk])
        tell(0.0, f"sealed {len(done) + at + len(chunk)} of {cases} cases in {time.perf_counter() - start:.0f} s")


def answer_all(
    diagnoses: Mapping[str, Diagnosis],
    cases: int,
    out: Path,
    each: Each,
    stop: float,
    code: str,
    tell: Tell,
) -> None:
    """Answers what has no answer yet, case by case, a JSON line each, until the clock says `stop`.

    The key stays shut.
    """
    lines = list(manifest(out).values())[:cases]
    known = {(name, line["case"]) for name in diagnoses for line in lines_of(answers(out, name))}
    todo = [(name, line) for line in lines for name in diagnoses if (name, line["case"]) not in known]
    start, total = time.perf_counter(), len(lines) * len(diagnoses)
    todo = todo if start < stop else []
    for n, (name, found) in enumerate(each(partial(answer, diagnoses, out), todo), start=1):
        append(answers(out, name), json.dumps(found | {"code": code}))
        done, now = total - len(todo) + n, time.perf_counter()
        left = min((now - start) / n * (len(todo) - n), max(stop - now, 0.0))
        said = f"{name} says {found['answer'].get('verdict')} of {found['case']} in {found['sec']:.1f} s"
        tell(done / total, f"{said}; {done} of {total} answers, {_span(left)} left")
        if now > stop:
            break


def _span(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def answer(diagnoses: Mapping[str, Diagnosis], out: Path, task: Task) -> Done:
    """One case by one of them; an exception of the diagnosis is an answer too, and a wrong one."""
    name, line = task
    plant = read_plant(out, line)
    recording, holdout = (read_recording(out, line, part, plant) for part in ("recording", "holdout"))
    options = {"leave_out": tuple(line["leave_out"])} if line["leave_out"] else {}
    start = time.perf_counter()
    try:
        found = diagnoses[name](plant, recording, holdout, **options)
    except Exception as error:  # a crash is scored, not raised: one case must not end the benchmark
        found = {"verdict": "crash", "error": f"{type(error).__name__}: {error}"}
    return name, {"case": line["case"], "sec": round(time.perf_counter() - start, 3), "answer": without_nan(found)}


def without_nan(value: Any) -> Any:
    """NaN and infinities as null: JSON has none."""
    if isinstance(value, Mapping):
        return {k: without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
