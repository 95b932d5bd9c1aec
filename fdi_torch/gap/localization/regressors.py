"""Forms of which a discrepancy may be put together: signals along a recording, many more than any one needs.

What depends on a local variable bends or jumps at some of its values; what keeps a memory lags, sticks or dies away;
what comes from elsewhere sets in, stops or creeps at some time, or comes and goes in a period.

Times are those of tanks on a bench, and multiples of them by `pace` for others (`plant.scales.time_scale`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.simulate.scan import scan_in_time

LAGS = (3.0, 10.0, 30.0, 100.0, 300.0)  # s
FADES = (10.0, 40.0, 160.0)  # s, of what a step up, or a step down, leaves behind
BANDS = (0.03, 0.08, 0.16, 0.3)  # of the signal's range, within which it sticks
JERKS = (0.1, 0.2, 0.3, 0.4)  # of the signal's range
STROKES = (8.0, 20.0, 40.0, 80.0, 160.0, 320.0)  # s, through the signal's range
HEATS = (150.0, 500.0)  # s, over which its own recent past weakens (or strengthens) a flow
RAMPS = 12  # in time, evenly


def bends(x: Tensor, ends: tuple[float, float], count: int) -> list[Tensor]:
    """1, x, and x beyond each of `count` - 2 values between the ends."""
    at = torch.linspace(*ends, count, dtype=x.dtype).tolist()
    return [torch.ones_like(x), x - at[0], *((x - c).clamp(min=0.0) for c in at[1:-1])]


def jumps(x: Tensor, ends: tuple[float, float], count: int) -> list[Tensor]:
    """Whether x is beyond each of `count` values between the ends."""
    return [(x >= c).to(x.dtype) for c in torch.linspace(*ends, count + 2, dtype=x.dtype).tolist()[1:-1]]


def memories(x: Tensor, step: Tensor, pace: float) -> list[Tensor]:
    """How x differs from what lags behind it; what its steps leave behind."""
    change = torch.diff(x, prepend=x[:1])
    risen, fallen = change.clamp(min=0.0), (-change).clamp(min=0.0)
    lagging = [lagged(x, step, pace * tau) - x for tau in LAGS]
    fading = [faded(y, step, pace * tau) for tau in FADES for y in (risen, fallen)]
    return [*lagging, *fading]


def sticks(x: Tensor, ends: tuple[float, float]) -> list[Tensor]:
    """How x differs from what follows it only within a band."""
    band = x.new_tensor(BANDS).unsqueeze(1) * (ends[1] - ends[0])
    return list((stuck(x, band) - x).unbind())


def slews(x: Tensor, step: Tensor, ends: tuple[float, float], pace: float) -> list[Tensor]:
    """How x differs from what follows it no faster than through its range in some time."""
    return [slewed(x, step, (ends[1] - ends[0]) / (pace * time)) - x for time in STROKES]


def jerks(x: Tensor, ends: tuple[float, float]) -> list[Tensor]:
    """How x differs from what stays until it is a band away, and then jumps to it."""
    return [jerked(x, share * (ends[1] - ends[0])) - x for share in JERKS]


def relays(x: Tensor, ends: tuple[float, float], count: int) -> list[tuple[float, Tensor]]:
    """Of two of `count` values the lower one, and whether x has been beyond the upper since it was last below it."""
    width = (ends[1] - ends[0]) / count
    at = [ends[0] + width * (j + 0.5) for j in range(count)]
    return [(low, switched(x, low, high)) for i, low in enumerate(at) for high in at[i + 1 :]]


def tirings(x: Tensor, step: Tensor, ends: tuple[float, float], pace: float) -> list[Tensor]:
    """x times its own recent mean."""
    scale = max(abs(ends[0]), abs(ends[1]), 1e-12)
    return [x * lagged(x, step, pace * tau) / scale for tau in HEATS]


def courses(time: Tensor, duration: float, periods: Sequence[float], steps: int) -> list[Tensor]:
    """1, steps and ramps in time, and waves."""
    stepped = [(time >= duration * j / steps).to(time.dtype) for j in range(1, steps)]
    ramps = [(time / duration - j / RAMPS).clamp(min=0.0) for j in range(RAMPS)]
    waves = [wave(2.0 * math.pi * time / period) for period in periods for wave in (torch.sin, torch.cos)]
    return [torch.ones_like(time), *stepped, *ramps, *waves]


def lagged(x: Tensor, step: Tensor, tau: float) -> Tensor:
    """First order, from rest at the first value; at the end of each step."""
    keep = torch.exp(-step / tau)
    return _scanned(keep, (1.0 - keep) * x, x[0])


def faded(x: Tensor, step: Tensor, tau: float) -> Tensor:
    """What has come in at each step, dying away."""
    return _scanned(torch.exp(-step / tau), x, torch.zeros_like(x[0]))


def stuck(x: Tensor, band: Tensor) -> Tensor:
    """The play operator: it stays until x (K,) is further than the band (B, 1), and then follows the band behind.

    Each step limits what is held to x's surroundings, and limits one after the other make a limit: of so many steps
    before each, twice as many in every round. Returns (B, K).
    """
    low, high = x - band, x + band
    reach = 1
    while reach < x.shape[-1]:
        now_low, now_high = low[:, reach:], high[:, reach:]
        low, high = (
            torch.cat([y[:, :reach], torch.minimum(torch.maximum(y[:, :-reach], now_low), now_high)], dim=1)
            for y in (low, high)
        )
        reach *= 2
    return torch.minimum(torch.maximum(x[0], low), high)


def jerked(x: Tensor, band: float) -> Tensor:
    """Stiction: it stays until x is further than the band, and is then where x is."""
    held, found = float(x[0]), []
    for value in x.tolist():
        held = value if abs(value - held) > band else held
        found.append(held)
    return x.new_tensor(found)


def switched(x: Tensor, low: float, high: float) -> Tensor:
    """1 from where x exceeds `high` to where it falls below `low`, else 0; between them as it was."""
    on, found = float(x[0]) > 0.5 * (low + high), []
    for value in x.tolist():
        on = value >= low if on else value > high
        found.append(float(on))
    return x.new_tensor(found)


def slewed(x: Tensor, step: Tensor, rate: float) -> Tensor:
    """It moves towards x by no more than rate times step."""
    held, found = float(x[0]), []
    for value, most in zip(x.tolist(), (rate * step).tolist(), strict=True):
        held += min(max(value - held, -most), most)
        found.append(held)
    return x.new_tensor(found)


def _scanned(keep: Tensor, added: Tensor, first: Tensor) -> Tensor:
    shape = (1, 1, 1, -1)
    return scan_in_time(keep.reshape(shape), added.reshape(shape), first.reshape(1, 1, 1))[0, 0, 0, 1:]


FINER = 4  # times finer than the recording's own frequencies
SURROUNDINGS = 15  # of the recording's own frequencies, to each side
CYCLES = 8  # that a line has to go through


def dominant_period(white: Tensor, spacing: float) -> float | None:
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
