"""Fault isolation: fit every hypothesis about which parameters changed, when and by how much, and rank the fits.

Each fit starts from the onset and size at which the hypothesis' signature matches the residual best.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import posterior
from fdi_torch.monitor.hypothesis import Fault, Hypothesis, HypothesisFit, with_posterior, with_unlisted_as_one
from fdi_torch.monitor.hypothesis_fit import Prior, changes_of, fit, misfit, no_change_fit, point_of
from fdi_torch.monitor.observer_bank import ChangeHypotheses, ObserverBank, ObserverWindow, no_change
from fdi_torch.monitor.oscillation import strongest_periods

DEEPEST = 2  # largest number of simultaneous faults
SMALLEST_PROBABILITY = 1e-3  # explanations below it are not fitted again


def isolate(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    faults: Sequence[Fault],
    growth_times: tuple[float, float] | None = None,
    deepest: int = DEEPEST,
    healthy: Tensor | None = None,
    earlier: Sequence[HypothesisFit] = (),
    flows: bool = False,
    unlisted: Sequence[Fault] = (),
) -> list[HypothesisFit]:
    """Fits of all single changes, of the best ones combined with a further fault, and of no change, likeliest first.

    All faults of a hypothesis share one onset, and a window holds one change. believed (P,): parameters before the
    change. growth_times: shortest and longest time in which a growing fault passes through its range, s; None if all
    are sudden. healthy (P,): the same without faults; if given, recovery of the faults in `believed` is a hypothesis.
    earlier: previous fits of the same change, used as further initial guesses. flows: whether random flows are learnt
    from the window too; the misfits of two calls are then not those of the same noise. unlisted: faults that are not on
    the list; together they are one explanation.
    """
    manners = (False, True) if growth_times else (False,)
    outside = [f.size for f in unlisted]
    counts = len(faults) * len(manners), len(outside) * len(manners)
    prior = Prior(observer.space.names, counts[0], growth_times, outside, counts[1])
    plain, others = (
        [Hypothesis((f.size,), late) for late in manners for f in group if not f.shape] for group in (faults, unlisted)
    )
    oscillating = [Hypothesis(f.columns, shape=f.shape) for f in faults if f.shape]
    base = observer.white_innovations(window, believed, no_change(believed))
    most_pairs = len(faults) if deepest > 1 else 0
    single_starts, pairs = signature_guesses(observer, window, believed, plain, base, most_pairs)
    starts = torch.cat(
        [
            single_starts,
            signature_guesses(observer, window, believed, others, base)[0],
            *(oscillation_guess(observer, window, believed, h, base) for h in oscillating),
        ]
    )
    recoveries = [] if healthy is None else recovery_hypotheses(believed, healthy, faults)
    if healthy is not None and recoveries:
        starts = torch.cat([starts, recovery_guesses(observer, window, believed, healthy, recoveries)])
    earlier = [f for f in earlier if f.hypothesis.columns]
    if earlier:
        starts = torch.cat([starts, torch.stack([point_of(f) for f in earlier])])
    hypotheses = [*plain, *others, *oscillating, *recoveries, *(f.hypothesis for f in earlier)]
    fits = _best_of_each(fit(observer, window, believed, hypotheses, starts, misfit(base), prior))
    # Where nothing fits, the law of the plant or of a known fault is wrong: no evidence for a cause outside the list.
    fits = [f for f in fits if f.fits or f.hypothesis.columns[0] not in outside]
    for depth in range(2, deepest + 1):
        best = [f for f in fits if f.hypothesis.count < deepest and f.hypothesis.columns[0] not in outside][:2]
        origin = {b.hypothesis.with_fault(f): b for b in best for f in faults if f.size not in b.hypothesis.columns}
        wider = [h for h in origin if h not in {f.hypothesis for f in fits}]
        points = [point_of(origin[h]) for h in wider]
        # Two faults may mask each other, so that neither is among the best alone.
        for pair, start in pairs if depth == 2 else ():
            wider.append(pair)
            points.append(start)
        if not wider:
            break
        # The best fits continue as well: otherwise the gain of further iterations would count as evidence for the
        # additional fault.
        wider += [b.hypothesis for b in best]
        points += [point_of(b) for b in best]
        wider_fits = fit(observer, window, believed, wider, torch.stack(points), misfit(base), prior)
        fits = _best_of_each([*fits, *wider_fits])
    ranked = with_posterior([*fits, no_change_fit(observer, window, believed, base)])
    if flows and ranked[0].hypothesis.columns and ranked[0].fits:
        observer, ranked = with_flows_of_window(observer, window, believed, ranked, prior)
    ranked = with_unlisted_as_one(ranked, outside) if outside else ranked
    return [_beyond_range(observer, window, believed, f, prior) if f.at_bound else f for f in ranked]


def with_flows_of_window(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    ranked: Sequence[HypothesisFit],
    prior: Prior,
    always: Sequence[Hypothesis] = (),
) -> tuple[ObserverBank, list[HypothesisFit]]:
    """The fits repeated with random flows that are learnt from the window too, because a short fault-free part leaves
    them uncertain.

    First, the hypotheses are fitted again with the flows that are most likely under the likeliest change, apart from
    those that are far from plausible with their previous values, both with the earlier flows and with these. Then the
    evidence of each plausible hypothesis, and of those of `always`, is raised by the log-likelihood that flows learnt
    under it add.
    """
    likeliest = next(f for f in ranked if f.hypothesis.columns)
    observer, _ = observer.learning_from(window, believed, changes_of([likeliest]))
    base = observer.white_innovations(window, believed, no_change(believed))
    blocks = observer.in_blocks(window, changes_of(ranked))
    misfits = torch.cat([0.5 * observer.white_innovations(window, believed, b).square().sum((1, 2)) for b in blocks])
    evidence = [f.evidence + f.misfit - now for f, now in zip(ranked, misfits.tolist(), strict=True)]
    changes = [
        f
        for f, p in zip(ranked, posterior(evidence), strict=True)
        if f.hypothesis.columns and max(f.probability, p) > SMALLEST_PROBABILITY**2
    ]
    starts, hypotheses = torch.stack([point_of(f) for f in changes]), [f.hypothesis for f in changes]
    fits = fit(observer, window, believed, hypotheses, starts, misfit(base), prior)
    fits.append(no_change_fit(observer, window, believed, base))
    likely = {f.hypothesis for f in (*ranked, *with_posterior(fits)) if f.probability > SMALLEST_PROBABILITY}
    likely.update(always)
    for i, f in enumerate(fits):
        if f.hypothesis in likely:
            gain = observer.learning_from(window, believed, changes_of([f]))[1]
            fits[i] = replace(f, evidence=f.evidence + gain)
    return observer, with_posterior(fits)


def _beyond_range(
    observer: ObserverBank, window: ObserverWindow, believed: Tensor, ended: HypothesisFit, prior: Prior
) -> HypothesisFit:
    """A fit that stopped at an end of a range, with the values and the onset that it has without that end.

    Its probability remains that of the range. At the end of the range, an earlier onset would take the place of a
    larger size.
    """
    if ended.probability < SMALLEST_PROBABILITY:
        return ended
    space = observer.search_space(ended.value)
    [free] = fit(observer, window, believed, [ended.hypothesis], point_of(ended)[None], 0.0, prior, space=space)
    wider = free.misfit_ratio**0.5
    onset = {"onset": free.onset, "onset_std": free.onset_std * wider}
    return replace(ended, value=free.value, std=free.std * wider, misfit=free.misfit, **onset)


def _best_of_each(fits: Sequence[HypothesisFit]) -> list[HypothesisFit]:
    """The best fit of each hypothesis, best first."""
    best: dict[Hypothesis, HypothesisFit] = {}
    for f in sorted(fits, key=lambda fit: -fit.evidence):
        best.setdefault(f.hypothesis, f)
    return list(best.values())


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


def recovery_guesses(
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    healthy: Tensor,
    hypotheses: Sequence[Hypothesis],
) -> Tensor:
    """Starting values and onset of H recoveries, (H, P+1): the onset with the smallest sum of squared innovations."""
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
    observer: ObserverBank,
    window: ObserverWindow,
    believed: Tensor,
    hypotheses: Sequence[Hypothesis],
    base: Tensor,
    most: int = 0,
) -> tuple[Tensor, list[tuple[Hypothesis, Tensor]]]:
    """Values and onset (H, P+1) at which each hypothesis' signature matches the residual best; and the pairs of these
    changes, `most` at most, that together match it best, each with values and onset (P+1,).

    Generalised likelihood ratio over faults and onsets (Willsky & Jones 1976): the signature is the change of the
    innovations by a small fault, scaled by least squares. It is computed for ONSETS onsets and shifted in time for the
    samples between them, because a jump of a reading shows in a few samples only; pairs begin at one of the ONSETS.
    hypotheses: of one column each. base (1, S, sensors): white innovations without a change.
    """
    if not hypotheses:
        return believed.new_zeros(0, len(believed) + 1), []
    onsets, count = _onsets(window, ONSETS), len(hypotheses)
    columns = torch.tensor([h.columns[0] for h in hypotheses])
    rows, width = torch.arange(count), TRIAL_SIZE * observer.space_width()
    move = believed.new_tensor([_inward(observer, believed, c, float(width[c])) for c in columns.tolist()])
    theta = believed.repeat(count, 1)
    theta[rows, columns] += move
    late = torch.tensor([h.incipient for h in hypotheses])
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
    best = (match**2 / power).argmax(dim=1)
    nearest, shift = best // (2 * reach + 1), best % (2 * reach + 1) - reach
    space = observer.search_space(believed)
    low, high = space.low(believed), space.high(believed)
    value = theta.clone()
    value[rows, columns] = believed[columns] + move * (match / power)[rows, best]
    interval = (window.samples.time[-1] - window.samples.time[0]) / len(window)
    onset = (onsets[nearest] + shift * interval).clamp(window.samples.time[0], window.samples.time[-2])
    singles = torch.cat([value.clamp(low, high), onset.unsqueeze(-1)], dim=-1)

    if not most:
        return singles, []
    size, gain = _joint_sizes(torch.cat(grams), torch.cat(scores))
    final = believed[columns] + move * size  # (ONSETS, H, H): value of the column's hypothesis beside the row's
    inside = (final >= low[columns]) & (final <= high[columns])
    possible = torch.triu(columns.unsqueeze(1) != columns, diagonal=1) & (late.unsqueeze(1) == late)
    gain = torch.where(inside & inside.mT & possible, gain, 0.0)
    gain, begin = gain.max(dim=0)
    pairs = []
    for flat in gain.flatten().argsort(descending=True)[:most].tolist():
        i, j = divmod(flat, count)
        if gain[i, j] > 0.0:
            start = torch.cat([believed, onsets[begin[i, j]][None]])
            start[columns[i]], start[columns[j]] = final[begin[i, j], j, i], final[begin[i, j], i, j]
            both = tuple(sorted((*hypotheses[i].columns, *hypotheses[j].columns)))
            pairs.append((replace(hypotheses[i], columns=both), start))
    return singles, pairs


def _joint_sizes(gram: Tensor, score: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares on two signatures at a time. gram (K, H, H), score (K, H): products of the signatures with each
    other and with the residual.

    Returns the size of each signature beside each other one, (K, H beside, H), and the reduction of the sum of squares
    by both, (K, H, H); 0 where two are nearly collinear.
    """
    strength = torch.diagonal(gram, dim1=1, dim2=2)
    determinant = strength.unsqueeze(2) * strength.unsqueeze(1) - gram**2
    separable = determinant > COLLINEAR * strength.unsqueeze(2) * strength.unsqueeze(1)
    size = strength.unsqueeze(2) * score.unsqueeze(1) - gram * score.unsqueeze(2)
    size = torch.where(separable, size / determinant, 0.0)
    return size, size * score.unsqueeze(1) + (size * score.unsqueeze(1)).mT


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
