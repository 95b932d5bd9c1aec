"""Rehearsal: on-line estimators side by side on random multiple faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from fdi_torch.estimate.fitting import Fitting
from fdi_torch.monitor.rehearsal.pieces import Numbers, Piece, Shown, seeded
from fdi_torch.monitor.rehearsal.rivals import RIVALS, Runs, Tracked, draw_runs, judged, track

NAME = "rivals"


@dataclass(frozen=True)
class RivalPlan:
    """sets: of faults, `part` of them in a piece. looks: samples after the beginning at which all estimate anew."""

    fitting: Fitting
    sets: int
    part: int
    snr_db: tuple[float, ...]
    looks: tuple[int, ...]
    seed: int
    rivals: tuple[str, ...] = RIVALS

    def pieces(self) -> list[Piece]:
        return [
            Piece(f"{NAME}/{snr:g}/{rival}", lambda s=snr, r=rival, f=first: self._tracked(s, r, f))  # type: ignore[misc]
            for snr in self.snr_db
            for rival in self.rivals
            for first in range(0, self.sets, self.part)
        ]

    def _tracked(self, snr: float, rival: str, first: int) -> Numbers:
        tracked = track(rival, self._runs(snr, first), self.looks)
        return {"theta": tracked.theta.flatten().tolist(), "cost": tracked.cost, "first": float(first)}

    @lru_cache(maxsize=4)  # noqa: B019 - a plan lives as long as its rehearsal
    def _runs(self, snr: float, first: int) -> Runs:
        count = min(self.part, self.sets - first)
        return draw_runs(self.fitting, count, snr, seeded(self.seed, 9, int(snr), first))

    def shown(self, found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Shown:
        rows = []
        for snr in self.snr_db:
            for rival in self.rivals:
                own = found.get(f"{NAME}/{snr:g}/{rival}", ())
                if own:
                    rows.append(self._row(snr, rival, own))
        what = ("SNR, dB", "rival", "sets", "error / bound", "95 %", "failures", "never within 5 %")
        times = ("to within 5 %, s (quartiles)", "CPU ms a sample")
        nearest = min(rows, key=lambda row: float(row[3]), default=None)
        said = f"{nearest[1]} comes nearest to the bound ({nearest[3]} times it)" if nearest else ""
        return Shown("rivals on random sets of faults", (*what, *times), tuple(rows), said)

    def _row(self, snr: float, rival: str, own: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
        width = len(self.fitting.space)
        parts = [self._runs(snr, int(n["first"])) for n in own]
        theta = torch.cat(
            [torch.tensor(n["theta"], dtype=torch.float64).reshape(-1, len(self.looks), width) for n in own]
        )
        fields = ("truth", "faulty", "readings", "std", "bound")
        runs = Runs(self.fitting, *(torch.cat([getattr(p, field) for p in parts]) for field in fields))
        cost = sum(n["cost"] for n in own) / len(own)
        row = judged(rival, snr, runs, Tracked(torch.tensor(self.looks), theta, cost))
        quarter = [f"{t:.0f}" if t < 1e9 else "never" for t in row.to_close]
        ratio = (f"{row.over_bound:.2f}", f"{row.interval[0]:.2f} .. {row.interval[1]:.2f}")
        ends = (str(row.failures), str(row.never), f"{quarter[1]} ({quarter[0]} .. {quarter[2]})")
        return (f"{snr:g}", rival, str(row.runs), *ratio, *ends, f"{1e3 * row.cost:.3g}")
