"""Newton's correction of a whole trajectory under the implicit midpoint rule, and its sensitivities to the parameters.

With M = 1 - dt/2 df/dh at each step, the correction x of the levels and the sensitivities s by theta both obey

    M x_{k+1} = (2 - M) x_k + forcing_k,   forcing: dt f - (h_{k+1} - h_k) for x, dt df/dtheta for s.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.simulate.scan import product, run_loop, scan_in_time


def newton_step(
    span: Float[Tensor, " K"],
    path: Float[Tensor, "L n K+1"],
    rates: Float[Tensor, "L n K"],
    by_level: Float[Tensor, "L n n K"],
    by_theta: Float[Tensor, "L n P K"],
    start: Float[Tensor, "L n"],
    start_slopes: Float[Tensor, "L n P"],
) -> tuple[Tensor, ...]:
    """One Newton step of all lanes and steps at once.

    span: lengths of the steps, s. path: levels. rates: at mid-step, with their slopes by_level and by_theta. start and
    start_slopes: initial levels and their slopes.

    Returns the corrected levels (L, n, K+1), their sensitivities (L, n, P, K+1), transition and gain of a disturbance
    (L, n, n, K), and the largest correction (L,).
    """
    inputs = [span, path, rates, by_level, by_theta, start, start_slopes]
    slopes, defect = path.new_empty(*by_theta.shape[:-1], path.shape[-1]), path.new_empty(len(path))
    outputs = [torch.empty_like(path), slopes, torch.empty_like(by_level), torch.empty_like(by_level), defect]
    if run_loop("midpoint_step", by_theta.shape, inputs, outputs):
        return tuple(outputs)
    transition, gain, forcing = _recurrence(span, path, rates, by_level)
    forcing = torch.cat([forcing, product(gain, by_theta)], dim=2)
    first = torch.cat([(start - path[..., 0]).unsqueeze(-1), start_slopes], dim=-1)
    solution = scan_in_time(transition, forcing, first)
    return path + solution[:, :, 0], solution[:, :, 1:], transition, gain, solution[:, :, 0].abs().amax(dim=(-1, -2))


def newton_correction(
    span: Float[Tensor, " K"],
    path: Float[Tensor, "L n K+1"],
    rates: Float[Tensor, "L n K"],
    by_level: Float[Tensor, "L n n K"],
    start: Float[Tensor, "L n"],
) -> tuple[Float[Tensor, "L n K+1"], Float[Tensor, " L"]]:
    """The corrected levels and the largest correction of `newton_step`, without sensitivities."""
    lanes, n, steps = rates.shape
    levels, defect = torch.empty_like(path), path.new_empty(lanes)
    inputs = [span, path, rates, by_level, None, start, None]
    if run_loop("midpoint_step", torch.Size((lanes, n, 0, steps)), inputs, [levels, None, None, None, defect]):
        return levels, defect
    transition, _, forcing = _recurrence(span, path, rates, by_level)
    correction = scan_in_time(transition, forcing, (start - path[..., 0]).unsqueeze(-1))[:, :, 0]
    return path + correction, correction.abs().amax(dim=(-1, -2))


def _recurrence(span: Tensor, path: Tensor, rates: Tensor, by_level: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Transition and gain (L, n, n, K) of the correction, and its forcing (L, n, 1, K)."""
    one = torch.eye(path.shape[1], dtype=path.dtype, device=path.device).unsqueeze(-1)
    inverse = torch.linalg.inv((one - 0.5 * span * by_level).movedim(-1, 1)).movedim(1, -1)
    misfit = (span * rates - (path[..., 1:] - path[..., :-1])).unsqueeze(2)
    return 2.0 * inverse - one, inverse * span, product(inverse, misfit)
