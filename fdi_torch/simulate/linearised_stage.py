"""A stage with memory over a whole signal, m_{k+1} = F_k(x_k, m_k, theta), y_k = G_k(x_k, m_k, theta), and its
linearisation.

Newton's method solves for the memories of all k at once. The slopes of F and G then give the linear map from changes of
signals and parameters to changes of the outputs. A stage without memory is pointwise, and nothing is solved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.plant.effect import Memory
from fdi_torch.simulate.scan import scan_in_time

ROUNDS = 40
CONVERGED = 1e-11
Row = Sequence[Tensor | None]
Pointwise = Callable[[list[Tensor]], Sequence[Tensor]]
Signals = Sequence[Tensor]
Step = Callable[[Signals, Memory, Signals], tuple[Signals, Memory]]  # signals, memory, theta -> outputs, new memory
First = Callable[[Signals, Signals], Memory]  # signals at the first instant, theta -> initial memory


@dataclass(frozen=True)
class LinearisedStage:
    """The outputs of a stage and its linearisation at one path.

    outputs: each (L, K). by_signal, by_memory, by_theta: slopes, one row per output and then one per memory.
    first_by_signal, first_by_theta: slopes of the initial memories, (L, 1).
    """

    outputs: list[Tensor]
    by_signal: list[Row]
    by_memory: list[Row]
    by_theta: list[Row]
    first_by_signal: list[Row]
    first_by_theta: list[Row]

    def along(self, signals: Sequence[Tensor | None], moves: Sequence[int]) -> list[Tensor | None]:
        """Change of each output (L, M, K) along M directions; None for no change.

        signals: change of each signal, (L, M, K), None for no change. moves: index of the parameter that changes by one
        along each direction, -1 for none.
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
        """Indices of the parameters that affect an output or a memory directly, at constant signals."""
        rows = [*self.by_theta, *self.first_by_theta]
        return [p for p in range(len(rows[0]) if rows else 0) if any(row[p] is not None for row in rows)]

    def _memories(self, signals: Sequence[Tensor | None], moves: Sequence[int]) -> list[Tensor | None]:
        """Change of the memory before each step, each (L, M, K)."""
        outputs = len(self.outputs)
        rows = range(outputs, len(self.by_signal))
        forcing = [_sum(_chained(self.by_signal[r], signals), self.by_theta[r], moves) for r in rows]
        first_signals = [None if s is None else s[..., :1] for s in signals]
        first = [
            _sum(_chained(by_signal, first_signals), by_theta, moves)
            for by_signal, by_theta in zip(self.first_by_signal, self.first_by_theta, strict=True)
        ]
        like = next((f for f in [*forcing, *first] if f is not None), None)
        if like is None:
            return [None] * len(rows)
        lanes, count, steps = like.shape[0], like.shape[1], self.outputs[0].shape[-1]
        b = like.new_zeros(lanes, len(rows), count, steps)
        start, a = b.new_zeros(lanes, len(rows), count), b.new_zeros(lanes, len(rows), len(rows), steps)
        for i, r in enumerate(rows):
            if (forced := forcing[i]) is not None:
                b[:, i] = forced
            if (initial := first[i]) is not None:
                start[:, i] = initial[..., 0]
            for j, slope in enumerate(self.by_memory[r]):
                if slope is not None:
                    a[:, i, j] = slope
        return list(scan_in_time(a, b, start)[..., :-1].unbind(1))


def linearise_stage(
    step: Step, first: First, signals: Signals, theta: Signals, memories: int, shape: Sequence[int]
) -> LinearisedStage:
    """Solve and linearise the stage for its signals, each of `shape` (L, K); theta: each (L, 1)."""
    path = solve_memory(step, first, signals, theta, memories, shape)
    count = len(signals)

    def stage_step(x: list[Tensor]) -> list[Tensor]:
        outputs, after = step(x[:count], tuple(x[count : count + memories]), x[count + memories :])
        return [*outputs, *after]

    values, rows = partials(stage_step, [*signals, *path, *theta], shape)
    initial_rows: list[Row] = []
    if memories:
        one = (*shape[:-1], 1)
        initial_rows = partials(lambda x: first(x[:count], x[count:]), [*(s[..., :1] for s in signals), *theta], one)[1]
    return LinearisedStage(
        values[: len(values) - memories],
        [row[:count] for row in rows],
        [row[count : count + memories] for row in rows],
        [row[count + memories :] for row in rows],
        [row[:count] for row in initial_rows],
        [row[count:] for row in initial_rows],
    )


def solve_memory(
    step: Step, first: First, signals: Signals, theta: Signals, memories: int, shape: Sequence[int]
) -> list[Tensor]:
    """The memories before each of K steps, each (L, K), by Newton's method (one iteration if F is linear in them)."""
    if memories == 0:
        return []
    initial = torch.stack([m.expand(*shape[:-1], 1) for m in first([s[..., :1] for s in signals], theta)], -1)
    path = initial.expand(*shape, memories).clone()
    for _ in range(ROUNDS):
        after, slopes = _slopes_by_memory(lambda m: step(signals, m, theta)[1], path)
        scale = path.abs().max() + 1e-12
        defect = torch.cat([path[..., :1, :] - initial, path[..., 1:, :] - after[..., :-1, :]], dim=-2)
        if float(defect.abs().max() / scale) < CONVERGED:
            break
        forcing = after - (slopes * path.unsqueeze(-2)).sum(-1)
        a, b = slopes.movedim(1, -1), forcing.transpose(1, 2).unsqueeze(2)
        path = scan_in_time(a, b, initial.transpose(1, 2))[:, :, 0, :-1].transpose(1, 2)
    return [m.contiguous() for m in path.unbind(-1)]


def _slopes_by_memory(after: Callable[[Memory], Memory], path: Tensor) -> tuple[Tensor, Tensor]:
    """New memory (L, K, n) and its slope by the old memory (L, K, n, n), by finite differences."""

    def stacked(memory: Tensor) -> Tensor:
        return torch.stack([a.expand(path.shape[:-1]) for a in after(memory.unbind(-1))], -1)

    base = stacked(path)
    columns = []
    for j in range(path.shape[-1]):
        shifted = path.clone()
        width = 1e-4 * (path[..., j].abs().max() + 1e-9)
        shifted[..., j] += width
        columns.append((stacked(shifted) - base) / width)
    return base, torch.stack(columns, -1)


def _chained(row: Row, changes: Sequence[Tensor | None]) -> list[Tensor]:
    """Products of slopes and the changes of their inputs, where both exist."""
    pairs = zip(row, changes, strict=True)
    return [slope.unsqueeze(1) * x for slope, x in pairs if slope is not None and x is not None]


def _sum(terms: list[Tensor], by_theta: Row, moves: Sequence[int]) -> Tensor | None:
    """Sum of the terms, each (L, M, K), and of the direct slopes by each direction's parameter."""
    direct = [(q, slope) for q, p in enumerate(moves) if p >= 0 and (slope := by_theta[p]) is not None]
    if not terms and not direct:
        return None
    if terms:
        total = terms[0]
        for term in terms[1:]:
            total = total + term
    else:
        slope = direct[0][1]
        total = slope.new_zeros(slope.shape[0], len(moves), slope.shape[-1])
    for q, slope in direct:
        total[:, q] += slope
    return total


def partials(function: Pointwise, inputs: Sequence[Tensor], shape: Sequence[int]) -> tuple[list[Tensor], list[Row]]:
    """y_i = function(x)_i and dy_i/dx_j, each of `shape`; None where y_i does not depend on x_j. One backward pass per
    output."""
    leaves = [x.detach().expand(shape).requires_grad_() for x in inputs]
    with torch.enable_grad():
        outputs = [y.expand(shape) for y in function(leaves)]
        # The sum's gradient holds all elementwise slopes, since no element depends on another element's inputs.
        totals = [y.sum() for y in outputs]
    return [y.detach() for y in outputs], [_slopes(total, leaves) for total in totals]


def _slopes(total: Tensor, leaves: Sequence[Tensor]) -> Row:
    """Gradient of a sum by each leaf."""
    if not total.requires_grad or not leaves:
        return [None] * len(leaves)
    return torch.autograd.grad(total, leaves, retain_graph=True, allow_unused=True)
