"""What the monitor says about a fault on disturbed tanks: `python -m benchmarks.monitor_isolation --seed 1`.

With `--oracle`, each of its answers is compared with two posteriors on the same samples: over the same suspects if
onset, course (sudden or growing) and the number of faults are known, and over the injected faults if their sizes are
known too. What remains is what the readings do not decide. With `--from-prior N`, N faults and their sizes are
drawn from the prior of the monitor, so that its probabilities must be the frequencies with which it is right; with
`--growing` beside it the times of their growth, and with `--growing S` they reach these sizes within S seconds. With
`--listed K` beside it, each monitor has K suspects only, and each second fault is none of them. `--tolerance`,
`--rests`, `--flows` and `--calibrate` are those of `monitor_false_alarms`.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from benchmarks.monitor_rigs import GROWTH, KINDS, SIZES, Case, recordings
from fdi_torch.config.plant_file import load_plant
from fdi_torch.estimate.evidence import posterior
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.hypothesis import Hypothesis
from fdi_torch.monitor.hypothesis_fit import Prior, fit
from fdi_torch.monitor.monitor_settings import LOOKBACK, usual_settings
from fdi_torch.monitor.monitor_setup import PreparedMonitor, fault_free_part, prepare_monitor
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverWindow, no_change
from fdi_torch.monitor.samples import Samples, samples_of_recording
from fdi_torch.recording import Recording

ANSWERS = ("isolated", "explained", "revised")
TWINS = ({"T2.leak.size", "OUT2.plugging.size"},)
"""Faults with the same equations on this plant."""


def events_of(recording: Recording, learn: float, every: float = 20000.0) -> list[Event]:
    """Events after the fault-free part of `learn` s."""
    return followed(*prepared_for(recording, learn, every), learn)


def prepared_for(
    recording: Recording,
    learn: float,
    every: float = 20000.0,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    listed: Sequence[str] = (),
    calibrate: bool = False,
) -> tuple[PreparedMonitor, Samples]:
    """A monitor that has learnt for `learn` s, and all samples.

    ranges: of faults, the usual ones by default. listed: the monitor's suspects, by default those with ranges.
    calibrate: the constants that have a tolerance.
    """
    plant, suspects = load_plant("three_tank"), list(listed or ranges or {})
    known = fault_free_part(recording, 0.0, learn)
    constants = sorted(plant.tolerances) if calibrate else ()
    prepared = prepare_monitor(plant, known, suspects, constants, time_between_false_alarms=every, ranges=ranges)
    return prepared, samples_of_recording(recording, plant)


def followed(prepared: PreparedMonitor, samples: Samples, learn: float) -> list[Event]:
    state = prepared.monitor.start(samples, prepared.believed, learning_until=learn)
    return prepared.monitor.advance(state, samples.segment(1, len(samples)))[1]


def windows(
    prepared: PreparedMonitor, samples: Samples, case: Case, times: Sequence[float]
) -> Iterator[ObserverWindow]:
    """The windows that begin before the onset and end at each of the times."""
    monitor, start = prepared.monitor, case.onset - LOOKBACK
    first = int((samples.time < start).sum())
    state = monitor.start(samples, prepared.believed, learning_until=case.lasts)
    state, _ = monitor.advance(state, samples.segment(1, first + 1))
    for end in times:
        until = int((samples.time <= end).sum())
        yield ObserverWindow(samples.segment(first, until), state.state[-1], state.number, state.memory[-1])


def known_onset_posterior(
    prepared: PreparedMonitor, samples: Samples, case: Case, times: Sequence[float]
) -> list[dict[str, float]]:
    """The probability of each single fault at each of the times, if its onset and course are known."""
    monitor, believed, observer = prepared.monitor, prepared.believed, prepared.monitor.observer
    hypotheses = [Hypothesis((fault.size,), case.ramp > 0.0) for fault in monitor.faults]
    starts = torch.cat([believed, believed.new_tensor([case.onset])]).repeat(len(hypotheses), 1)
    prior, posteriors = Prior(monitor.space.names, len(hypotheses), monitor.settings.growth_times), []
    for window in windows(prepared, samples, case, times):
        base = 0.5 * float(observer.white_innovations(window, believed, no_change(believed)).square().sum())
        fits = fit(observer, window, believed, hypotheses, starts, base, prior, known_onset=True)
        names = [monitor.space.names[f.hypothesis.columns[0]] for f in fits]
        posteriors.append(dict(zip(names, posterior([f.evidence for f in fits]), strict=True)))
    return posteriors


def known_size_posterior(
    prepared: PreparedMonitor, samples: Samples, case: Case, times: Sequence[float]
) -> list[dict[str, float]]:
    """The probability of each injected fault at each of the times, if its onset, course and size are known."""
    space, believed, observer = prepared.monitor.space, prepared.believed, prepared.monitor.observer
    rivals = [replace(case, fault=fault, share=1.0) for fault in SIZES]
    posteriors = []
    for end, window in zip(times, windows(prepared, samples, case, times), strict=True):
        theta = torch.stack([space.vector({r.name: r.size_at(end)}) for r in rivals])
        onsets, incipient = theta.new_full((len(rivals),), case.onset), torch.full((len(rivals),), case.ramp > 0.0)
        white = observer.white_innovations(window, believed, ChangeHypotheses(theta, onsets, incipient))
        total: dict[str, float] = defaultdict(float)
        for rival, p in zip(rivals, posterior((-0.5 * white.square().sum((1, 2))).tolist()), strict=True):
            total[rival.name] += p
        posteriors.append(total)
    return posteriors


def twins_of(name: str) -> set[str]:
    """The faults with the same equations."""
    return next((twins for twins in TWINS if name in twins), {name})


def is_true(names: Sequence[str], fault: str) -> bool:
    """Whether an explanation is the fault, or one with the same equations."""
    return len(names) == 1 and names[0] in twins_of(fault)


def answers_of(case: Case, events: Sequence[Event]) -> list[Event]:
    """The events after the onset that name causes."""
    return [e for e in events if e.kind in ANSWERS and e.time >= case.onset and e.explanations]


def scored_oracle(case: Case, posteriors: Sequence[Mapping[str, float]], known: str) -> dict[str, float]:
    """Counts for posteriors with known onsets or sizes, as those of `scored`."""
    count: dict[str, float] = defaultdict(float)
    for probabilities in posteriors:
        groups = {frozenset(twins_of(n)): sum(probabilities.get(m, 0.0) for m in twins_of(n)) for n in probabilities}
        held = 0.0
        for rank, group in enumerate(sorted(groups, key=lambda g: -groups[g])):
            count[f"known {known}: in set"] += held < 0.95 and case.name in group
            held += groups[group]
            if rank == 0:
                count[f"known {known}: top"] += case.name in group
                count[f"known {known}: top by its own probability"] += groups[group]
                count[f"known {known}: certain"] += held >= 0.95
                count[f"known {known}: certain, wrong"] += held >= 0.95 and case.name not in group
    return count


def scored(case: Case, events: Sequence[Event]) -> dict[str, float]:
    """Counts of events after the onset. "Nothing beside": the observer uses one fault at most. Means of the run: the
    events of one run are not independent, and a few runs have most of them.
    """
    count: dict[str, float] = defaultdict(float)
    count["runs"], count["early"] = 1, sum(e.kind == "alarm" and e.time < case.onset for e in events)
    count["detected"] = any(e.kind == "alarm" and e.time >= case.onset for e in events)
    for e in answers_of(case, events):
        held = any(is_true(x.names, case.name) for x in e.explanations)
        count["events"] += 1
        count["nothing beside"] += len(e.believed) <= 1
        count["in set"] += held
        count["top"] += is_true(e.faults, case.name)
        first = [
            x for x in e.explanations if x.names == e.faults or (len(e.faults) == 1 and is_true(x.names, e.faults[0]))
        ]
        count["top by its own probability"] += sum(x.mass for x in first)
        count["certain, wrong"] += not held and str(e.state) == "isolated"
        count["certain"] += str(e.state) == "isolated"
        count["certain by its own probability"] += first[0].mass * (str(e.state) == "isolated")
        if e.faults == (case.name,):
            [size] = first[0].sizes
            count["sizes"] += 1
            count["sizes within three standard errors"] += abs(size.size - case.size_at(e.time)) <= 3.0 * size.std
    count["runs with nothing beside"] = count["events"] == count["nothing beside"]
    for name in ("top", "top by its own probability"):
        count[f"{name}, mean of the run"] = count[name] / max(count["events"], 1.0)
    return count


def suspects_of(case: Case, faults: Sequence[str], count: int, outside: bool) -> list[str]:
    """A list of `count` suspects, with the fault of the case or, if `outside`, without it and its twins."""
    others = [f for f in faults if f not in twins_of(case.name)]
    drawn = np.random.default_rng(case.seed).permutation(others).tolist()
    return drawn[:count] if outside else [case.name, *drawn[: count - 1]]


def scored_list(case: Case, events: Sequence[Event], outside: bool) -> dict[str, float]:
    """Counts of events with explanations: does the likeliest one name the fault, or a cause that is not on the list?"""
    count: dict[str, float] = defaultdict(float)
    kind = "outside" if outside else "listed"
    answers = [e for e in events if e.kind in (*ANSWERS, "cannot tell") and e.time >= case.onset and e.explanations]
    for e in answers:
        right = [x.unlisted if outside else is_true(x.names, case.name) for x in e.explanations]
        count[f"{kind}: events"] += 1
        count[f"{kind}: in set"] += any(right)
        count[f"{kind}: first right"] += right[0]
        count[f"{kind}: first by its own probability"] += e.explanations[0].mass
        count[f"{kind}: certain, wrong"] += str(e.state) == "isolated" and not right[0]
        count[f"{kind}: probability of a cause not on the list"] += sum(x.mass for x in e.explanations if x.unlisted)
    if answers:
        count[f"{kind}: runs"], count[f"{kind}: last right"] = 1, right[0]
    return count


def cases(seed: int, learn: float, faults: Sequence[str], kinds: Sequence[str]) -> list[Case]:
    drawn = [(fault, ramp, kind) for fault in faults for ramp in (0.0, GROWTH) for kind in kinds]
    onset = learn + 300.0
    return [Case(f, r, k, learn, onset, onset + 1600.0, True, 1000 * seed + i) for i, (f, r, k) in enumerate(drawn)]


RANGES = {
    "leak.size": (0.0, 0.3), "plugging.size": (-0.3, 0.3), "pump_gain.factor": (0.7, 1.3),
    "pump_offset.offset": (-1.35e-5, 1.35e-5), "sensor_bias.bias": (-0.1, 0.1), "sensor_gain.factor": (0.8, 1.2),
}  # fmt: skip
"""Of the sizes that are drawn, 0.2 to 0.3 of the usual ranges, so that no tank overflows or runs dry."""


def cases_from_prior(
    seed: int, learn: float, count: int, growth: float | None = 0.0
) -> tuple[list[Case], dict[str, tuple[float, float]]]:
    """Faults with sizes from a monitor's prior, and the ranges that this monitor has.

    growth: duration of growth, s; if None, the time in which a fault passes through its range is drawn from the prior
    too, and the recording ends with this time.
    """
    times = usual_settings(load_plant("three_tank")).growth_times
    ranges = {f: RANGES[f.partition(".")[2]] for f in SIZES if " " not in f}
    rng, names, drawn = np.random.default_rng(seed), list(ranges), []
    for i in range(count):
        fault = names[rng.integers(len(names))]
        size, ramp, lasts = rng.uniform(*ranges[fault]) - fault.endswith(".factor"), growth, 1600.0
        if ramp is None:
            size = ranges[fault][size > 0.0] - fault.endswith(".factor")
            ramp = float(np.exp(rng.uniform(*np.log(times))))
            lasts = min(ramp, lasts)
        kind, share, onset = list(KINDS)[i % 3], size / SIZES[fault], learn + 300.0
        drawn.append(Case(fault, ramp, kind, learn, onset, onset + lasts, True, 1000 * seed + i, share))
    return drawn, ranges


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--learn", type=float, default=2000.0)
    parser.add_argument("--faults", nargs="*", default=list(SIZES))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--every", type=int, default=1, help="only each n-th case")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--from-prior", type=int, default=0, help="draw that many cases from the monitor's prior")
    parser.add_argument("--growing", type=float, nargs="?", default=0.0, help="these grow, to their size in so many s")
    parser.add_argument("--listed", type=int, default=0, help="number of suspects, beside --from-prior")
    parser.add_argument("--tolerance", type=float, default=0.0, help="errors of the constants, in their tolerances")
    parser.add_argument("--rests", action="store_true", help="inputs rest during the learning part")
    parser.add_argument("--flows", type=float, default=1.0, help="random flows, as a share of the usual ones")
    parser.add_argument("--calibrate", action="store_true", help="the constants that have a tolerance")
    parser.add_argument("--oracle", action="store_true", help="compare with posteriors for known onsets and sizes")
    parser.add_argument("--show", action="store_true", help="print the events")
    a = parser.parse_args()
    if a.from_prior:
        chosen, ranges = cases_from_prior(a.seed, a.learn, a.from_prior, a.growing)
    else:
        chosen, ranges = cases(a.seed, a.learn, a.faults, a.kinds)[a.first :: a.every], {}
    chosen = [replace(case, tolerance=a.tolerance, rests=a.rests, flows=a.flows) for case in chosen]
    total: dict[str, float] = defaultdict(float)
    started = time.process_time()
    for k, (case, (recording, _)) in enumerate(zip(chosen, recordings(chosen), strict=True)):
        listed = suspects_of(case, list(ranges), a.listed, k % 2 == 1) if a.listed else []
        prepared, samples = prepared_for(recording, case.learn, ranges=ranges, listed=listed, calibrate=a.calibrate)
        events = followed(prepared, samples, case.learn)
        count = scored_list(case, events, k % 2 == 1) if a.listed else scored(case, events)
        if a.oracle:
            times = [e.time for e in answers_of(case, events)]
            count |= scored_oracle(case, known_onset_posterior(prepared, samples, case, times), "onset")
            if not a.from_prior:
                count |= scored_oracle(case, known_size_posterior(prepared, samples, case, times), "size")
        for name, number in count.items():
            total[name] += number
        print(f"{case.fault:26} {case.ramp:6.0f} {case.kind:6}", dict(count), flush=True)
        if a.show or count["certain, wrong"] or count["listed: certain, wrong"] + count["outside: certain, wrong"]:
            for e in events:
                print("   ", e.line[:230])
    print(dict(total), f"{time.process_time() - started:.0f} s of CPU")


if __name__ == "__main__":
    main()
