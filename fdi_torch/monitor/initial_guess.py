"""Initial guesses for the fit of a hypothesis: the onset and size at which its signature matches the residual best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor

from fdi_torch.monitor.hypothesis import Fault, Hypothesis
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow
from fdi_torch.monitor.oscillation import strongest_periods

ONSETS = 24  # candidate onsets in a window; the fit then varies the onset continuously
TRIAL_SIZE = 0.02  # fault size for signatures, as a share of the parameter's range
OSCILLATION_PERIODS, OSCILLATION_ONSETS = 32, 6  # candidates for an oscillation
ALL_SETS = 4  # with more known faults than this, not every set of them is tried for recovery


def recovery_hypotheses(believed: Tensor, healthy: Tensor, faults: Sequence[Fault]) -> list[Hypothesis]:
    """Hypotheses that known faults recovered: every set of them, or only one, all but one and all if there are many.

    believed, healthy (P,): a fault is known where the two differ.
    """
    known = [f for f in faults if bool((believed != healthy)[list(f.columns)].any())]
    count = len(known)
    sizes = range(1, count + 1) if count <= ALL_SETS else (1, count - 1, count)
    sets = [chosen for size in sizes for chosen in combinations(known, size)]
    return [
        Hypothesis(
            tuple(sorted(c for f in chosen for c in f.columns)),
            shape=tuple(sorted(c for f in chosen for c in f.shape)),
            recovered=tuple(sorted(c for f in chosen for c in f.columns)),
        )
        for chosen in sets
    ]


def recovery_guesses(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    healthy: Tensor,
    hypotheses: Sequence[Hypothesis],
) -> Tensor:
    """Starting values and onset of H recoveries, (H, P+1): the onset with the least sum of squared innovations."""
    onsets = _onsets(window, ONSETS)
    theta = believed.repeat(len(hypotheses), ONSETS, 1)
    for i, hypothesis in enumerate(hypotheses):
        theta[i][:, list(hypothesis.recovered)] = healthy[list(hypothesis.recovered)]
    sudden = torch.zeros(len(hypotheses) * ONSETS, dtype=torch.bool)
    changes = ChangeHypotheses(theta.flatten(0, 1), onsets.repeat(len(hypotheses)), sudden)
    parts = [
        observer.white_innovations(window, believed, part).square().sum((1, 2))
        for part in observer.in_blocks(window, changes)
    ]
    best = torch.cat(parts).reshape(len(hypotheses), ONSETS).argmin(dim=1)
    return torch.cat([theta[:, 0], onsets[best].unsqueeze(-1)], dim=-1)


def _onsets(window: ObserverWindow, count: int) -> Tensor:
    """Candidate onsets spread evenly over a window, s."""
    time = window.samples.time
    return time[0] + (time[-1] - time[0]) * (torch.arange(count, dtype=time.dtype) + 0.5) / count


def signature_guesses(
    observer: ObserverBank, window: ObserverWindow, believed: Tensor, hypotheses: Sequence[Hypothesis], base: Tensor
) -> Tensor:
    """Values and onset (H, P+1) at which each hypothesis' signature matches the residual best.

    Generalised likelihood ratio over faults and onsets (Willsky & Jones 1976): the signature is the change of the
    innovations by a small fault, scaled by least squares. It is computed for ONSETS onsets and shifted in time for the
    samples between them, because a jump of a reading shows in a few samples only. base (1, S, sensors): white
    innovations without a change.
    """
    if not hypotheses:
        return believed.new_zeros(0, len(believed) + 1)
    onsets = _onsets(window, ONSETS)
    theta = believed.repeat(len(hypotheses), ONSETS, 1)
    move = TRIAL_SIZE * observer.space_width()
    for i, hypothesis in enumerate(hypotheses):
        for c in hypothesis.columns:
            theta[i, :, c] += _inward(observer, believed, c, float(move[c]))
    late = torch.tensor([h.incipient for h in hypotheses]).repeat_interleave(ONSETS)
    changes = ChangeHypotheses(theta.flatten(0, 1), onsets.repeat(len(hypotheses)), late)
    reach = len(window) // (2 * ONSETS) + 1  # samples to half-way between two onsets
    parts = [
        _matches(base - observer.white_innovations(window, believed, part), base, reach)
        for part in observer.in_blocks(window, changes)
    ]
    match, power = (torch.cat(rows).reshape(len(hypotheses), -1) for rows in zip(*parts, strict=True))
    best = (match**2 / power).argmax(dim=1)
    rows, nearest, shift = torch.arange(len(hypotheses)), best // (2 * reach + 1), best % (2 * reach + 1) - reach
    scale = (match / power)[rows, best].unsqueeze(-1)
    value = believed + (theta[rows, nearest] - believed) * scale
    space = observer.search_space(believed)
    low, high = space.low(believed), space.high(believed)
    interval = (window.samples.time[-1] - window.samples.time[0]) / len(window)
    onset = (onsets[nearest] + shift * interval).clamp(window.samples.time[0], window.samples.time[-2])
    return torch.cat([value.clamp(low, high), onset.unsqueeze(-1)], dim=-1)


def _matches(shape: Tensor, base: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Products of shifted signatures with the residual, and their sums of squares, (L, 2 reach + 1) each.

    shape (L, S, sensors), shifted by -reach .. reach samples; base (1, S, sensors). The part of a signature that
    a shift moves beyond the window is lost, and zeros come in.
    """
    count = shape.shape[1]
    spectrum = torch.fft.rfft(shape, 2 * count, dim=1).conj() * torch.fft.rfft(base, 2 * count, dim=1)
    product = torch.fft.irfft(spectrum, 2 * count, dim=1).sum(-1)
    shifts = torch.arange(-reach, reach + 1)
    total = torch.nn.functional.pad(shape.square().sum(-1).cumsum(1), (1, 0))
    first, last = (-shifts).clamp(0, count), (count - shifts).clamp(0, count)
    power, rounding = total[:, last] - total[:, first], torch.finfo(total.dtype).eps ** 0.5
    return product[:, shifts % (2 * count)], power.maximum(rounding * total[:, -1:]).clamp(min=1e-30)


def oscillation_guess(
    observer: ObserverBank, window: ObserverWindow, believed: Tensor, hypothesis: Hypothesis, base: Tensor
) -> Tensor:
    """Values and onset (1, P+1) for an oscillation.

    Candidate periods are the strongest ones in the residual; amplitude and phase follow by least squares on the
    signatures of a sine and a cosine.
    """
    size, period, phase = hypothesis.columns[0], *hypothesis.shape
    first, last = float(window.samples.time[0]), float(window.samples.time[-1])
    sampling, bounds = float(torch.diff(window.samples.time).median()), observer.space.parameters[period]
    fastest, slowest = max(4.0 * sampling, bounds.low), min(2.0 * (last - first), bounds.high)
    periods = strongest_periods(base[0], sampling, fastest, slowest, OSCILLATION_PERIODS)
    onsets = _onsets(window, OSCILLATION_ONSETS)
    grid = torch.cartesian_prod(periods, onsets, believed.new_tensor([0.0, 0.5 * torch.pi]))
    theta = believed.repeat(len(grid), 1)
    trial = TRIAL_SIZE * float(observer.space_width()[size])
    theta[:, size], theta[:, period], theta[:, phase] = trial, grid[:, 0], grid[:, 2]
    changes = ChangeHypotheses(theta, grid[:, 1], torch.zeros(len(grid), dtype=torch.bool))
    products = []
    for part in observer.in_blocks(window, changes, even=2):
        shape = (base - observer.white_innovations(window, believed, part)).flatten(1).reshape(len(part) // 2, 2, -1)
        columns = torch.cat([shape, base.flatten(1).expand(len(shape), 1, -1)], dim=1)
        products.append(columns @ columns.mT)
    gram = torch.cat(products)
    normal = gram[:, :2, :2] + 1e-12 * gram[:, :2, :2].diagonal(dim1=1, dim2=2).amax(1).clamp(min=1e-30)[
        :, None, None
    ] * torch.eye(2, dtype=gram.dtype)
    scale = torch.linalg.solve(normal, gram[:, :2, 2:])[..., 0]
    best = int((scale * gram[:, :2, 2]).sum(1).argmax())
    sine, cosine = scale[best].tolist()
    start = believed.clone()
    amplitude = trial * float(scale[best].norm())
    start[size] = min(amplitude, observer.space.parameters[size].high)
    start[period], start[phase] = grid[2 * best, 0], math.atan2(cosine, sine)
    return torch.cat([start, grid[2 * best, 1][None]])[None]


def _inward(observer: ObserverBank, believed: Tensor, column: int, size: float) -> float:
    """`size` with the sign that keeps the parameter within its range."""
    return size if float(believed[column]) + size <= observer.space.parameters[column].high else -size
