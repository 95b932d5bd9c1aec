"""How easily another cause passes for the one that was named, under this excitation: simulated, to first order.

In turn each other effect of the library makes the gap: at the size at which its column of the linearised plant is as
large as the gap found, with fresh noise. Every effect is then fitted to it by regression, once with the true one in the
library and once without. Only single causes are drawn and fitted, and thresholds stay where a start put them, so that
these are rates of a simpler search than the one that was made.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.library import canonical
from fdi_torch.gap.screening import Option, Pairs
from fdi_torch.plant.description import PlantDescription

DRAWS, SEED = 40, 0
PASSES = 0.02  # share of the gap left open by an impostor that a fit test would let pass
SEEN = 1e-6


def simulated_impostors(found: Pairs, named: CauseName, gap: float, plant: PlantDescription) -> dict[str, Any] | None:
    """Of `draws` recordings in which another cause made a gap of this size (chi-square units), how many would have been
    given the name `named`: 'confused' with the true cause in the library, 'passed' without it, with the causes it
    passed for most often. None where no other effect can make such a gap within its range.
    """
    kinds = [canonical(o.cause, plant) for o in found.options]
    ours = canonical(named, plant)
    rivals = [i for i, o in enumerate(found.options) if kinds[i] != ours and _possible(o, found.gram[i, i], gap)]
    if not rivals:
        return None
    scores = _scores(found.gram, rivals, gap)  # (R, D, M)
    strength = torch.diagonal(found.gram)
    gains = torch.where((scores > 0) & (strength > SEEN), scores**2 / strength.clamp(min=SEEN), 0.0)
    mine = torch.tensor([kind == ours for kind in kinds])
    confused, passed = 0, dict.fromkeys((kinds[i] for i in rivals), 0)
    for row, i in enumerate(rivals):
        true = torch.tensor([kind == kinds[i] for kind in kinds])
        best, others = gains[row][:, mine].amax(1), gains[row][:, ~mine & ~true]
        confused += int((gains[row].amax(1) <= best).sum())
        leads = best >= others.amax(1) if others.shape[1] else torch.ones_like(best, dtype=torch.bool)
        passed[kinds[i]] += int((leads & (best > (1.0 - PASSES) * gains[row][:, true].amax(1))).sum())
    worst = sorted((c for c in passed if passed[c]), key=lambda c: -passed[c])[:5]
    return {
        "draws": DRAWS * len(rivals),
        "rivals": len(passed),
        "confused": confused,
        "passed": sum(passed.values()),
        "passed_for": [{"effect": name, "location": at} for name, at in worst],
    }


def _possible(option: Option, strength: Tensor, gap: float) -> bool:
    """Whether the effect can make such a gap within its range, to first order from its start."""
    if float(strength) <= SEEN:
        return False
    name, start = next(iter(option.start.items()))
    size = next(p for p in option.parameters if name.endswith(f".{p.name}"))
    needed = size.nominal + (gap / float(strength)) ** 0.5 * (start - size.nominal)
    return size.low <= needed <= size.high


def _scores(gram: Tensor, rivals: Sequence[int], gap: float) -> Tensor:
    """(R, D, M): what regression on each option's column sees of a rival at the size of the gap, and of the noise."""
    generator = torch.Generator().manual_seed(SEED)
    spectrum, basis = torch.linalg.eigh(gram)
    root = basis * torch.sqrt(spectrum.clamp(min=0.0))
    noise = torch.randn(DRAWS, len(gram), generator=generator, dtype=gram.dtype) @ root.T
    sizes = torch.sqrt(gap / torch.diagonal(gram)[list(rivals)])
    return (sizes.unsqueeze(1) * gram[list(rivals)]).unsqueeze(1) + noise
