"""One step of each lane's own: an L-stable Runge-Kutta method of order 4 with an estimate of its error.

ARK4(3)6L[2]SA-ESDIRK of Kennedy & Carpenter (2003), "Additive Runge-Kutta schemes for convection-diffusion-reaction
equations", Appl. Numer. Math. 44: 139-181. Nearly equal levels come to rest within milliseconds. That bounds the steps
of an explicit method; those of an L-stable one are bound by how fast the levels still move.

Each stage is Y = r + g f(Y) with r = h + dt sum a_sj k_j and g = dt / 4, solved by Newton's method with exact slopes
J = df/dh. What theta does to it then obeys (1 - g J) dY = dr + g df/dtheta: slopes are those of the step itself.

The same step stands in kernel.hpp for a block of lanes; here its numbers are tensors (L,).
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
"""The step of order 3 that its error is estimated by."""
ERROR = tuple(a - b for a, b in zip((*STAGES[-1], DIAGONAL), EMBEDDED, strict=True))

# Newton's method ends where the next round would move levels by less than this share of what a step may be wrong by,
# since rounds shrink at least as the last one did; or by rounding only, in units of a level's last place.
NEWTON_SHARE, NEWTON_ROUNDING, NEWTON_ROUNDS = 1e-4, 8.0, 8

Numbers = list[Tensor]


class ImplicitStep:
    """The step for a state's lanes. compute: runs a section. full: a change as a tensor (P, L)."""

    def __init__(
        self,
        program: Program,
        state: State,
        compute: Callable[[Section], None],
        full: Callable[[Tensor | None], Tensor],
    ) -> None:
        self.program, self.state, self.compute, self.full = program, state, compute, full

    def take(self, own: Tensor, tolerance: float) -> tuple[Tensor, Numbers]:
        """Moves the levels on by own (L,) s.

        Returns by how much they may be wrong, as a share of the tolerance (m) and infinite where a stage has no
        solution, (L,); and the same for what theta does to each level, (P, L), as it is.
        """
        p, begun = self.program, self._levels()
        moved = self._changes() if p.tangent else []
        self.compute(p.law)
        slopes, changes = [self._slopes(own)], [self._moving_slopes(moved)]
        failed = torch.zeros_like(own, dtype=torch.bool)
        g = DIAGONAL * own
        for row in STAGES:
            base = _along(begun, own, row, slopes)
            failed = failed | self._solve(base, slopes[-1], g, NEWTON_SHARE * tolerance)
            slopes.append([(h - r) / g for h, r in zip(self._levels(), base, strict=True)])
            if p.tangent:
                rest = _along(moved, own, row, changes)
                changes.append(self._solve_changes(rest, g))
        error = torch.stack(_error(own, slopes)).amax(dim=0)
        return torch.where(failed, torch.inf, error / tolerance), _error(own, changes)

    def _solve(self, base: Numbers, slopes: Numbers, g: Tensor, enough: float) -> Tensor:
        """Puts the levels at base + g f(levels), from base + g slopes on; where that fails, (L,)."""
        level = [r + g * k for r, k in zip(base, slopes, strict=True)]
        active, before = torch.ones_like(g, dtype=torch.bool), torch.zeros_like(g)
        for _ in range(NEWTON_ROUNDS):
            self._put(level)
            self.compute(self.program.law)
            misfit = [r + g * k - h for r, k, h in zip(base, self._slopes(g), level, strict=True)]
            move = self.program.elimination.solved(self._factors(g), misfit)
            level = [torch.where(active, h + m, h) for h, m in zip(level, move, strict=True)]
            size = torch.stack([m.abs() for m in move]).amax(dim=0)
            rounding = NEWTON_ROUNDING * torch.finfo(g.dtype).eps * torch.stack([h.abs() for h in level]).amax(dim=0)
            near = (size <= enough) | (size * size <= enough * before) | (size <= rounding)
            active, before = active & ~near & ~torch.isnan(size), size
            if not bool(active.any()):
                break
        self._put(level)
        return active

    def _solve_changes(self, base: Numbers, g: Tensor) -> Numbers:
        """What theta does to the levels of a stage; returns what it does to its slopes."""
        self.compute(self.program.law)
        forced = [r + g * self.full(self.state.changes.get(("slope", i))) for i, r in enumerate(base)]
        found = self.program.elimination.solved(self._factors(g), forced)
        levels = self._levels()
        self.state.put("level", list(zip(levels, found, strict=True)))
        return [(d - r) / g for d, r in zip(found, base, strict=True)]

    def _factors(self, g: Tensor) -> tuple[Numbers, Numbers]:
        work = self.program.elimination
        matrix = []
        for (row, column), given in zip(work.entries, work.given, strict=True):
            slope = self.state.values["by_level", given] if given >= 0 else 0.0
            matrix.append((1.0 if row == column else 0.0) - g * slope)
        return work.factored(matrix)

    def _moving_slopes(self, moved: Sequence[Tensor]) -> Numbers:
        """What theta does to the slopes where the step begins, (P, L) each."""
        if not self.program.tangent:
            return []
        total = [self.full(self.state.changes.get(("slope", i))) for i in range(self.program.tanks)]
        for e, (row, column) in enumerate(self.program.pattern):
            total[row] = total[row] + self.state.values["by_level", e] * moved[column]
        return total

    def _levels(self) -> Numbers:
        return [level for level, _ in self.state.group("level", self.program.tanks)]

    def _changes(self) -> Numbers:
        return [self.full(change) for _, change in self.state.group("level", self.program.tanks)]

    def _put(self, levels: Numbers) -> None:
        self.state.values.update({("level", i): level for i, level in enumerate(levels)})

    def _slopes(self, like: Tensor) -> Numbers:
        return [self.state.values["slope", i].expand_as(like) for i in range(self.program.tanks)]


def _error(own: Tensor, slopes: Sequence[Numbers]) -> Numbers:
    """By how much a step may be wrong, for each tank."""
    return [e.abs() for e in _along([torch.zeros_like(k) for k in slopes[0]], own, ERROR, slopes)]


def _along(begun: Sequence[Tensor], own: Tensor, weights: Sequence[float], slopes: Sequence[Numbers]) -> Numbers:
    """begun + own sum of weights x slopes, for each tank."""
    moved = []
    for i, h in enumerate(begun):
        total = weights[0] * slopes[0][i]
        for weight, slope in zip(weights[1:], slopes[1:], strict=True):
            total = total + weight * slope[i]
        moved.append(h + own * total)
    return moved
