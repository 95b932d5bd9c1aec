"""A stage with memory over a whole signal at once: m_{k+1} = F_k(x_k, m_k, theta), y_k = G_k(x_k, m_k, theta).

The memories' path is solved by Newton over all k; slopes of F and G then make it a linear map from what its signals and
parameters do to what its outputs do. Without memory it is pointwise and nothing is solved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.plant.effect import Memory
from fdi_torch.simulate.pointwise import Row, partials
from fdi_torch.simulate.scan import linear_scan, scan_in_time

ROUNDS = 40
SETTLED = 1e-11
Signals = Sequence[Tensor]
Step = Callable[[Signals, Memory, Signals], tuple[Signals, Memory]]  # signals, memory, theta -> outputs, memory after
First = Callable[[Signals, Signals], Memory]  # signals at the first instant, theta -> memory


@dataclass(frozen=True)
class Chain:
    """A stage about one path. outputs: each (L, K). by_signal, by_memory, by_theta: rows of slopes, one a output, then
    one a memory. first: slopes of the first memories by signals and theta, (L, 1)."""

    outputs: list[Tensor]
    by_signal: list[Row]
    by_memory: list[Row]
    by_theta: list[Row]
    first_by_signal: list[Row]
    first_by_theta: list[Row]

    def along(self, signals: Sequence[Tensor | None], moves: Sequence[int]) -> list[Tensor | None]:
        """signals: how each moves, (L, M, K), None for not at all; moves: the parameter that direction q moves by one
        beside them, -1 for none. Returns how each output moves; None for not at all.
        """
        outputs = len(self.outputs)
        memories = self._memories(signals, moves) if len(self.by_signal) > outputs else []
        return [
            _sum(
                [*_chained(self.by_signal[o], signals), *_chained(self.by_memory[o], memories)], self.by_theta[o], moves
            )
            for o in range(outputs)
        ]

    def moved_by(self) -> list[int]:
        """The parameters that move an output or a memory at signals which stand still."""
        rows = [*self.by_theta, *self.first_by_theta]
        return [p for p in range(len(rows[0]) if rows else 0) if any(row[p] is not None for row in rows)]

    def _memories(self, signals: Sequence[Tensor | None], moves: Sequence[int]) -> list[Tensor | None]:
        """How the memory before each step moves, each (L, M, K)."""
        outputs = len(self.outputs)
        rows = range(outputs, len(self.by_signal))
        forcing = [_sum(_chained(self.by_signal[r], signals), self.by_theta[r], moves) for r in rows]
        at_first = [None if s is None else s[..., :1] for s in signals]
        first = [
            _sum(_chained(by_signal, at_first), by_theta, moves)
            for by_signal, by_theta in zip(self.first_by_signal, self.first_by_theta, strict=True)
        ]
        known = next((f for f in [*forcing, *first] if f is not None), None)
        if known is None:
            return [None] * len(rows)
        lanes, count, steps = known.shape[0], known.shape[1], self.outputs[0].shape[-1]
        b = known.new_zeros(lanes, len(rows), count, steps)
        start, a = b.new_zeros(lanes, len(rows), count), b.new_zeros(lanes, len(rows), len(rows), steps)
        for i, r in enumerate(rows):
            if (pushed := forcing[i]) is not None:
                b[:, i] = pushed
            if (begun := first[i]) is not None:
                start[:, i] = begun[..., 0]
            for j, slope in enumerate(self.by_memory[r]):
                if slope is not None:
                    a[:, i, j] = slope
        return list(scan_in_time(a, b, start)[..., :-1].unbind(1))


def chain(step: Step, first: First, signals: Signals, theta: Signals, memories: int, shape: Sequence[int]) -> Chain:
    """The stage along its signals (L, K) = shape; theta: each (L, 1)."""
    path = remembered(step, first, signals, theta, memories, shape)
    count = len(signals)

    def whole(x: list[Tensor]) -> list[Tensor]:
        outputs, after = step(x[:count], tuple(x[count : count + memories]), x[count + memories :])
        return [*outputs, *after]

    values, rows = partials(whole, [*signals, *path, *theta], shape)
    begun: list[Row] = []
    if memories:
        one = (*shape[:-1], 1)
        begun = partials(lambda x: first(x[:count], x[count:]), [*(s[..., :1] for s in signals), *theta], one)[1]
    return Chain(
        values[: len(values) - memories],
        [row[:count] for row in rows],
        [row[count : count + memories] for row in rows],
        [row[count + memories :] for row in rows],
        [row[:count] for row in begun],
        [row[count:] for row in begun],
    )


def remembered(
    step: Step, first: First, signals: Signals, theta: Signals, memories: int, shape: Sequence[int]
) -> list[Tensor]:
    """The memories before each of K steps, each (L, K): Newton's, one round where F is linear in them."""
    if memories == 0:
        return []
    begun = torch.stack([m.expand(*shape[:-1], 1) for m in first([s[..., :1] for s in signals], theta)], -1)
    path = begun.expand(*shape, memories).clone()
    for _ in range(ROUNDS):
        after, slopes = _slopes(lambda m: step(signals, m, theta)[1], path)
        scale = path.abs().max() + 1e-12
        defect = torch.cat([path[..., :1, :] - begun, path[..., 1:, :] - after[..., :-1, :]], dim=-2)
        if float(defect.abs().max() / scale) < SETTLED:
            break
        forcing = (after - (slopes * path.unsqueeze(-2)).sum(-1)).unsqueeze(-1)
        path = linear_scan(slopes, forcing, begun.transpose(-1, -2))[:, :-1, :, 0]
    return [m.contiguous() for m in path.unbind(-1)]


def _slopes(after: Callable[[Memory], Memory], path: Tensor) -> tuple[Tensor, Tensor]:
    """Memory after (L, K, n) and its slope by the memory before (L, K, n, n), by finite differences."""

    def stacked(memory: Tensor) -> Tensor:
        return torch.stack([a.expand(path.shape[:-1]) for a in after(memory.unbind(-1))], -1)

    base = stacked(path)
    columns = []
    for j in range(path.shape[-1]):
        moved = path.clone()
        width = 1e-4 * (path[..., j].abs().max() + 1e-9)
        moved[..., j] += width
        columns.append((stacked(moved) - base) / width)
    return base, torch.stack(columns, -1)


def _chained(row: Row, moved: Sequence[Tensor | None]) -> list[Tensor]:
    """Slopes times how their inputs move, where both are."""
    pairs = zip(row, moved, strict=True)
    return [slope.unsqueeze(1) * x for slope, x in pairs if slope is not None and x is not None]


def _sum(terms: list[Tensor], by_theta: Row, moves: Sequence[int]) -> Tensor | None:
    """The terms, each (L, M, K), with what each direction's own parameter adds."""
    own = [(q, slope) for q, p in enumerate(moves) if p >= 0 and (slope := by_theta[p]) is not None]
    if not terms and not own:
        return None
    if terms:
        total = terms[0]
        for term in terms[1:]:
            total = total + term
    else:
        slope = own[0][1]
        total = slope.new_zeros(slope.shape[0], len(moves), slope.shape[-1])
    for q, slope in own:
        total[:, q] += slope
    return total
