"""Initial guesses of the fits of changes: the sizes and onsets at which their signatures match the residual best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor

from fdi_torch.monitor.hypothesis import Fault, Hypothesis
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow, sudden_changes
from fdi_torch.monitor.oscillation import strongest_periods

ONSETS = 24  # candidate onsets in a window; the fit then varies the onset continuously
COLLINEAR = 1e-6  # share of a signature's square that another one leaves; below, rounding decides their sizes
TRIAL_SIZE = 0.02  # fault size for signatures, as a share of the parameter's range
OSCILLATION_PERIODS, OSCILLATION_ONSETS = 32, 6  # candidates for an oscillation
ALL_SETS = 4  # with more known faults than this, not every set of them is tried for recovery


def recovery_hypotheses(believed: Tensor, healthy: Tensor, faults: Sequence[Fault]) -> list[Hypothesis]:
    """Hypotheses, each of which says that some of the known faults recovered.

    They cover every set of up to ALL_SETS known faults. Of more faults, one, all but one, or all of them recover.
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


def _onsets(window: ObserverWindow, count: int) -> Tensor:
    """Candidate onsets spread evenly over a window, s."""
    time = window.samples.time
    return time[0] + (time[-1] - time[0]) * (torch.arange(count, dtype=time.dtype) + 0.5) / count


def signature_guesses(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    healthy: Tensor,
    hypotheses: Sequence[Hypothesis],
    base: Tensor,
    most: int = 0,
) -> tuple[Tensor, list[tuple[Hypothesis, Tensor]]]:
    """Values and onset (H, P+1) at which each hypothesis' signature matches the residual best; and the pairs of these
    changes, `most` at most, that together match it best, each with values and onset (P+1,).

    Generalised likelihood ratio over faults and onsets (Willsky & Jones 1976): the signature is the change of the
    innovations by a small fault, scaled by least squares, or by a recovery, which has a scale of one. It is computed
    for ONSETS onsets and shifted in time for the samples between them, because a jump of a reading shows in a few
    samples only; pairs begin at one of the ONSETS. hypotheses: recoveries to `healthy` (P,), then new faults of
    one column each. base (1, S, sensors): white innovations without a change.
    """
    if not hypotheses:
        return believed.new_zeros(0, len(believed) + 1), []
    onsets, count = _onsets(window, ONSETS), len(hypotheses)
    theta, width = believed.repeat(count, 1), TRIAL_SIZE * observer.space_width()
    for row, h in enumerate(hypotheses):
        for c in h.columns:
            theta[row, c] = healthy[c] if h.recovered else believed[c] + _inward(observer, believed, c, float(width[c]))
    columns = torch.tensor([h.columns[0] for h in hypotheses])
    move, changed = (theta - believed)[torch.arange(count), columns], theta != believed
    late, whole = (torch.tensor(x) for x in zip(*((h.incipient, bool(h.recovered)) for h in hypotheses), strict=True))
    changes = ChangeHypotheses(theta.repeat(ONSETS, 1), onsets.repeat_interleave(count), late.repeat(ONSETS))
    reach = len(window) // (2 * ONSETS) + 1  # samples to half-way between two onsets
    matches, scores, grams = [], [], []
    for block in observer.in_blocks(window, changes, even=count):
        shape = base - observer.white_innovations(window, believed, block)
        matches.append(_matches(shape, base, reach))
        signatures = shape.flatten(1).unflatten(0, (-1, count))
        grams.append(signatures @ signatures.mT)
        scores.append(signatures @ base.flatten())
    match, power = (
        torch.cat(x).unflatten(0, (ONSETS, count)).transpose(0, 1).flatten(1) for x in zip(*matches, strict=True)
    )
    size = torch.where(whole.unsqueeze(1), 1.0, match / power)
    best = (size * (2.0 * match - size * power)).argmax(dim=1, keepdim=True)
    nearest, shift = best // (2 * reach + 1), best % (2 * reach + 1) - reach
    space = observer.search_space(believed)
    low, high = space.low(believed), space.high(believed)
    value = torch.lerp(believed, theta, size.gather(1, best))
    interval = (window.samples.time[-1] - window.samples.time[0]) / len(window)
    onset = (onsets[nearest] + shift * interval).clamp(window.samples.time[0], window.samples.time[-2])
    singles = torch.cat([value.clamp(low, high), onset], dim=-1)

    if not most:
        return singles, []
    size, gain = _joint_sizes(torch.cat(grams), torch.cat(scores), whole)
    final = believed[columns] + move * size  # (ONSETS, H, H): value of the column's hypothesis beside the row's
    inside = whole | ((final >= low[columns]) & (final <= high[columns]))
    possible = torch.triu(~changed[:, columns], diagonal=1) & (late.unsqueeze(1) == late) & ~whole
    gain = torch.where(inside & inside.mT & possible, gain, 0.0)
    gain, begin = gain.max(dim=0)
    pairs = []
    for flat in gain.flatten().argsort(descending=True)[:most].tolist():
        i, j = divmod(flat, count)
        if gain[i, j] > 0.0:
            start = torch.cat([believed.lerp(theta[i], size[begin[i, j], j, i]), onsets[begin[i, j]][None]])
            start[columns[j]] = final[begin[i, j], i, j]
            pairs.append((hypotheses[i].with_fault(Fault(int(columns[j]))), start))
    return singles, pairs


def _joint_sizes(gram: Tensor, score: Tensor, whole: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares on two signatures at a time. gram (K, H, H), score (K, H): products of the signatures with each
    other and with the residual. whole (H,) bool: those with a size of one.

    Returns the size of each signature beside each other one, (K, H beside, H), and the reduction of the sum of squares
    by both, (K, H, H); 0 where two are nearly collinear.
    """
    strength = torch.diagonal(gram, dim1=1, dim2=2)
    determinant = strength.unsqueeze(2) * strength.unsqueeze(1) - gram**2
    separable = determinant > COLLINEAR * strength.unsqueeze(2) * strength.unsqueeze(1)
    size = (strength.unsqueeze(2) * score.unsqueeze(1) - gram * score.unsqueeze(2)) / determinant
    size = torch.where(whole.unsqueeze(1), (score.unsqueeze(1) - gram) / strength.unsqueeze(1), size)
    size = torch.where(separable, torch.where(whole, 1.0, size), 0.0)
    each = size * (2.0 * score.unsqueeze(1) - size * strength.unsqueeze(1))
    return size, each + each.mT - 2.0 * size * size.mT * gram


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
    shape = base - observer.white_innovations(window, believed, sudden_changes(theta, grid[:, 1]))
    shape = shape.flatten(1).unflatten(0, (-1, 2))
    columns = torch.cat([shape, base.flatten(1).expand(len(shape), 1, -1)], dim=1)
    gram = columns @ columns.mT
    largest = gram[:, :2, :2].diagonal(dim1=1, dim2=2).amax(1).clamp(min=1e-30)
    normal = gram[:, :2, :2] + 1e-12 * largest[:, None, None] * torch.eye(2, dtype=gram.dtype)
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
