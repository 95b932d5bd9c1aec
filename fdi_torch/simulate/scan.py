"""Linear recurrences in time: a compiled loop, or some vector operations on all K steps.

One of them is Newton's correction x of a whole trajectory under the implicit midpoint rule, with its sensitivities s to
the parameters. With M = 1 - dt/2 df/dh at each step, both obey

    M x_{k+1} = (2 - M) x_k + forcing_k,   forcing: dt f - (h_{k+1} - h_k) for x, dt df/dtheta for s.

The loops are compiled at the first use for each number of tanks, up to `MOST`, because they keep matrices of a block of
steps on the stack. Without a compiler, and for tensors that they cannot take (gradients, float32, GPU), torch does the
same many times slower.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.simulate.build import BuildError, load_library

MOST = 32
_SOURCE = Path(__file__).with_name("recurrence.hpp")


def scan_in_time(
    a: Float[Tensor, "L n n K"],
    b: Float[Tensor, "L n m K"],
    first: Float[Tensor, "L n m"],
    gain: Float[Tensor, "L n n K"] | None = None,
) -> Float[Tensor, "L n m K+1"]:
    """x_{k+1} = A_k x_k + b_k for k = 0..K-1: a (L, n, n, K), b (L, n, m, K), first (L, n, m) -> x (L, n, m, K+1).

    gain: G (L, n, n, K), if the forcing is G_k b_k. Without a compiled loop, each state follows from that 1, 2, 4 ...
    steps before it, with the products of the A between them (Hillis and Steele, 1986).
    """
    count = b.shape[-1]
    a, x = a.expand(b.shape[0], *a.shape[1:]), b.new_empty(*b.shape[:-1], count + 1)
    if run_loop("scan_in_time", b.shape, [a, gain, b, first], [x]):
        return x
    if gain is not None:
        b = product(gain, b)
    x = torch.cat([product(a[..., :1], first.unsqueeze(-1)) + b[..., :1], b[..., 1:]], dim=-1)
    reach = 1
    while reach < count:
        later, between = x[..., reach:] + product(a[..., reach:], x[..., :-reach]), a[..., reach:]
        a = torch.cat([a[..., :reach], product(between, a[..., :-reach])], dim=-1)
        x, reach = torch.cat([x[..., :reach], later], dim=-1), 2 * reach
    return torch.cat([first.unsqueeze(-1), x], dim=-1)


def product(a: Float[Tensor, "L n n K"], x: Float[Tensor, "L n m K"]) -> Float[Tensor, "L n m K"]:
    """a (L, n, n, K) times x (L, n, m, K) at every step, as an explicit sum: bitwise equal alone and in a batch."""
    total = a[:, :, 0, None] * x[:, None, 0]
    for j in range(1, a.shape[2]):
        total.addcmul_(a[:, :, j, None], x[:, None, j])
    return total


def run_loop(name: str, shape: torch.Size, inputs: Sequence[Tensor | None], outputs: Sequence[Tensor | None]) -> bool:
    """Run a loop of recurrence.hpp, which fills the outputs; False where it cannot. shape: (L, n, columns, K)."""
    lanes, n, columns, steps = shape
    library = _library(n) if n <= MOST and all(t is None or is_plain(t) for t in inputs) else None
    if library is None:
        return False
    contiguous = [None if t is None else t.contiguous() for t in inputs]
    pointers = [ctypes.c_void_p(None if t is None else t.data_ptr()) for t in (*contiguous, *outputs)]
    getattr(library, name)(*(ctypes.c_int64(x) for x in (lanes, steps, columns)), *pointers)
    return True


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor holds float64 numbers on the CPU without gradients."""
    return not tensor.requires_grad and tensor.dtype is torch.float64 and tensor.device.type == "cpu"


@lru_cache
def _library(tanks: int) -> ctypes.CDLL | None:
    try:
        source = f"#define TANKS {tanks}\n" + _SOURCE.read_text(encoding="utf-8")
        return load_library(source, "scan_in_time", "midpoint_step")
    except BuildError:
        return None


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
