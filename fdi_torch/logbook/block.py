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
_WIDEST = 32
"""Bytes that are moved for a number: no less than its text, and no more than reach from it into the next sample's."""
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
    columns = np.column_stack([time, *values])
    bare = orjson.dumps(columns.ravel(), option=orjson.OPT_SERIALIZE_NUMPY)
    text = np.frombuffer(bare + bytes(_WIDEST), np.uint8)
    stops = np.append(np.flatnonzero(text == _COMMA), len(bare) - 1)
    begins = np.ascontiguousarray(np.append(0, stops[:-1]).reshape(columns.shape).T) + 1
    lengths = np.ascontiguousarray(stops.reshape(columns.shape).T - begins)
    pieces = _pieces(names)
    sizes = sum(lengths[column] for _, column, _ in pieces) + sum(len(piece) + last for piece, _, last in pieces)
    stop = np.cumsum(sizes) - sizes  # of what has its place already, in each sample
    data = np.empty(int(sizes.sum()) + _WIDEST, np.uint8)
    numbers, target = _windows(text, _WIDEST), _windows(data, _WIDEST)
    places, ends = [], []
    for piece, column, last in pieces:
        places.append(stop)
        begin = stop + len(piece)
        target[begin] = numbers[begins[column]]  # with what follows it there, which what is written next covers
        stop = begin + lengths[column] + last
        ends += [stop] if last else []
    for (piece, *_), place in zip(pieces, places, strict=True):
        _windows(data, len(piece))[place] = np.frombuffer(piece, f"V{len(piece)}")
    found = np.column_stack(ends)
    data[found - 1] = _CLOSING
    return Block(channels, sequences, log_times, data, found)


def _pieces(names: Sequence[Sequence[str]]) -> list[tuple[bytes, int, bool]]:
    """Of each number of a sample: what stands before it, its column (time is the first), is it its record's last?"""
    pieces, column = [], 0
    for named in names:
        pieces.append((bytes(_HEAD.itemsize) + b'{"t":', 0, not named))
        for k, name in enumerate(named):
            column += 1
            pieces.append((b"," + _key(name), column, k == len(named) - 1))
    return pieces


def _key(name: str) -> bytes:
    return orjson.dumps(name) + b":"


def _windows(array: np.ndarray, width: int) -> np.ndarray:
    """Every stretch of so many bytes of an array of bytes, at each place one, as items to be written."""
    return np.ndarray((len(array) - width + 1,), f"V{width}", buffer=array, strides=(1,))
