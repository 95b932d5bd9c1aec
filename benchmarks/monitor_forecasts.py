"""Whether the stated interval of the time to overflow or to a dry tank holds it.

`python -m benchmarks.monitor_forecasts`. Pipes are plugged until a tank overflows, or a tank leaks while the pumps
deliver little. After the fault nothing changes. A tank for which a limit is told but that does not reach it within the
horizon counts too: "never" must then be in the interval.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

from benchmarks.monitor_isolation import events_of
from benchmarks.monitor_rigs import KINDS, SIZES, Case, recordings
from fdi_torch.blind.deviation import Array
from fdi_torch.config.plant_file import load_plant
from fdi_torch.monitor.event_text import FORECAST_WINDOWS
from fdi_torch.monitor.level_forecast import EMPTY
from fdi_torch.monitor.monitor_settings import LONGEST

LEARN, ONSET = 1000.0, 1300.0
HORIZON = FORECAST_WINDOWS * LONGEST
LATEST = 2000.0
"""Latest event that counts, s: its whole horizon is simulated."""
LASTS = LATEST + HORIZON


def drawn(seed: int, count: int) -> list[Case]:
    rng, chosen = np.random.default_rng(seed), []
    for i in range(count):
        kind = list(KINDS)[i % 3]
        if i % 2:
            fault, size = str(rng.choice(["P13.plugging.size", "P32.plugging.size", "OUT2.plugging.size"])), (0.4, 0.8)
            pumps = (5e-5, 5e-5)
        else:
            fault, size = str(rng.choice(["T1.leak.size", "T2.leak.size", "T3.leak.size"])), (0.3, 1.5)
            pumps = (3e-6, 3e-6)
        share = rng.uniform(*size) / SIZES[fault]
        chosen.append(Case(fault, 0.0, kind, LEARN, ONSET, LASTS, False, 1000 * seed + i, share, pumps))
    return chosen


def reached(levels: Array, what: str) -> Array:
    """When each tank first overflows or is dry, (tanks,) s; infinite if it is not."""
    heights = np.array([tank.height for tank in load_plant("three_tank").tanks])
    past = levels >= heights if what == "overflows" else levels <= EMPTY * heights
    return np.where(past.any(0), past.argmax(0), math.inf)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=100)
    a = parser.parse_args()
    cases, tanks = drawn(a.seed, a.count), ["T1", "T2", "T3"]
    held = told = missed = early = late = 0
    widths = []
    for case, (recording, levels) in zip(cases, recordings(cases, step=0.25), strict=True):
        true = {what: reached(levels, what) for what in ("overflows", "runs dry")}
        end = min(min(times) for times in true.values())
        until = int(min(end, LATEST)) - 1
        events = events_of(replace(recording.window(0.0, until)), case.learn) if until > ONSET else []
        answer = next((e for e in events if e.kind in ("isolated", "explained") and e.time > ONSET), None)
        if answer is None:
            continue
        for what, times in true.items():
            for tank, time in zip(tanks, times - answer.time, strict=True):
                time = time if time <= HORIZON else math.inf
                limit = next((x for x in answer.limits if (x.tank, x.what) == (tank, what)), None)
                if limit is None:
                    missed += math.isfinite(time)
                    continue
                told, held = told + 1, held + (limit.low <= time <= limit.high)
                early, late = early + (time < limit.low), late + (time > limit.high)
                if math.isfinite(time):
                    widths.append((min(limit.high, HORIZON) - limit.low) / time)
    print(f"{held} of {told} held, {early} before and {late} after the interval, {missed} not told; ", end="")
    print(f"width over time, median {np.median(widths):.2f}" if widths else "none")


if __name__ == "__main__":
    main()
