"""False alarms of single calibrations on disturbed tanks without a fault: `python -m benchmarks.monitor_false_alarms`.

Each calibration learns from its own recording and is tested on the rest of it. Its number of alarms is compared with
the 95 % interval that it predicts for itself. With `--tolerance 1` the rig's constants differ from the plant's by their
tolerances; with `--rests` the inputs rest while it learns; with `--flows 0.3` the random flows are smaller; with
`--calibrate` the constants that have a tolerance are calibrated on the fault-free part; with `--piece 500` the observer
starts anew each 500 samples of the test. With `--cases FOLDER`, each fault-free case of a folder of practice data
(CASE/plant.yaml, CASE/recording.csv.gz, CASE/holdout.csv.gz, key.json) is learnt from its recording and tested on its
hold-out.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.stats import poisson
from torch import Tensor

from benchmarks.monitor_rigs import KINDS, Case, recordings
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.monitor.fault_free_checks import QUESTION
from fdi_torch.monitor.monitor_setup import PreparedMonitor, fault_free_part, prepare_monitor
from fdi_torch.monitor.samples import Samples, samples_of_recording
from fdi_torch.monitor.state_update import advance_observer
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

LEARN = (300.0, 1000.0, 3000.0)


@dataclass(frozen=True)
class Calibration:
    """alarms: number after the fault-free part. low, high: its predicted 95 % interval. share: predicted probability of
    fewer alarms, and half that of as many. threshold: of the detector. asked: whether the recording is asked about.
    """

    alarms: int
    low: int
    high: int
    share: float
    threshold: float
    asked: bool

    @property
    def within(self) -> bool:
        return self.low <= self.alarms <= self.high


def tested(
    plant: PlantDescription,
    learnt: Recording,
    test: Recording,
    skip: int,
    every: float,
    piece: int = 0,
    calibrate: bool = False,
) -> Calibration:
    """Learn from one recording and count the alarms of another, whose first `skip` samples do not count.

    piece: after so many samples the observer starts anew; 0 if it never does.
    """
    constants = sorted(plant.tolerances) if calibrate else ()
    prepared = prepare_monitor(plant, learnt, calibrate=constants, time_between_false_alarms=every)
    monitor, samples = prepared.monitor, samples_of_recording(test, plant)
    whole = len(samples)
    starts = range(skip, whole, piece) if piece else [0]
    runs = [samples.segment(first, min(first + (piece or whole), whole)) for first in starts]
    white = torch.cat([_to_test(prepared, run, 0 if piece else skip) for run in runs])
    detector, seconds = monitor.detector, len(white) * monitor.detector.design.interval
    alarms, expected = int(detector.alarms(white).sum()), detector.design.rates * seconds
    low, high = (detector.design.count_quantile(seconds, p) for p in (0.025, 0.975))
    share = float(np.mean(poisson.cdf(alarms, expected) - 0.5 * poisson.pmf(alarms, expected)))
    return Calibration(alarms, low, high, share, detector.threshold, any(QUESTION in w for w in prepared.warnings))


def _to_test(prepared: PreparedMonitor, samples: Samples, skip: int) -> Tensor:
    """The residuals that the detector tests in one run, without those of the first `skip` samples."""
    observer, state = prepared.monitor.observer, prepared.monitor.start(samples, prepared.believed)
    if skip:
        state = advance_observer(observer, state, samples.segment(1, skip))
        state = replace(state, errors=state.errors.as_calibrated())
    return advance_observer(observer, state, samples.segment(max(skip, 1), len(samples))).tested[skip:]


def test_cases(folder: Path, every: float, calibrate: bool) -> None:
    """Test each fault-free case on its hold-out."""
    for case, answer in json.loads((folder / "key.json").read_text()).items():
        if answer["causes"]:
            continue
        plant = load_plant(folder / case / "plant.yaml")
        learnt, test = (
            read_recording(RecordingConfig(file=str(folder / case / f"{name}.csv.gz")), plant, folder)
            for name in ("recording", "holdout")
        )
        row, lasts = tested(plant, learnt, test, 0, every, calibrate=calibrate), float(test.time[-1] - test.time[0])
        print(f"{case} {answer['kind']:6} {len(plant.tanks):2} tanks: {row.alarms} ", end="")
        print(f"({row.low} to {row.high}) of {lasts / every:.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--calibrations", type=int, default=4, help="of each kind, loop and learning time")
    parser.add_argument("--lasts", type=float, default=40000.0, help="test after learning, s")
    parser.add_argument("--every", type=float, default=20000.0)
    parser.add_argument("--correlation", type=float, default=0.0, help="of neighbouring values of the sensors' noise")
    parser.add_argument("--tolerance", type=float, default=0.0, help="errors of the constants, in their tolerances")
    parser.add_argument("--rests", action="store_true", help="inputs rest during the learning part")
    parser.add_argument("--flows", type=float, default=1.0, help="random flows, as a share of the usual ones")
    parser.add_argument("--calibrate", action="store_true", help="the constants that have a tolerance")
    parser.add_argument("--piece", type=int, default=0, help="the observer starts anew each that many samples")
    parser.add_argument("--cases", type=Path, help="folder of practice data")
    a = parser.parse_args()
    if a.cases is not None:
        test_cases(a.cases, a.every, a.calibrate)
        return
    plant = load_plant("three_tank")
    cells = [(k, closed, learn) for k in KINDS for closed in (True, False) for learn in LEARN]
    cases = [
        Case(
            "",
            0.0,
            k,
            learn,
            math.inf,
            learn + a.lasts,
            closed,
            100000 * a.seed + 100 * i + j,
            correlation=a.correlation,
            tolerance=a.tolerance,
            rests=a.rests,
            flows=a.flows,
        )
        for i, (k, closed, learn) in enumerate(cells)
        for j in range(a.calibrations)
    ]
    runs, started, results = recordings(cases, step=0.25), time.process_time(), []
    for first in range(0, len(cases), a.calibrations):
        case = cases[first]
        whole = [recording for recording, _ in runs[first : first + a.calibrations]]
        rows = [
            tested(plant, fault_free_part(r, 0.0, case.learn), r, int(case.learn), a.every, a.piece, a.calibrate)
            for r in whole
        ]
        results += rows
        loop, thresholds = "closed" if case.closed else "open", [round(row.threshold, 1) for row in rows]
        texts = ", ".join(f"{row.alarms} ({row.low} to {row.high})" for row in rows)
        print(f"{case.kind:5} {loop:6} {case.learn:5.0f} s: alarms {texts} of {a.lasts / a.every:g}, ", end="")
        print(f"thresholds {thresholds}, {sum(row.within for row in rows)} of {len(rows)} within", flush=True)
    for learn in LEARN:
        rows = [row for row, case in zip(results, cases, strict=True) if case.learn == learn]
        outer = sum(not 0.1 < row.share < 0.9 for row in rows)
        print(
            f"{learn:.0f} s: {sum(row.alarms for row in rows)} alarms of {len(rows) * a.lasts / a.every:g} expected, "
        )
        print(f"  {sum(row.within for row in rows)} of {len(rows)} within, {outer} outside the predicted 80 %")
    within, asked = sum(row.within for row in results), sum(row.asked for row in results)
    print(f"{within} of {len(cases)} within, {asked} asked about, {time.process_time() - started:.0f} s of CPU")


if __name__ == "__main__":
    main()
