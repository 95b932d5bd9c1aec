"""Monte Carlo plan: compare on-line estimators on random multiple faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from fdi_torch.estimate.fitting import Fitting
from fdi_torch.monitor.monte_carlo.estimator_comparison import (
    ESTIMATOR_NAMES,
    EstimateTracks,
    RandomFaultRuns,
    comparison_row,
    draw_runs,
    track_estimates,
)
from fdi_torch.monitor.monte_carlo.tasks import Numbers, ResultTable, Task, seeded_generator

NAME = "rivals"


@dataclass(frozen=True)
class EstimatorComparisonPlan:
    """sets: number of random fault sets, `part` of them per task. looks: numbers of samples after
    which all estimate.
    """

    fitting: Fitting
    sets: int
    subset: int
    snr_db: tuple[float, ...]
    looks: tuple[int, ...]
    seed: int
    rivals: tuple[str, ...] = ESTIMATOR_NAMES

    def tasks(self) -> list[Task]:
        return [
            Task(f"{NAME}/{snr:g}/{rival}", lambda s=snr, r=rival, f=first: self._track(s, r, f))  # type: ignore[misc]
            for snr in self.snr_db
            for rival in self.rivals
            for first in range(0, self.sets, self.subset)
        ]

    def _track(self, snr: float, rival: str, first: int) -> Numbers:
        tracks = track_estimates(rival, self._runs(snr, first), self.looks)
        return {"theta": tracks.theta.flatten().tolist(), "cost": tracks.cost, "first": float(first)}

    @lru_cache(maxsize=4)  # noqa: B019 - a plan lives as long as the program
    def _runs(self, snr: float, first: int) -> RandomFaultRuns:
        count = min(self.subset, self.sets - first)
        return draw_runs(self.fitting, count, snr, seeded_generator(self.seed, 9, int(snr), first))

    def result_table(self, numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> ResultTable:
        rows = []
        for snr in self.snr_db:
            for rival in self.rivals:
                results = numbers.get(f"{NAME}/{snr:g}/{rival}", ())
                if results:
                    rows.append(self._row(snr, rival, results))
        what = ("SNR, dB", "rival", "sets", "error / bound", "95 %", "failures", "never within 5 %")
        times = ("to within 5 %, s (quartiles)", "CPU ms a sample")
        nearest = min(rows, key=lambda row: float(row[3]), default=None)
        summary = f"{nearest[1]} comes nearest to the bound ({nearest[3]} times it)" if nearest else ""
        return ResultTable("rivals on random sets of faults", (*what, *times), tuple(rows), summary)

    def _row(self, snr: float, rival: str, results: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
        width = len(self.fitting.space)
        parts = [self._runs(snr, int(n["first"])) for n in results]
        theta = torch.cat(
            [torch.tensor(n["theta"], dtype=torch.float64).reshape(-1, len(self.looks), width) for n in results]
        )
        fields = ("truth", "faulty", "readings", "std", "bound")
        runs = RandomFaultRuns(self.fitting, *(torch.cat([getattr(p, field) for p in parts]) for field in fields))
        cost = sum(n["cost"] for n in results) / len(results)
        row = comparison_row(rival, snr, runs, EstimateTracks(torch.tensor(self.looks), theta, cost))
        quarter = [f"{t:.0f}" if t < 1e9 else "never" for t in row.to_close]
        ratio = (f"{row.over_bound:.2f}", f"{row.interval[0]:.2f} .. {row.interval[1]:.2f}")
        ends = (str(row.failures), str(row.never), f"{quarter[1]} ({quarter[0]} .. {quarter[2]})")
        return (f"{snr:g}", rival, str(row.runs), *ratio, *ends, f"{1e3 * row.cost:.3g}")
