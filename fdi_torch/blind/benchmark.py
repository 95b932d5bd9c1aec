"""The blind benchmark: simulate and seal the cases, diagnose them without the key, open the key, score."""

from __future__ import annotations

import json
import math
import time
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np

from fdi_torch.blind.case_drafts import plans
from fdi_torch.blind.cases import answers, append, lines_of, make, manifest, read_plant, read_recording, write_cases
from fdi_torch.blind.kinds import ON_NETWORKS, STANDARD
from fdi_torch.blind.networks import Networks
from fdi_torch.blind.places import effect_places
from fdi_torch.blind.plants import Rig, three_tank
from fdi_torch.blind.scored_rows import Row, judged
from fdi_torch.estimate.uncertainty import plain_value
from fdi_torch.plant.description import PlantDescription
from fdi_torch.progress import Tell, silent
from fdi_torch.recording import Recording

Diagnosis = Callable[..., dict[str, Any]]
Task = tuple[str, Mapping[str, Any]]
"""Name of the diagnosis, and a case's line of the manifest."""
Done = tuple[str, dict[str, Any]]
Each = Callable[[Callable[[Task], Done], Iterable[Task]], Iterable[Done]]
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
    tell: Tell = silent,
) -> list[Row]:
    """Let `diagnose` and competing methods answer `cases` recordings; an interrupted benchmark is resumed.

    diagnose(plant, recording, holdout[, leave_out=(effect,)]) -> answer in the format `fdi_torch.gap/2`. rig:
    one rig, or random networks. kinds: of cases, by default the usual ones for the rig. library: effects that
    `diagnose` can name; they are not drawn as unknown laws. leave_out: effects to remove from its library, one per
    case. rivals: further diagnoses, in addition to two trivial ones. each: map over tasks, for example that of an
    executor. minutes: no case is started after that time, and only answered cases are scored. code: state of the code,
    stored with each answer. tell(share, text): progress. Returns one scored row per answer; see `scored_rows`.
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
    tell: Tell = silent,
) -> None:
    """Simulate and seal the missing ones of the first `cases` cases.

    Raises ValueError if `out` contains another benchmark.
    """
    out.mkdir(parents=True, exist_ok=True)
    spec = {
        "seed": seed,
        "rig": rig.name,
        "kinds": list(kinds),
        "library": sorted(library),
        "leave_out": list(leave_out),
    } | ({"tanks": [rig.fewest, rig.most]} if isinstance(rig, Networks) else {})
    stored = out / "spec.json"
    if stored.exists() and json.loads(stored.read_text()) != spec:
        raise ValueError(f"{out}: expected the benchmark {spec}, got {stored.read_text().strip()}; take another folder")
    stored.write_text(json.dumps(spec) + "\n")
    done = manifest(out)
    todo = [plan for plan in plans(cases, seed, kinds) if plan.name not in done]
    for at in range(0, len(todo), CHUNK):
        tell(0.0, f"making {min(CHUNK, len(todo) - at)} recordings, about a minute")
        chunk, start = todo[at : at + CHUNK], time.perf_counter()
        write_cases(out, make(chunk, rig, seed, library, leave_out), [token_hex(16) for _ in chunk])
        tell(0.0, f"sealed {len(done) + at + len(chunk)} of {cases} cases in {time.perf_counter() - start:.0f} s")


def answer_all(
    diagnoses: Mapping[str, Diagnosis], cases: int, out: Path, each: Each, stop: float, code: str, tell: Tell
) -> None:
    """Diagnose the cases without an answer, one JSON line each, until the time `stop`. The key stays sealed."""
    lines = list(manifest(out).values())[:cases]
    answered = {(name, line["case"]) for name in diagnoses for line in lines_of(answers(out, name))}
    todo = [(name, line) for line in lines for name in diagnoses if (name, line["case"]) not in answered]
    start, total = time.perf_counter(), len(lines) * len(diagnoses)
    todo = todo if start < stop else []
    for n, (name, result) in enumerate(each(partial(answer, diagnoses, out), todo), start=1):
        append(answers(out, name), json.dumps(result | {"code": code}))
        done, now = total - len(todo) + n, time.perf_counter()
        remaining = min((now - start) / n * (len(todo) - n), max(stop - now, 0.0))
        left = f"{remaining:.0f} s" if remaining < 100 else f"{remaining / 60:.0f} min"
        text = f"{name} says {result['answer'].get('verdict')} of {result['case']} in {result['sec']:.1f} s"
        tell(done / total, f"{text}; {done} of {total} answers, {left} left")
        if now > stop:
            break


def answer(diagnoses: Mapping[str, Diagnosis], out: Path, task: Task) -> Done:
    """The answer of one diagnosis to one case; an exception counts as a wrong answer."""
    name, line = task
    plant = read_plant(out, line)
    recording, holdout = (read_recording(out, line, part, plant) for part in ("recording", "holdout"))
    options = {"leave_out": tuple(line["leave_out"])} if line["leave_out"] else {}
    start = time.perf_counter()
    try:
        result = diagnoses[name](plant, recording, holdout, **options)
    except Exception as error:  # scored, not raised: one crash must not end the benchmark
        result = {"verdict": "crash", "error": f"{type(error).__name__}: {error}"}
    sec = round(time.perf_counter() - start, 3)
    return name, {"case": line["case"], "sec": sec, "answer": plain_value(result, name)}


def always_null(plant: PlantDescription, recording: Recording, holdout: Recording, **options: Any) -> dict[str, Any]:
    """Always answers that there is no gap."""
    return {"verdict": "no_gap", "where": [], "causes": [], "ambiguity_set": [], "posterior": []}


def random_pair(seed: int) -> Diagnosis:
    """Names a random effect and location; the same for the same recording."""

    def diagnose(plant: PlantDescription, recording: Recording, holdout: Recording, **options: Any) -> dict[str, Any]:
        pairs = effect_places(plant)
        rng = np.random.default_rng([seed, zlib.crc32(recording.sha256.encode())])
        effect, place = pairs[int(rng.integers(len(pairs)))]
        cause = {"effect": effect, "location": place}
        return {"verdict": "named", "where": [{"location": place, "share": 1.0}], "causes": [cause]} | {
            "ambiguity_set": [[cause]],
            "posterior": [{"causes": [cause], "probability": 1.0}],
        }

    return diagnose
