"""Readings and Jacobians of many parameter vectors on the CPU and on a GPU: `python -m benchmarks.devices`.

The fault of Table 3 of the 2020 paper, 300 s sampled every 5 s, RK4 steps of 5 s, float64. The shortest of three runs
counts, after one that compiles the plant.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import torch

from fdi_torch.config.run_file import load_run
from fdi_torch.estimate.fitting import Fitting, set_up
from fdi_torch.jobs.run_setup import recordings_of, requested_space

STEP, SEED = 5.0, 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 10_000, 100_000, 1_000_000])
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    cores = os.cpu_count() or 1
    print(f"torch {torch.__version__}, {name}, {cores} cores")
    print("| vectors | readings, 1 core, s | all cores, s | GPU, s | GPU / 1 core | Jacobians, 1 core, s | GPU, s |")
    for size in arguments.sizes:
        one, every, there = (
            _seconds(size, torch.device("cpu"), "compiled", 1),
            _seconds(size, torch.device("cpu"), "compiled", cores),
            _seconds(size, device, "traced", 1),
        )
        numbers = (one[0], every[0], there[0], there[0] / one[0], one[1], there[1])
        print(f"| {size} | " + " | ".join(f"{number:.3g}" for number in numbers) + " |", flush=True)


def _seconds(size: int, device: torch.device, kind: str, threads: int) -> tuple[float, float]:
    """Seconds of the readings of `size` vectors, and of the Jacobians of a tenth as many."""
    torch.set_num_threads(threads)
    fitting = _fitting(device, kind)
    engine, space = fitting.engines(STEP)[0], fitting.space
    nominal, high = space.nominal(fitting.recordings[0].time), space.high(fitting.recordings[0].time)
    generator = torch.Generator().manual_seed(SEED)
    unit = torch.rand(size, len(space), dtype=torch.float64, generator=generator).to(device)
    theta = nominal + 0.2 * unit * (high - nominal)
    return _least(lambda: engine.readings(theta), device), _least(lambda: engine.linearise(theta[: size // 10]), device)


def _fitting(device: torch.device, kind: str) -> Fitting:
    run = load_run(None, ["simulate.duration=300 s", "simulate.sample_time=5 s", f"engine={kind}"])
    loaded, space = recordings_of(run), requested_space(run)
    recordings = [part.recording.to(device) for part in loaded]
    return set_up(run.plant, recordings, space, [part.start_levels for part in loaded], run.config.engine)


def _least(work: Callable[[], object], device: torch.device) -> float:
    spent = []
    for _ in range(4):  # the first compiles
        _wait(device)
        begin = time.perf_counter()
        work()
        _wait(device)
        spent.append(time.perf_counter() - begin)
    return min(spent[1:])


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


if __name__ == "__main__":
    main()
