"""Adaptive steps of each lane in torch: what kernel.hpp does in C++, for comparison."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.simulate import traced_engine
from fdi_torch.simulate.elimination import Elimination
from fdi_torch.simulate.expression import Section
from fdi_torch.simulate.injection import Injection
from fdi_torch.simulate.interpreter import Change, State
from fdi_torch.simulate.program import Program, build_program
from fdi_torch.simulate.step_control import (
    DIAGONAL,
    ERROR,
    LONGER,
    NEWTON_ROUNDING,
    NEWTON_ROUNDS,
    NEWTON_SHARE,
    SHORTER,
    STAGES,
)

Numbers = list[Tensor]


class OwnStepsEngine(traced_engine.TracedEngine):
    """The traced engine in steps of each lane's own."""

    own_steps = True

    def _run(self, lanes: Tensor, tangent: bool, injection: Injection | None = None) -> traced_engine._Run:
        program = build_program(self.network, self.space.names, tangent, adaptive=True)
        return _Run(program, self.network, self.experiment, lanes)


class _Run(traced_engine._Run):
    def __init__(self, *given: object) -> None:
        super().__init__(*given)
        self.implicit = ImplicitStep(self.program, self.state, self.compute, self.full)
        self.step_length = self.lanes.new_full((len(self.lanes),), torch.inf)
        self.size = self.lanes.new_zeros(self.lanes.shape[::-1])

    def _step(self) -> None:
        e, p, values = self.experiment, self.program, self.state.values
        self.compute(p.act)
        start, span = values["clock", 0], values["clock", 1]
        elapsed = torch.zeros_like(self.step_length)
        while bool((elapsed < span).any()):
            step = next_step(elapsed, self.step_length, span)
            values["part", 0], values["part", 1] = start + elapsed, step
            before = self._levels()
            error, slope_errors = self.implicit.take(step, e.step_control.tolerance)
            size = self._largest_slopes(slope_errors)
            accepted, elapsed, self.step_length = accept_steps(
                step, self._worst(error, slope_errors, size), elapsed, self.step_length, span, e.step_control.shortest
            )
            self.size = torch.where(accepted, size, self.size)
            rows = zip(self._levels(), before, strict=True)
            self.state.put("level", [self._select(accepted, now, then) for now, then in rows])

    def _largest_slopes(self, slope_errors: Sequence[Tensor]) -> Tensor:
        """Largest slope of any level by each parameter so far, (P, L)."""
        if not slope_errors:
            return self.size
        return torch.maximum(self.size, torch.stack([self.full(d).abs() for _, d in self._levels()]).amax(dim=0))

    def _worst(self, error: Tensor, slope_errors: Sequence[Tensor], size: Tensor) -> Tensor:
        """The larger of a step's relative errors of levels and slopes, (L,)."""
        if not slope_errors or not len(size):
            return error
        assert self.experiment.step_control is not None
        largest = torch.stack(list(slope_errors)).amax(dim=0)
        share = torch.where(largest > 0.0, largest / (self.experiment.step_control.slope_tolerance * size), 0.0)
        return torch.fmax(error, torch.nan_to_num(share, nan=0.0).amax(dim=0))

    def _select(self, yes: Tensor, x: tuple[Tensor, Change], y: tuple[Tensor, Change]) -> tuple[Tensor, Change]:
        level = torch.where(yes, x[0], y[0])
        both = x[1] is None and y[1] is None
        return level, None if both else torch.where(yes, self.full(x[1]), self.full(y[1]))


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
            correction = solved(self.program.elimination, self._factors(g), misfit)
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
        solution = solved(self.program.elimination, self._factors(g), right)
        levels = self._levels()
        self.state.put("level", list(zip(levels, solution, strict=True)))
        return [(d - r) / g for d, r in zip(solution, base, strict=True)]

    def _factors(self, g: Tensor) -> tuple[Numbers, Numbers]:
        work = self.program.elimination
        matrix = []
        for (row, column), given in zip(work.entries, work.given, strict=True):
            slope = self.state.values["by_level", given] if given >= 0 else 0.0
            matrix.append((1.0 if row == column else 0.0) - g * slope)
        return factored(work, matrix)

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


def factored(work: Elimination, matrix: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """LU factors in place of the matrix (one tensor per entry), and the inverse pivots."""
    lu, inverse = list(matrix), [torch.empty(0)] * len(work.order)
    rows = list(zip(work.rows, work.updates, strict=True))
    for pivot in work.order:
        inverse[pivot] = 1.0 / lu[pivot]
        for (entry, _), updates in (row for row in rows if row[0][1] == pivot):
            lu[entry] = lu[entry] * inverse[pivot]
            for changed, beyond in updates:
                lu[changed] = lu[changed] - lu[entry] * lu[beyond]
    return lu, inverse


def solved(work: Elimination, factors: tuple[list[Tensor], list[Tensor]], right: Sequence[Tensor]) -> list[Tensor]:
    """The solution for a right-hand side, one tensor per row."""
    (lu, inverse), x = factors, list(right)
    for entry, pivot in work.rows:
        row = work.entries[entry][0]
        x[row] = x[row] - lu[entry] * x[pivot]
    for pivot, beyond in zip(reversed(work.order), reversed(work.above), strict=True):
        for entry, column in beyond:
            x[pivot] = x[pivot] - lu[entry] * x[column]
        x[pivot] = x[pivot] * inverse[pivot]
    return x


def next_step(elapsed: Float[Tensor, " L"], length: Float[Tensor, " L"], span: Tensor) -> Float[Tensor, " L"]:
    """Length of each lane's next step (L,), s, after `elapsed` s of `span`.

    The step is the lane's `length`, shortened so that no short step remains before the end; `span` for a finished lane.
    """
    remaining = span - elapsed
    step = torch.where(remaining <= length, remaining, torch.where(remaining < 2.0 * length, remaining / 2.0, length))
    return torch.where(remaining > 0.0, step, span)


def accept_steps(
    step: Float[Tensor, " L"],
    error: Float[Tensor, " L"],
    elapsed: Float[Tensor, " L"],
    length: Float[Tensor, " L"],
    span: Tensor,
    shortest: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Accept or reject a step of each lane (L,): the accepted lanes, the times they have reached, and their next
    lengths, s.

    step: length of the step taken; elapsed: time reached before it; length: the lane's planned length (a step may be
    shorter at the end of the span). error: relative to the tolerance; infinite for a step without a solution. A step is
    accepted if its error is at most 1, or if it is the shortest allowed. The next length follows from the error, which
    grows with step^4. Levels that are NaN are accepted unchanged.
    """
    cut = torch.sqrt(torch.sqrt(torch.nan_to_num(error, nan=0.0))) / 0.9
    proposed = step / torch.clamp(cut, 1.0 / LONGER, 1.0 / SHORTER)
    is_open, accurate = elapsed < span, ~(error > 1.0)
    next_length = torch.where(accurate & (step < length) & (proposed < length), length, proposed)
    accepted = is_open & (accurate | (step <= shortest))
    reached = torch.where(span - elapsed <= step, span, elapsed + step)
    return (
        accepted,
        torch.where(accepted, reached, elapsed),
        torch.where(is_open, torch.clamp(next_length, min=shortest), length),
    )
