"""CSV files that another program is still writing: their rows as they are completed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import SEEK_END
from itertools import islice
from pathlib import Path

import numpy as np

from fdi_torch.disk import named_errors
from fdi_torch.recordings.csv_binding import bind_table
from fdi_torch.recordings.csv_cells import parse_carefully
from fdi_torch.recordings.csv_files import SINCE_1970, channels_in_si, from_first
from fdi_torch.recordings.csv_text import WINDOWS, heading_of, joined, open_csv
from fdi_torch.recordings.sheets import fill_held
from fdi_torch.recordings.source import ChannelSource, clock_in
from fdi_torch.recordings.table_files import TableText


class GrowingCsv:
    """Reader of the completed rows of a CSV file that is still being written. Columns as for `read_csv`.

    origin: date of time 0 if it is not the first row, as `clock_zero` was before. input_units, output_units: SI.
    Raises ValueError if the file, its header or a column is missing, and if the file is replaced while it is read.
    """

    def __init__(
        self,
        path: Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        mapping: Mapping[str, ChannelSource] | None = None,
        origin: float | None = None,
    ) -> None:
        mapping = mapping or {}
        self.path, self._shift = path, clock_in(mapping).shift
        with open_csv(path) as handle:
            if isinstance(handle, TableText):
                raise ValueError(f"{path}: expected a CSV or MCAP file that is followed, got a table of another format")
            heading, _ = heading_of(path, handle)
            self._encoding = handle.encoding
        if self._encoding == "utf-16":
            raise ValueError(
                f"{path}: expected UTF-8 in a file that is still being written, got UTF-16; write it in UTF-8"
            )
        self._clock, channels, self._columns = bind_table(path, heading, (*inputs, *outputs), mapping)
        self._inputs, self._outputs = channels[: len(inputs)], channels[len(inputs) :]
        sources = [mapping.get(name, ChannelSource()) for name in inputs]
        self._held = {k: source.held for k, source in enumerate(sources) if source.held > 0.0}
        self._logged = np.empty((0, 1 + len(inputs)))  # the last rows with a logged value of a held input
        self._line = heading.lines
        self._origin = origin
        self._first: float | None = None
        self.input_units = tuple(b.si_unit for b in self._inputs)
        self.output_units = tuple(b.si_unit for b in self._outputs)
        with path.open("rb") as raw:
            self._place = sum(len(line) for line in islice(raw, self._line))

    @property
    def clock_zero(self) -> float | None:
        """Date of time 0, s since 1970; None if the file has no dates, and before its first row without `origin`."""
        if self._first is None:
            return self._origin
        dated = self._clock.stamps or self._first > SINCE_1970
        return self._first + self._columns.read_stamp.offset if dated else None

    def new(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[int, str]]]:
        """The rows completed since the last call: times (R,) s, inputs (R, M), outputs (R, N), SI. Time may jump.

        The fourth result has, for each row that could not be read, the number of rows before it and a sentence.
        """
        with named_errors(self.path), self.path.open("rb") as raw:
            if raw.seek(0, SEEK_END) < self._place:
                raise ValueError(
                    f"{self.path}: expected a file that grows, got one that has become shorter; it was replaced or "
                    "cut, follow the present one with --resume"
                )
            raw.seek(self._place)
            data = raw.read()
        whole = data[: data.rfind(b"\n") + 1]
        self._place += len(whole)
        rows: list[np.ndarray] = []
        problems = []
        for line in whole.decode(self._encoding, errors=WINDOWS).splitlines():
            try:
                row = parse_carefully([*joined([line], self._columns.heading)], self._columns, self._line)
                rows += [values for values in row if np.isfinite(values[0])]
            except ValueError as error:
                problems.append((len(rows), str(error)))
            self._line += 1
        table = np.array(rows).reshape(len(rows), len(self._columns.positions))
        inputs, outputs = (channels_in_si(table, self._columns, bounds) for bounds in (self._inputs, self._outputs))
        seconds = self._seconds(table[:, 0])
        outputs[~np.isfinite(outputs)] = np.nan
        return seconds, self._filled_inputs(seconds, inputs), outputs, problems

    def _filled_inputs(self, seconds: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Inputs (R, M) with empty cells filled by the last logged value while it is held, also from earlier rows."""
        rows = np.concatenate([self._logged, np.column_stack([seconds, inputs])])
        before = len(self._logged)
        if self._held and len(rows):
            last = {int(np.flatnonzero(~np.isnan(c))[-1]) for c in rows[:, 1:].T if not np.isnan(c).all()}
            self._logged = rows[sorted(last)]
        filled = [fill_held(rows[:, 0], c, self._held.get(k, 0.0), "zero_order") for k, c in enumerate(rows[:, 1:].T)]
        return np.stack(filled, axis=1)[before:] if filled else inputs

    def _seconds(self, clock: np.ndarray) -> np.ndarray:
        seconds = clock * self._clock.factor + self._shift
        if self._first is None and len(seconds):
            origin = self._origin
            self._first = float(seconds[0]) if origin is None else origin - self._columns.read_stamp.offset
        return seconds if self._first is None else from_first(seconds, self._first, self._clock)
