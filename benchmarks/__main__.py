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
    "search": ("CPU seconds to find a noise-free 5-parameter fault to 1e-6", search),
    "noise": ("1000 noise draws of one fault, estimated", noise),
    "monitoring": ("The monitor on three tanks, beside the time that samples take to come", monitoring),
    "logging": ("CPU seconds of a job, and of what it logs", logging),
    "startup": ("CPU seconds before anything happens: imports and help", startup),
}


NOTES = """# Benchmarks

One command compares fdi_torch with other tools on the same work, on one machine; parts of it can be named:

    pip install -e '.[benchmarks]' && python -m benchmarks --write benchmarks/README.md

The peers' equations are written by hand in `physics.py` and give the same levels to 1e-9 m, which each run checks.
`numba, blocks of lanes` is no tool of its own: it is our kernel's layout (trajectories side by side) written by hand,
and shows what a compiler makes of it. What is left between the two is the root, refined from the processor's own
rough one without divisions, the weirs that are skipped where no level stands above a rim, and what is computed once a
lane or once a length of step. What bounds the kernel is the processor's products: with its roots unrefined, which
would be wrong, it would be twice as fast. With steps of its own a trajectory takes few: short ones where a root has its
kink, elsewhere as long as its stiffness allows. Errors are against SciPy's LSODA at a tolerance of 1e-12, on equations
as sharp as for steps of 1 ms. The SciPy search is stopped after 120 generations, those of evosax and EvoX after 1500;
all start from the tools' own defaults. Logging is timed within the log's own methods, on each thread, with the
process that asks git; the job's seconds do not hold the imports, those of the whole command do. A sample's message
costs half a microsecond; what is written once a generation finds the caches cold and costs sixty times as much.

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
