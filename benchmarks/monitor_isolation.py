"""What the monitor says about a fault on disturbed tanks: `python -m benchmarks.monitor_isolation --seed 1`.

With `--oracle`, each of its answers is compared with the posterior over the same suspects on the same samples if onset,
course (sudden or growing) and the number of faults are known: what remains is what the readings do not decide.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence

import torch

from benchmarks.monitor_rigs import GROWTH, KINDS, SIZES, Case, recordings
from fdi_torch.config.plant_file import load_plant
from fdi_torch.estimate.evidence import posterior
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.hypothesis import Hypothesis
from fdi_torch.monitor.hypothesis_fit import Prior, fit
from fdi_torch.monitor.monitor_settings import LOOKBACK
from fdi_torch.monitor.monitor_setup import PreparedMonitor, fault_free_part, prepare_monitor
from fdi_torch.monitor.observer_bank import ObserverWindow, no_change
from fdi_torch.monitor.samples import Samples, samples_of_recording
from fdi_torch.recording import Recording

ANSWERS = ("isolated", "explained", "revised")
TWINS = ({"T2.leak.size", "OUT2.plugging.size"},)
"""Faults with the same equations on this plant."""


def events_of(recording: Recording, learn: float, every: float = 20000.0) -> list[Event]:
    """Events after the fault-free part of `learn` s."""
    return followed(*prepared_for(recording, learn, every), learn)


def prepared_for(recording: Recording, learn: float, every: float = 20000.0) -> tuple[PreparedMonitor, Samples]:
    """A monitor that has learnt for `learn` s, and all samples."""
    plant = load_plant("three_tank")
    prepared = prepare_monitor(plant, fault_free_part(recording, 0.0, learn), time_between_false_alarms=every)
    return prepared, samples_of_recording(recording, plant)


def followed(prepared: PreparedMonitor, samples: Samples, learn: float) -> list[Event]:
    state = prepared.monitor.start(samples, prepared.believed, learning_until=learn)
    return prepared.monitor.advance(state, samples.segment(1, len(samples)))[1]


def known_onset_posterior(
    prepared: PreparedMonitor, samples: Samples, case: Case, times: Sequence[float]
) -> list[dict[str, float]]:
    """The probability of each single fault at each of the times, if its onset and course are known."""
    monitor, believed = prepared.monitor, prepared.believed
    observer, start = monitor.observer, case.onset - LOOKBACK
    first = int((samples.time < start).sum())
    state = monitor.start(samples, believed, learning_until=case.lasts)
    state, _ = monitor.advance(state, samples.segment(1, first + 1))
    hypotheses = [Hypothesis((fault.size,), case.ramp > 0.0) for fault in monitor.faults]
    starts = torch.cat([believed, believed.new_tensor([case.onset])]).repeat(len(hypotheses), 1)
    prior, posteriors = Prior(monitor.space.names, len(hypotheses)), []
    for end in times:
        until = int((samples.time <= end).sum())
        window = ObserverWindow(samples.segment(first, until), state.state[-1], state.number, state.memory[-1])
        base = 0.5 * float(observer.white_innovations(window, believed, no_change(believed)).square().sum())
        fits = fit(observer, window, believed, hypotheses, starts, base, prior, known_onset=True)
        names = [monitor.space.names[f.hypothesis.columns[0]] for f in fits]
        posteriors.append(dict(zip(names, posterior([f.evidence for f in fits]), strict=True)))
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


def scored_oracle(case: Case, posteriors: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Counts for the posteriors with known onset, as those of `scored`."""
    count: dict[str, float] = defaultdict(float)
    for probabilities in posteriors:
        groups = {frozenset(twins_of(n)): sum(probabilities[m] for m in twins_of(n)) for n in probabilities}
        held = 0.0
        for rank, group in enumerate(sorted(groups, key=lambda g: -groups[g])):
            count["oracle: in set"] += held < 0.95 and case.name in group
            held += groups[group]
            if rank == 0:
                count["oracle: top"] += case.name in group
                count["oracle: top by its own probability"] += groups[group]
                count["oracle: certain"] += held >= 0.95
                count["oracle: certain, wrong"] += held >= 0.95 and case.name not in group
    return count


def scored(case: Case, events: Sequence[Event]) -> dict[str, float]:
    """Counts of events after the onset. "Nothing beside": the observer uses one fault at most."""
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
    return count


def cases(seed: int, learn: float, faults: Sequence[str], kinds: Sequence[str]) -> list[Case]:
    drawn = [(fault, ramp, kind) for fault in faults for ramp in (0.0, GROWTH) for kind in kinds]
    onset = learn + 300.0
    return [Case(f, r, k, learn, onset, onset + 1600.0, True, 1000 * seed + i) for i, (f, r, k) in enumerate(drawn)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--learn", type=float, default=2000.0)
    parser.add_argument("--faults", nargs="*", default=list(SIZES))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--every", type=int, default=1, help="only each n-th case")
    parser.add_argument("--oracle", action="store_true", help="compare with the posterior for known onsets")
    parser.add_argument("--show", action="store_true", help="print the events")
    a = parser.parse_args()
    chosen = cases(a.seed, a.learn, a.faults, a.kinds)[:: a.every]
    total: dict[str, float] = defaultdict(float)
    started = time.process_time()
    for case, (recording, _) in zip(chosen, recordings(chosen), strict=True):
        prepared, samples = prepared_for(recording, case.learn)
        events = followed(prepared, samples, case.learn)
        count = scored(case, events)
        if a.oracle:
            times = [e.time for e in answers_of(case, events)]
            count |= scored_oracle(case, known_onset_posterior(prepared, samples, case, times))
        for name, number in count.items():
            total[name] += number
        print(f"{case.fault:26} {case.ramp:6.0f} {case.kind:6}", dict(count), flush=True)
        if a.show or count["certain, wrong"]:
            for e in events:
                print("   ", e.line[:230])
    print(dict(total), f"{time.process_time() - started:.0f} s of CPU")


if __name__ == "__main__":
    main()
