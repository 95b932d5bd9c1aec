"""What the monitor says about a fault on disturbed tanks: `python -m benchmarks.monitor_isolation --seed 1`."""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Sequence

from benchmarks.monitor_rigs import GROWTH, KINDS, SIZES, Case, recordings
from fdi_torch.config.plant_file import load_plant
from fdi_torch.monitor.events import Event
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.samples import samples_of_recording
from fdi_torch.recording import Recording

ANSWERS = ("isolated", "explained", "revised")
TWINS = ({"T2.leak.size", "OUT2.plugging.size"},)
"""Faults with the same equations on this plant."""


def events_of(recording: Recording, learn: float, every: float = 20000.0) -> list[Event]:
    """Events after the fault-free part of `learn` s."""
    plant = load_plant("three_tank")
    prepared = prepare_monitor(plant, fault_free_part(recording, 0.0, learn), time_between_false_alarms=every)
    samples = samples_of_recording(recording, plant)
    state = prepared.monitor.start(samples, prepared.believed, learning_until=learn)
    return prepared.monitor.advance(state, samples.segment(1, len(samples)))[1]


def is_true(names: Sequence[str], fault: str) -> bool:
    """Whether an explanation is the fault, or one with the same equations."""
    same = next((twins for twins in TWINS if fault in twins), {fault})
    return len(names) == 1 and names[0] in same


def scored(case: Case, events: Sequence[Event]) -> dict[str, float]:
    """Counts of events after the onset."""
    count: dict[str, float] = defaultdict(float)
    count["runs"], count["early"] = 1, sum(e.kind == "alarm" and e.time < case.onset for e in events)
    count["detected"] = any(e.kind == "alarm" and e.time >= case.onset for e in events)
    for e in events:
        if e.kind not in ANSWERS or e.time < case.onset or not e.explanations:
            continue
        held = any(is_true(x.names, case.name) for x in e.explanations)
        count["events"] += 1
        count["in set"] += held
        count["top"] += is_true(e.faults, case.name)
        first = [
            x for x in e.explanations if x.names == e.faults or (len(e.faults) == 1 and is_true(x.names, e.faults[0]))
        ]
        count["top by its own probability"] += sum(x.mass for x in first)
        count["certain, wrong"] += not held and str(e.state) == "isolated"
        count["certain"] += str(e.state) == "isolated"
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
    parser.add_argument("--show", action="store_true", help="print the events")
    a = parser.parse_args()
    chosen = cases(a.seed, a.learn, a.faults, a.kinds)[:: a.every]
    total: dict[str, float] = defaultdict(float)
    started = time.process_time()
    for case, (recording, _) in zip(chosen, recordings(chosen), strict=True):
        events = events_of(recording, case.learn)
        count = scored(case, events)
        for name, number in count.items():
            total[name] += number
        print(f"{case.fault:26} {case.ramp:6.0f} {case.kind:6}", dict(count), flush=True)
        if a.show or count["certain, wrong"]:
            for e in events:
                print("   ", e.line[:230])
    print(dict(total), f"{time.process_time() - started:.0f} s of CPU")


if __name__ == "__main__":
    main()
