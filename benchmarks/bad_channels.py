"""What `fdi gap` says where the rig is sound and a channel of its recording is not: frozen, dead, swapped, mis-scaled,
shifted in time or random.

    python -m benchmarks.bad_channels --cases 200 --seed 1 --write benchmarks/bad_channels.md

Three rigs of the blind benchmark, by its own simulator, without any fault; constants within their tolerances. Each
kind of bad channel comes at every sensor in turn. An answer is *right* where it names the sensor as stuck, or the
recording is refused with a sentence that names the channel and what is wrong with it; *unknown at the sensor* is as
good. A physical cause named at 95 % is *confident nonsense*.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

from fdi_torch.blind.case_drafts import plans
from fdi_torch.blind.cases import Case, make
from fdi_torch.blind.inputs import FACTORS, command_unit
from fdi_torch.blind.plants import RIGS
from fdi_torch.gap.diagnose import diagnose
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

SHOWN = 1e-5  # m: the last digit of a level in the file


@dataclass(frozen=True)
class Bad:
    """A recording with a bad channel. words: one of them has to be in the sentence of a refusal."""

    kind: str
    rig: str
    plant: PlantDescription
    recording: Recording
    channels: tuple[str, ...]
    words: tuple[str, ...]


def sound(case: Case) -> Recording:
    """The recording of a blind case, as its CSV file has it, in SI."""
    plant = case.rig.plant
    pumps = {p.channel: p for p in reversed(plant.pumps)}
    factors = [FACTORS[command_unit(pumps[channel])] for channel in plant.channels()]
    readings = torch.from_numpy(case.readings[0] / SHOWN).round() * SHOWN
    time, commands = torch.arange(len(readings), dtype=torch.float64), case.commands[0] * np.array(factors)
    return plant.recording(time, torch.from_numpy(commands), readings)


Spoil = Callable[[Recording, int, PlantDescription, np.random.Generator], Recording]


def with_channel(recording: Recording, sensor: int, values: torch.Tensor) -> Recording:
    outputs = recording.outputs.clone()
    outputs[:, sensor] = values
    return replace(recording, outputs=outputs)


def frozen(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    return with_channel(r, i, r.outputs[0, i].expand(len(r)))


def frozen_from_the_middle(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    onset = int(rng.uniform(0.2, 0.8) * len(r))
    values = r.outputs[:, i].clone()
    values[onset:] = values[onset]
    return with_channel(r, i, values)


def dead(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    return with_channel(r, i, torch.zeros(len(r), dtype=torch.float64))


def dead_from_the_middle(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    values = r.outputs[:, i].clone()
    values[int(rng.uniform(0.2, 0.8) * len(r)) :] = 0.0
    return with_channel(r, i, values)


def swapped(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    other = (i + 1 + int(rng.integers(len(plant.sensors) - 1))) % len(plant.sensors)
    outputs = r.outputs.clone()
    outputs[:, [i, other]] = outputs[:, [other, i]]
    return replace(r, outputs=outputs)


def scaled(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    factor = 10.0 ** (int(rng.integers(1, 4)) * int(rng.choice([-1, 1])))
    return with_channel(r, i, factor * r.outputs[:, i])


def shifted(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    """The clock of all readings, 15 to 300 s early or late; what is not known at the end is cut off."""
    by = int(rng.integers(15, 300)) * int(rng.choice([-1, 1]))
    early, late = (by, len(r)) if by > 0 else (0, len(r) + by)
    moved = replace(r.stretch(early, late), outputs=r.outputs[early - by : late - by], ran=frozenset())
    return replace(moved, mask=torch.isfinite(moved.outputs), time=moved.time - moved.time[0])


def shifted_channel(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    """One sensor reads 15 to 300 s ahead of the others."""
    by = int(rng.integers(15, 300))
    values = torch.cat([r.outputs[by:, i], torch.full((by,), torch.nan, dtype=torch.float64)])
    moved = with_channel(r, i, values).stretch(0, len(r) - by)
    return replace(moved, mask=torch.isfinite(moved.outputs))


def random(r: Recording, i: int, plant: PlantDescription, rng: np.random.Generator) -> Recording:
    rim = next(t.height for t in plant.tanks if t.name == plant.sensors[i].tank)
    return with_channel(r, i, torch.from_numpy(rng.uniform(0.0, rim, len(r)) / SHOWN).round() * SHOWN)


STUCK, CLOCK = ("stuck", "constant", "does not move"), ("clock", "ahead", "late")
KINDS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "frozen": (frozen, STUCK),
    "frozen from the middle": (frozen_from_the_middle, STUCK),
    "dead": (dead, STUCK),
    "dead from the middle": (dead_from_the_middle, STUCK),
    "swapped": (swapped, ("swapped",)),
    "mis-scaled": (scaled, ("unit",)),
    "clock shifted": (shifted, CLOCK),
    "channel shifted": (shifted_channel, CLOCK),
    "random": (random, ("follow",)),
}


def cases(count: int, seed: int) -> Iterator[Bad]:
    """Rigs and kinds in turn, each kind at every sensor of each rig in turn."""
    names = list(RIGS)
    rounds = -(-count // (len(KINDS) * len(names)))
    made = {name: make(plans(rounds * len(KINDS), seed, ("null",)), RIGS[name](), seed) for name in names}
    for number in range(count):
        turn, at = divmod(number, len(KINDS) * len(names))
        (kind, (spoil, words)), name = list(KINDS.items())[at // len(names)], names[at % len(names)]
        case = made[name][turn * len(KINDS) + at // len(names)]
        plant = case.rig.plant
        sensor = (turn + at // len(names)) % len(plant.sensors)
        before = sound(case)
        after = spoil(before, sensor, plant, np.random.default_rng([seed, number]))
        changed = [
            s.column
            for s, x, y in zip(plant.sensors, before.outputs.T, after.outputs.T, strict=True)
            if len(x) != len(y) or not torch.equal(x, y)
        ]
        if kind == "channel shifted":
            changed = [plant.sensors[sensor].column]
        yield Bad(
            kind, name, plant, after, ("readings", *changed) if kind == "clock shifted" else tuple(changed), words
        )


def judged(bad: Bad) -> tuple[str, str]:
    """Class of the answer, and the answer in short."""
    try:
        answer = diagnose(bad.plant, bad.recording)
    except ValueError as error:
        text = str(error)
        good = any(w in text for w in bad.words) and any(c in text for c in bad.channels)
        return ("refused" if good else "refused otherwise"), text
    except Exception as error:  # one case must not end the benchmark; it counts as a miss
        return "crash", f"{type(error).__name__}: {error}"
    causes = [(c.effect, c.location) for c in answer.causes]
    short = f"{answer.verdict}: {causes}; {[r for r in answer.remarks if any(w in r for w in bad.words)]}"
    at_sensor = [c for c in causes if c[1] in bad.channels and c[0] in ("sensor_stuck", "unknown")]
    elsewhere = [c for c in causes if c not in at_sensor]
    if answer.verdict == "unknown" and answer.where and answer.where[0][0] in bad.channels and not elsewhere:
        return "unknown at the sensor", short
    if at_sensor and not elsewhere and answer.verdict == "named":
        return "named right", short
    certain = [c for c in answer.certain if c not in at_sensor and c[0] != "unknown"]
    if answer.verdict == "named" and certain:
        return "confident nonsense", short
    return ("missed" if answer.verdict == "no_gap" else "unsure"), short


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bad_channels", description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--skip", type=int, default=0, help="cases that are not asked")
    parser.add_argument("--write", help="file for the table; rows go beside it as JSON lines")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    for number, bad in enumerate(cases(arguments.cases, arguments.seed)):
        if number < arguments.skip:
            continue
        begun = time.perf_counter()
        found, short = judged(bad)
        table[bad.kind][found] += 1
        row = {"case": number, "kind": bad.kind, "rig": bad.rig, "channels": bad.channels, "found": found}
        row |= {"answer": short, "seconds": round(time.perf_counter() - begun, 2)}
        print(json.dumps(row), flush=True)
        if arguments.write:
            with Path(arguments.write).with_suffix(".jsonl").open("a") as file:
                file.write(json.dumps(row) + "\n")
    text = "\n".join(lines(table)) + "\n"
    sys.stdout.write(text)
    if arguments.write:
        head = f"`python -m benchmarks.bad_channels --cases {arguments.cases} --seed {arguments.seed}`\n\n"
        Path(arguments.write).write_text(head + text)


def lines(table: dict[str, Counter[str]]) -> Iterator[str]:
    """A row a kind, in Markdown."""
    good = ("refused", "named right", "unknown at the sensor")
    bad = ("refused otherwise", "unsure", "missed", "crash", "confident nonsense")
    yield "| bad channel | cases | " + " | ".join((*good, *bad)) + " |"
    yield "|---" * (2 + len(good) + len(bad)) + "|"
    everything = sum(table.values(), Counter())
    for kind, counts in (*table.items(), ("all", everything)):
        yield f"| {kind} | {counts.total()} | " + " | ".join(str(counts[c]) for c in (*good, *bad)) + " |"
    total = max(everything.total(), 1)
    share, nonsense = sum(everything[c] for c in good) / total, everything[bad[-1]] / total
    yield f"\nRight, refused or unknown at the sensor: {share:.1%}; confident nonsense: {nonsense:.1%}"


if __name__ == "__main__":
    main()
