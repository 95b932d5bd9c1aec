"""`python -m benchmarks [PART ...] [--seconds S] [--write FILE]`: tables in Markdown."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

from benchmarks import (  # noqa: E402
    logging,
    machine,
    monitoring,
    networks,
    noise,
    precision,
    rates,
    scaling,
    search,
    speed,
    startup,
    threads,
)

PARTS = {
    "speed": ("Trajectories per CPU second, 1000 s in 10 s RK4 steps, float64", speed),
    "precision": ("Trajectories per CPU second at a given worst error, 1000 random faults", precision),
    "scaling": ("Sums over the samples, fused with the simulation: many lanes, sensitivities, memory", scaling),
    "threads": ("Wall-clock time with one thread and with two, three tanks, sums over the samples", threads),
    "networks": ("Large networks: a simulated hour, and the compiler's time, once a plant", networks),
    "rates": ("Rates and all their slopes at 1200 steps, by one trace of the equations", rates),
    "search": ("CPU seconds to find a noise-free 5-parameter fault to 1e-6", search),
    "noise": ("1000 noise draws of one fault, estimated", noise),
    "monitoring": ("The monitor on three tanks, beside the time that samples take to come", monitoring),
    "logging": ("CPU seconds of a job, and of what it logs", logging),
    "startup": ("CPU seconds before anything happens: imports and help", startup),
}


NOTES = """# Benchmarks

One command compares fdi_torch with other tools on the same work, on one machine; parts of it can be named:

    pip install -e '.[benchmarks]' && python -m benchmarks --write benchmarks/README.md

The peers' equations are written by hand in `physics.py`; each run checks that they give the same levels to 1e-9 m.
`numba, blocks of lanes` is no separate tool: it is the layout of our kernel (trajectories side by side), written by
hand. Our kernel is faster for three reasons: it refines the processor's approximate square root without divisions, it
skips the weirs where no level is above a rim, and it computes once per lane, or once per step length, what does not
change more often. Multiplications bound the kernel: with unrefined roots, which would be wrong, it would be twice as
fast. With individual step control a trajectory takes few steps: short ones at the kink of a root, elsewhere as long as
its stiffness allows. Errors are relative to SciPy's LSODA at a tolerance of 1e-12, on equations as sharp as for steps
of 1 ms. The SciPy search is stopped after 120 generations, those of evosax and EvoX after 1500; all start from the
tools' own defaults. The time of logging is measured in the log's own methods, on each thread, and in the process that
asks git; a job's seconds do not include its imports, those of the whole command do. The message of a sample costs half
a microsecond. One that is written once per generation costs sixty times as much, because the processor's caches no
longer hold what it needs.

"""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="which; all by default")
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each entry of a table")
    parser.add_argument("--write", help="also write the tables to this file, beside those of other parts in it")
    arguments = parser.parse_args()
    head = NOTES + machine.describe()
    tables = _written(arguments.write, head)
    for name in arguments.parts or PARTS:
        title, part = PARTS[name]
        occasion = machine.occasion(sys.argv)
        rows = part.measure(arguments.seconds)
        tables[title] = f"\n## {title}\n\n{occasion}\n{part.table(rows)}\n"
        if part is precision and arguments.write:
            picture = Path(arguments.write).with_name("work_precision.png")
            precision.draw(rows, picture)
            tables[title] += f"\n![Work against precision]({picture.name})\n"
        print(tables[title], flush=True)
        if arguments.write:
            text = head + "".join(tables[t] for t, _ in PARTS.values() if t in tables)
            Path(arguments.write).write_text(text, encoding="utf-8")


def _written(path: str | None, head: str) -> dict[str, str]:
    """The tables that a file has of the same machine and versions, by title."""
    text = Path(path).read_text(encoding="utf-8") if path and Path(path).exists() else ""
    before, *tables = text.split("\n## ")
    if before.strip().rsplit("\n", 1)[-1] != head.strip().rsplit("\n", 1)[-1]:
        return {}
    return {table.split("\n", 1)[0]: f"\n## {table.rstrip()}\n" for table in tables}


main()
