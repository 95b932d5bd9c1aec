"""One adaptive step of each lane: an L-stable Runge-Kutta method of order 4 with an embedded error estimate.

ARK4(3)6L[2]SA-ESDIRK of Kennedy and Carpenter (2003), "Additive Runge-Kutta schemes for convection-diffusion-reaction
equations", Appl. Numer. Math. 44: 139-181. Nearly equal levels equalise within milliseconds. That limits the steps of
an explicit method; the steps of an L-stable one are limited only by the actual rates of change.

Each stage is Y = r + g f(Y) with r = h + dt sum a_sj k_j and g = dt / 4, solved by Newton's method with the exact J =
df/dh. Its sensitivity to theta obeys (1 - g J) dY = dr + g df/dtheta, the exact derivative of the step.

kernel.hpp has the same step for a block of lanes; here the numbers are tensors (L,).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from fdi_torch.simulate.interpreter import State
from fdi_torch.simulate.program import Program
from fdi_torch.simulate.section import Section

DIAGONAL = 0.25
STAGES: tuple[tuple[float, ...], ...] = (
    (0.25,),
    (8611 / 62500, -1743 / 31250),
    (5012029 / 34652500, -654441 / 2922500, 174375 / 388108),
    (15267082809 / 155376265600, -71443401 / 120774400, 730878875 / 902184768, 2285395 / 8070912),
    (82889 / 524892, 0.0, 15625 / 83664, 69875 / 102672, -2260 / 8211),
)
"""a_sj of the five implicit stages; the last one is the step itself."""
EMBEDDED = (
    4586570599 / 29645900160,
    0.0,
    178811875 / 945068544,
    814220225 / 1159782912,
    -3700637 / 11593932,
    61727 / 225920,
)
"""Weights of the embedded step of order 3, for the error estimate."""
ERROR = tuple(a - b for a, b in zip((*STAGES[-1], DIAGONAL), EMBEDDED, strict=True))

# Newton's method ends when the next correction, extrapolated from the last two, would be below this fraction of the
# step's tolerance, or when the last one was rounding error (in units of the level's last place).
NEWTON_SHARE, NEWTON_ROUNDING, NEWTON_ROUNDS = 1e-4, 8.0, 8

Numbers = list[Tensor]


class ImplicitStep:
    """The implicit step for the lanes of a state. compute: evaluates a section. full: expands a change to (P, L)."""

    def __init__(
        self,
        program: Program,
        state: State,
        compute: Callable[[Section], None],
        full: Callable[[Tensor | None], Tensor],
    ) -> None:
        self.program, self.state, self.compute, self.full = program, state, compute, full

    def take(self, step: Tensor, tolerance: float) -> tuple[Tensor, Numbers]:
        """Advance the levels by step (L,) s.

        Returns the error estimate of the levels relative to the tolerance (m), infinite where a stage has no solution,
        (L,); and the error estimate of the slopes by theta, one tensor (P, L) per state, in their units.
        """
        p, start = self.program, self._levels()
        start_slopes = self._changes() if p.tangent else []
        self.compute(p.law)
        slopes, changes = [self._slopes(step)], [self._rate_slopes(start_slopes)]
        failed = torch.zeros_like(step, dtype=torch.bool)
        g = DIAGONAL * step
        for row in STAGES:
            base = _along(start, step, row, slopes)
            failed = failed | self._solve(base, slopes[-1], g, NEWTON_SHARE * tolerance)
            slopes.append([(h - r) / g for h, r in zip(self._levels(), base, strict=True)])
            if p.tangent:
                base_slopes = _along(start_slopes, step, row, changes)
                changes.append(self._solve_changes(base_slopes, g))
        error = torch.stack(_error(step, slopes)).amax(dim=0)
        return torch.where(failed, torch.inf, error / tolerance), _error(step, changes)

    def _solve(self, base: Numbers, slopes: Numbers, g: Tensor, enough: float) -> Tensor:
        """Solve levels = base + g f(levels), starting from base + g slopes; returns the lanes (L,) without
        convergence.
        """
        level = [r + g * k for r, k in zip(base, slopes, strict=True)]
        active, last_size = torch.ones_like(g, dtype=torch.bool), torch.zeros_like(g)
        for _ in range(NEWTON_ROUNDS):
            self._put(level)
            self.compute(self.program.law)
            misfit = [r + g * k - h for r, k, h in zip(base, self._slopes(g), level, strict=True)]
            correction = self.program.elimination.solved(self._factors(g), misfit)
            level = [torch.where(active, h + m, h) for h, m in zip(level, correction, strict=True)]
            size = torch.stack([m.abs() for m in correction]).amax(dim=0)
            rounding = NEWTON_ROUNDING * torch.finfo(g.dtype).eps * torch.stack([h.abs() for h in level]).amax(dim=0)
            converged = (size <= enough) | (size * size <= enough * last_size) | (size <= rounding)
            active, last_size = active & ~converged & ~torch.isnan(size), size
            if not bool(active.any()):
                break
        self._put(level)
        return active

    def _solve_changes(self, base: Numbers, g: Tensor) -> Numbers:
        """Slopes of a stage's levels by theta; returns the slopes of its rates."""
        self.compute(self.program.law)
        right = [r + g * self.full(self.state.changes.get(("slope", i))) for i, r in enumerate(base)]
        solution = self.program.elimination.solved(self._factors(g), right)
        levels = self._levels()
        self.state.put("level", list(zip(levels, solution, strict=True)))
        return [(d - r) / g for d, r in zip(solution, base, strict=True)]

    def _factors(self, g: Tensor) -> tuple[Numbers, Numbers]:
        work = self.program.elimination
        matrix = []
        for (row, column), given in zip(work.entries, work.given, strict=True):
            slope = self.state.values["by_level", given] if given >= 0 else 0.0
            matrix.append((1.0 if row == column else 0.0) - g * slope)
        return work.factored(matrix)

    def _rate_slopes(self, level_slopes: Sequence[Tensor]) -> Numbers:
        """Slopes of the rates by theta at the start of the step, (P, L) each."""
        if not self.program.tangent:
            return []
        total = [self.full(self.state.changes.get(("slope", i))) for i in range(self.program.order)]
        for e, (row, column) in enumerate(self.program.pattern):
            total[row] = total[row] + self.state.values["by_level", e] * level_slopes[column]
        return total

    def _levels(self) -> Numbers:
        return [level for level, _ in self.state.group("level", self.program.order)]

    def _changes(self) -> Numbers:
        return [self.full(change) for _, change in self.state.group("level", self.program.order)]

    def _put(self, levels: Numbers) -> None:
        self.state.values.update({("level", i): level for i, level in enumerate(levels)})

    def _slopes(self, like: Tensor) -> Numbers:
        return [self.state.values["slope", i].expand_as(like) for i in range(self.program.order)]


def _error(step: Tensor, slopes: Sequence[Numbers]) -> Numbers:
    """Error estimate of a step for each state."""
    return [e.abs() for e in _along([torch.zeros_like(k) for k in slopes[0]], step, ERROR, slopes)]


def _along(start: Sequence[Tensor], step: Tensor, weights: Sequence[float], slopes: Sequence[Numbers]) -> Numbers:
    """start + step x sum of weights x slopes, for each state."""
    levels = []
    for i, h in enumerate(start):
        total = weights[0] * slopes[0][i]
        for weight, slope in zip(weights[1:], slopes[1:], strict=True):
            total = total + weight * slope[i]
        levels.append(h + step * total)
    return levels
