"""What comes and goes by itself: a line in the spectrum of a residual."""

from __future__ import annotations

import torch
from torch import Tensor

FINER = 4  # times finer than the recording's own frequencies
SURROUNDINGS = 15  # of the recording's own frequencies, to each side
CYCLES = 8  # that a line has to go through


def spectral_line(white: Tensor, spacing: float) -> float | None:
    """The period (s) of what stands out most of its surroundings in the spectrum of a residual (S, C)."""
    samples = len(white)
    taper = torch.hann_window(samples, periodic=False, dtype=white.dtype).unsqueeze(-1)
    power = (torch.fft.rfft(white * taper, n=FINER * samples, dim=0).abs() ** 2).sum(dim=-1)
    if len(power) < 2 * SURROUNDINGS * FINER:
        return None
    width = 2 * SURROUNDINGS * FINER + 1
    around = torch.nn.functional.pad(power.reshape(1, 1, -1), (width // 2, width // 2), mode="reflect")[0, 0]
    median = around.unfold(0, width, FINER)[:, ::FINER].median(dim=-1).values
    ratio = power / median.repeat_interleave(FINER)[: len(power)]
    ratio[: CYCLES * FINER] = 0.0
    peak = int(ratio.argmax())
    return FINER * samples * spacing / peak if peak else None
