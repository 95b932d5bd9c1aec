"""CSV files that another program is still writing: their rows, as they become whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from fdi_torch.recordings.csv_files import (
    bind,
    channels_in_si,
    header_of,
    open_csv,
    parse_carefully,
    positions_of,
    time_source,
)
from fdi_torch.recordings.source import ChannelSource


class GrowingCsv:
    """The rows of a CSV file that is still being written, as they become whole. Columns as for `read_csv`.

    input_units, output_units: SI. Raises ValueError where the file, its header or a column is missing.
    """

    def __init__(
        self,
        path: Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        mapping: Mapping[str, ChannelSource] | None = None,
    ) -> None:
        mapping = mapping or {}
        self.path = path
        with open_csv(path) as handle:
            self._header, self._delimiter, self._line = header_of(path, handle)
        self._clock = bind(path, self._header, "t", mapping.get("t") or time_source(self._header), "s")
        self._inputs = [bind(path, self._header, name, mapping.get(name)) for name in inputs]
        self._outputs = [bind(path, self._header, name, mapping.get(name)) for name in outputs]
        self.input_units = tuple(b.si_unit for b in self._inputs)
        self.output_units = tuple(b.si_unit for b in self._outputs)
        with path.open("rb") as raw:
            self._place = sum(len(line) for line in islice(raw, self._line))

    def new(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
        """Times (R,) s, inputs (R, M) and outputs (R, N) in SI of the rows that have become whole since the last call,
        and a sentence on each row that could not be read. Time may jump.
        """
        with self.path.open("rb") as raw:
            raw.seek(self._place)
            data = raw.read()
        whole = data[: data.rfind(b"\n") + 1]
        self._place += len(whole)
        positions = positions_of([self._clock, *self._inputs, *self._outputs])
        rows, troubles = [], []
        for line in whole.decode("utf-8", errors="replace").splitlines():
            try:
                row = parse_carefully(self.path, [line], self._header, self._delimiter, self._line, positions)
                rows += [values for values in row if np.isfinite(values[0])]
            except ValueError as error:
                troubles.append(str(error))
            self._line += 1
        table = np.array(rows).reshape(len(rows), len(positions))
        inputs, outputs = (channels_in_si(table, positions, bounds) for bounds in (self._inputs, self._outputs))
        return table[:, 0] * self._clock.factor, inputs, outputs, troubles
