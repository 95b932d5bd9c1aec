"""The withheld check: make and seal, diagnose without the key, open, score."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import Any

from fdi_torch.gap.challenge.baselines import Diagnosis, always_null, random_pair
from fdi_torch.gap.challenge.cases import make, plans
from fdi_torch.gap.challenge.files import (
    append,
    lines_of,
    manifest,
    open_key,
    read_recording,
    write_cases,
)
from fdi_torch.gap.challenge.kinds import STANDARD
from fdi_torch.gap.challenge.plants import Rig, three_tank
from fdi_torch.gap.challenge.score import Row, by_effect, judge, summary
from fdi_torch.gap.challenge.table import markdown

Line = Mapping[str, Any]
Each = Callable[[Callable[[Line], dict[str, Any]], Iterable[Line]], Iterable[dict[str, Any]]]
CHUNK = 200


def challenge(
    cases: int,
    seed: int,
    out: Path | str,
    diagnose: Diagnosis,
    *,
    rig: Rig | None = None,
    kinds: Sequence[str] = STANDARD,
    library: Collection[str] = (),
    leave_out: Sequence[str] = (),
    rivals: Mapping[str, Diagnosis] | None = None,
    each: Each = map,
    minutes: float = math.inf,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Scores `diagnose` and its rivals on `cases` recordings, kinds in turn; resumes where it was interrupted.

    diagnose(recording, holdout[, leave_out=(effect,)]) -> answer in the format `fdi_torch.gap/1`.
    library: effects that `diagnose` can name; those are not drawn as unknown.
    leave_out: effects to deny it, one a case.
    rivals: further diagnoses scored beside the two without skill. each: map over cases, for example an executor's.
    minutes: after which no further case is begun; what is answered by then is scored.
    Returns {diagnosis: {stratum: scores}}; the same is in out/scores.json and .md, a row a case in out/rows_NAME.jsonl.
    """
    rig, out = rig or three_tank(), Path(out)
    kinds = ("left_out",) if leave_out else tuple(kinds)
    seal(cases, seed, out, rig, kinds, library, leave_out, tell)
    stop = time.perf_counter() + 60 * minutes
    diagnoses = {"always_null": always_null, "random": random_pair(rig.plant, seed), "fdi": diagnose, **(rivals or {})}
    for name, each_diagnosis in diagnoses.items():
        answer_all(name, each_diagnosis, cases, out, rig, each, stop, tell)
    return score_all(tuple(diagnoses), cases, out, rig)


def seal(
    cases: int,
    seed: int,
    out: Path,
    rig: Rig,
    kinds: Sequence[str],
    library: Collection[str] = (),
    leave_out: Sequence[str] = (),
    tell: Callable[[str], None] = lambda line: None,
) -> None:
    """Makes what is missing of the first `cases` cases and seals it.

    Raises ValueError where `out` holds another challenge.
    """
    out.mkdir(parents=True, exist_ok=True)
    spec = {
        "seed": seed,
        "rig": rig.plant.name,
        "kinds": list(kinds),
        "library": sorted(library),
        "leave_out": list(leave_out),
    }
    known = out / "spec.json"
    if known.exists() and json.loads(known.read_text()) != spec:
        raise ValueError(f"{out}: expected the challenge {spec}, got {known.read_text().strip()}; take another folder")
    known.write_text(json.dumps(spec) + "\n")
    done = manifest(out)
    todo = [plan for plan in plans(cases, seed, kinds) if plan.name not in done]
    for at in range(0, len(todo), CHUNK):
        chunk, start = todo[at : at + CHUNK], time.perf_counter()
        write_cases(out, rig, make(chunk, rig, seed, library, leave_out), [token_hex(16) for _ in chunk])
        tell(f"sealed {len(done) + at + len(chunk)} of {cases} cases, {time.perf_counter() - start:.0f} s")


def answer_all(
    name: str,
    diagnose: Diagnosis,
    cases: int,
    out: Path,
    rig: Rig,
    each: Each,
    stop: float,
    tell: Callable[[str], None],
) -> None:
    """Diagnoses what has no answer yet, a JSON line a case, until the clock says `stop`. The key stays shut."""
    path = out / f"answers_{name}.jsonl"
    done = {line["case"] for line in lines_of(path)}
    todo = [line for line in list(manifest(out).values())[:cases] if line["case"] not in done]
    todo = todo if time.perf_counter() < stop else []
    for n, line in enumerate(each(partial(answer, diagnose, out, rig), todo)):
        append(path, json.dumps(line))
        tell(f"{name} {len(done) + n + 1}/{cases} {line['case']} {line['answer'].get('verdict')} {line['sec']:.1f} s")
        if time.perf_counter() > stop:
            break


def answer(diagnose: Diagnosis, out: Path, rig: Rig, line: Line) -> dict[str, Any]:
    """One case, by its line of the manifest; an exception of the diagnosis is an answer too, and a wrong one."""
    recording, holdout = (read_recording(out, line, part, rig) for part in ("recording", "holdout"))
    options = {"leave_out": tuple(line["leave_out"])} if line["leave_out"] else {}
    start = time.perf_counter()
    try:
        found = diagnose(recording, holdout, **options)
    except Exception as error:  # a crash is scored, not raised: one case must not end the challenge
        found = {"verdict": "crash", "error": f"{type(error).__name__}: {error}"}
    return {"case": line["case"], "sec": round(time.perf_counter() - start, 3), "answer": without_nan(found)}


def without_nan(value: Any) -> Any:
    """NaN and infinities as null: JSON has none."""
    if isinstance(value, Mapping):
        return {k: without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def score_all(names: Sequence[str], cases: int, out: Path, rig: Rig) -> dict[str, Any]:
    """Opens the key, judges all answers."""
    truths, scores = open_key(out), {}
    for name in names:
        wanted = set(list(manifest(out))[:cases])
        rows = [
            _row(line, truths[line["case"]], rig)
            for line in lines_of(out / f"answers_{name}.jsonl")
            if line["case"] in wanted
        ]
        (out / f"rows_{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        scores[name] = summary(rows) | {"by_effect": by_effect(rows)}
    (out / "scores.json").write_text(json.dumps(without_nan(scores), indent=1) + "\n")
    (out / "scores.md").write_text(markdown(scores) + "\n")
    return scores


def _row(line: Mapping[str, Any], truth: Mapping[str, Any], rig: Rig) -> Row:
    judged = judge(truth, line["answer"], rig.plant)
    return {"case": line["case"], "sec": line["sec"], "gap_rms_m": truth["gap_rms_m"]["recording"]} | judged
