"""Many samples at once as message records: the bytes that one after the other gives, in a tenth of the time.

A recording is most of what a run writes, and its messages differ in their numbers only. So the numbers are written as
text all together, and what stands between them is put in between afterwards, column by column.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import orjson
from mcap.opcode import Opcode

from fdi_torch.logbook.channel import Channel

Timed = tuple[Channel, int, int, int, bytes]
"""Channel, log time and publish time in ns, sequence number and payload of a message."""

_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("published", "<u8")]
)
_COMMA, _CLOSING = b",}"
_UNCOUNTED = 9
"""Bytes of a record that its length does not count: opcode and length."""


@dataclass(frozen=True)
class Block:
    """B samples of S channels in turn, each a record of the format; an iteration gives them as messages.

    sequences: of the first sample, one a channel. log_times (B,) in ns. data: the records, without the channels'
    numbers. ends (B, S): where each record ends in data.
    """

    channels: Sequence[Channel]
    sequences: Sequence[int]
    log_times: np.ndarray
    data: np.ndarray
    ends: np.ndarray

    def __len__(self) -> int:
        return self.ends.size

    def __iter__(self) -> Iterator[Timed]:
        return self.messages(0, len(self.ends))

    def messages(self, first: int, last: int) -> Iterator[Timed]:
        """The samples first..last."""
        start = int(self.ends[first - 1, -1]) if first else 0
        times = self.log_times[first:last].tolist()
        for i, time, ends in zip(count(first), times, self.ends[first:last].tolist(), strict=False):
            for channel, sequence, end in zip(self.channels, self.sequences, ends, strict=True):
                yield channel, time, time, sequence + i, self.data[start + _HEAD.itemsize : end].tobytes()
                start = end

    def number(self, numbers: Sequence[int]) -> None:
        """Writes the heads of the records; numbers: of the channels in this file."""
        heads = np.empty(len(self.ends), _HEAD)
        heads["opcode"] = Opcode.MESSAGE
        heads["log"] = heads["published"] = self.log_times
        starts = np.concatenate([[0], self.ends.ravel()[:-1]]).reshape(self.ends.shape)
        for k, number in enumerate(numbers):
            heads["length"] = self.ends[:, k] - starts[:, k] - _UNCOUNTED
            heads["channel"] = number
            heads["sequence"] = np.arange(self.sequences[k], self.sequences[k] + len(heads))
            _windows(self.data, _HEAD.itemsize)[starts[:, k]] = heads.view(f"V{_HEAD.itemsize}")


def block_of(
    channels: Sequence[Channel],
    sequences: Sequence[int],
    names: Sequence[Sequence[str]],
    values: Sequence[np.ndarray],
    time: np.ndarray,
    log_times: np.ndarray,
) -> Block:
    """Samples values[k] (B, N_k), finite float64, of channel k over time (B,) in s."""
    columns = np.column_stack([part for block in values for part in (time, block)])
    text = np.frombuffer(orjson.dumps(columns.ravel(), option=orjson.OPT_SERIALIZE_NUMPY), np.uint8)[1:]
    commas = np.flatnonzero(text == _COMMA)  # after each number but the last, which a bracket stops
    before = [piece for named in names for piece in (bytes(_HEAD.itemsize) + b'{"t":', *map(_key, named))]
    put_in = np.cumsum([len(piece) for piece in before])
    stops = np.append(commas, len(text) - 1).reshape(columns.shape)
    stops += put_in + put_in[-1] * np.arange(len(columns))[:, None]
    starts = np.concatenate([[0], stops.ravel()[:-1] + 1]).reshape(columns.shape)
    data = np.empty(stops[-1, -1] + 1, np.uint8)
    is_text = np.ones(len(data), bool)
    for j, piece in enumerate(before):
        _windows(data, len(piece))[starts[:, j]] = np.frombuffer(piece, f"V{len(piece)}")
        _windows(is_text, len(piece))[starts[:, j]] = np.zeros(1, f"V{len(piece)}")
    data[is_text] = text
    last = stops[:, np.cumsum([1 + len(named) for named in names]) - 1]
    data[last] = _CLOSING
    return Block(channels, sequences, log_times, data, last + 1)


def _key(name: str) -> bytes:
    return orjson.dumps(name) + b":"


def _windows(array: np.ndarray, width: int) -> np.ndarray:
    """Every stretch of so many bytes of an array of bytes, at each place one, as items to be written."""
    return np.ndarray((len(array) - width + 1,), f"V{width}", buffer=array, strides=(1,))
