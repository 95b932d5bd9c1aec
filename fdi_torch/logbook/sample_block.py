"""Blocks of samples as message records: the same bytes as one message after the other, ten times faster.

Most of a log is recordings, whose messages differ in their numbers only. All numbers of a block are therefore converted
to text together, and the constant parts of the records are inserted afterwards, column by column.
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
"""Bytes copied for a number: at least its text, and not beyond the same number of the next sample."""
_UNCOUNTED = 9
"""Bytes of a record that its length field does not count: opcode and length."""


@dataclass(frozen=True)
class Block:
    """B samples of S channels in turn, each a message record; iteration yields them as messages.

    sequences: sequence number of the first sample of each channel. log_times (B,): ns. data: the records, without
    channel numbers. ends (B, S): end of each record in data.
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
        """The messages of samples first..last."""
        start = int(self.ends[first - 1, -1]) if first else 0
        times = self.log_times[first:last].tolist()
        for i, time, ends in zip(count(first), times, self.ends[first:last].tolist(), strict=False):
            for channel, sequence, end in zip(self.channels, self.sequences, ends, strict=True):
                yield channel, time, time, sequence + i, self.data[start + _HEAD.itemsize : end].tobytes()
                start = end

    def number(self, numbers: Sequence[int]) -> None:
        """Write the heads of the records; numbers: of the channels in this file."""
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
    """The block of samples values[k] (B, N_k), finite float64, of each channel k over time (B,), s."""
    columns = np.column_stack([time, *values])
    bare = orjson.dumps(columns.ravel(), option=orjson.OPT_SERIALIZE_NUMPY)
    text = np.frombuffer(bare + bytes(_WIDEST), np.uint8)
    stops = np.append(np.flatnonzero(text == _COMMA), len(bare) - 1)
    begins = np.ascontiguousarray(np.append(0, stops[:-1]).reshape(columns.shape).T) + 1
    lengths = np.ascontiguousarray(stops.reshape(columns.shape).T - begins)
    pieces = _pieces(names)
    sizes = sum(lengths[column] for _, column, _ in pieces) + sum(len(piece) + last for piece, _, last in pieces)
    stop = np.cumsum(sizes) - sizes  # end of the parts of each sample that have been placed
    data = np.empty(int(sizes.sum()) + _WIDEST, np.uint8)
    numbers, target = _windows(text, _WIDEST), _windows(data, _WIDEST)
    places, ends = [], []
    for piece, column, last in pieces:
        places.append(stop)
        begin = stop + len(piece)
        target[begin] = numbers[begins[column]]  # copies some bytes too many, which the next write covers
        stop = begin + lengths[column] + last
        ends += [stop] if last else []
    for (piece, *_), place in zip(pieces, places, strict=True):
        _windows(data, len(piece))[place] = np.frombuffer(piece, f"V{len(piece)}")
    record_ends = np.column_stack(ends)
    data[record_ends - 1] = _CLOSING
    return Block(channels, sequences, log_times, data, record_ends)


def _pieces(names: Sequence[Sequence[str]]) -> list[tuple[bytes, int, bool]]:
    """For each number of a sample: the text before it, its column (time is the first), and whether it ends its
    record.
    """
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
    """All windows of `width` bytes of an array of bytes, one per position, as writable items."""
    return np.ndarray((len(array) - width + 1,), f"V{width}", buffer=array, strides=(1,))
