"""What every reader of recordings is: a function from a file and the channels wanted of it to a Recording in SI."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fdi_torch.recording import Hold, Recording


@dataclass(frozen=True)
class ChannelSource:
    """Where a channel's numbers come from.

    column: its header (the channel's own name where None). unit: of the numbers in it (from the header where None).
    constant: the value (SI, in `unit`) of a channel that the file does not hold; NaN where it was never recorded.
    """

    column: str | None = None
    unit: str | None = None
    constant: float | None = None


class Reader(Protocol):
    """The named channels of a file. In `mapping`, which says where those stand whose names do not tell, time is `t`.

    Raises ValueError, naming the file, for what is not in it or cannot be understood.
    """

    def __call__(
        self,
        path: Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        mapping: Mapping[str, ChannelSource] | None = None,
        hold: Hold = "zero_order",
    ) -> Recording: ...


def file_sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
