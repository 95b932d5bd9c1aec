"""Counter-based random numbers: each draw is a hash of (seed, counters, position), without generator state.

The draws of a problem therefore do not depend on the batch that it is part of, nor on the device. The hash is
splitmix64 (Steele, Lea & Flood 2014, "Fast splittable pseudorandom number generators"; Stafford's finaliser 13) in
int64 arithmetic modulo 2^64.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def _signed(word: int) -> int:
    """The int64 with the same 64 bits as an unsigned word."""
    word &= 2**64 - 1
    return word - 2**64 if word >= 2**63 else word


_GOLDEN = _signed(0x9E3779B97F4A7C15)
_ROUNDS = ((30, _signed(0xBF58476D1CE4E5B9)), (27, _signed(0x94D049BB133111EB)), (31, 1))


def mix(words: Tensor) -> Tensor:
    """Scramble the bits of each int64 (last stage of splitmix64: Steele, Lea & Flood 2014); any shape."""
    words = words.clone()
    shifted = torch.empty_like(words)
    for shift, factor in _ROUNDS:
        # An arithmetic shift copies the sign bit; the mask makes it a logical one.
        torch.bitwise_right_shift(words, shift, out=shifted).bitwise_and_(2 ** (64 - shift) - 1)
        words.bitwise_xor_(shifted)
        if factor != 1:
            words.mul_(factor)
    return words


def stream(seed: Int[Tensor, "*problems"], *counters: int) -> Int[Tensor, "*problems"]:
    """Keys (*problems) int64 of independent random streams, one for each seed (*problems) and tuple of counters."""
    key = mix(seed)
    for counter in counters:
        key = mix(key + _signed(_GOLDEN * (counter + 1)))
    return key


def uniform(key: Int[Tensor, "*problems"], count: int) -> Float[Tensor, "*problems count"]:
    """The first `count` draws of each stream, uniform on the open interval (0, 1).

    key (*problems) int64 -> (*problems, count) float64. Each draw is the midpoint of one of 2^32 equal cells.
    """
    # Each 64-bit word yields two draws.
    position = torch.arange(1, count // 2 + count % 2 + 1, device=key.device) * _GOLDEN
    halves = mix(key[..., None] + position).view(torch.int32)[..., :count]
    return halves.to(torch.float64).add_(2.0**31 + 0.5).mul_(2.0**-32)


def problem_seeds(seed: int, shape: tuple[int, ...] = (), device: torch.device | str = "cpu") -> Tensor:
    """Seeds int64 for a batch of problems of this shape, derived from one number."""
    count = int(torch.Size(shape).numel())
    one = torch.full((), _signed(seed), dtype=torch.int64, device=device)
    return mix(stream(one) + torch.arange(1, count + 1, device=device) * _GOLDEN).reshape(shape)
