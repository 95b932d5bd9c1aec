"""Recordings from MCAP logs: logs of this program by channel name, others by `TOPIC:FIELD` for each channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from fdi_torch.logbook import Signals, mapped_signals, own_signals, read_run
from fdi_torch.names import unknown
from fdi_torch.quantities import si_unit_of, unit_factor
from fdi_torch.recording import Hold, Recording
from fdi_torch.recordings.source import ChannelSource, file_sha256


def read_mcap(
    path: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    mapping: Mapping[str, ChannelSource] | None = None,
    hold: Hold = "zero_order",
) -> Recording:
    """The named channels of a log as a recording in SI; as `read_csv`, with messages in place of rows.

    A log of this program needs no mapping. In any other log, each channel has a column 'TOPIC:FIELD' and a unit; the
    column of `t` is the field with the time (default: the log time). Raises ValueError, naming the file, for missing
    channels, and LogError for a damaged log.
    """
    mapping = mapping or {}
    expect_keys_of_logs(path, mapping)
    run = read_run(path)
    channels = {name: mapping.get(name, ChannelSource()) for name in (*inputs, *outputs)}
    sources = {name: source for name, source in channels.items() if source.constant is None}
    scale = 1.0
    if any(":" in (source.column or "") for source in sources.values()):
        places = {name: _place(path, name, source) for name, source in sources.items()}
        of_inputs, of_outputs = ({n: places[n] for n in names if n in places} for names in (inputs, outputs))
        signals = mapped_signals(run, of_inputs, of_outputs, mapping.get("t", ChannelSource()).column)
        scale, table = _seconds(path, mapping.get("t")), _by_name(signals)
    else:
        signals = own_signals(run)
        logged = _by_name(signals)
        table = {name: _find(path, name, source, logged) for name, source in sources.items()}
        hold = "linear" if signals.hold == "linear" else "zero_order"
    columns = {name: _in_si(path, name, source, table, len(signals.time)) for name, source in channels.items()}

    def stacked(names: Sequence[str], part: int) -> torch.Tensor:
        arrays = [columns[name][part] for name in names]
        return torch.from_numpy(np.stack(arrays, axis=1) if arrays else np.zeros((len(signals.time), 0)))

    return Recording(
        time=torch.from_numpy(signals.time * scale),
        inputs=stacked(inputs, 0),
        outputs=stacked(outputs, 0),
        mask=stacked(outputs, 1).to(torch.bool),
        input_names=tuple(inputs),
        output_names=tuple(outputs),
        input_units=tuple(columns[name][2] for name in inputs),
        output_units=tuple(columns[name][2] for name in outputs),
        hold=hold,
        source=str(path),
        sha256=file_sha256(path),
    )


def expect_keys_of_logs(path: Path, mapping: Mapping[str, ChannelSource]) -> None:
    """Raises ValueError for a key of the mapping that applies to cells of a table only."""
    for name, source in mapping.items():
        for key in ("plus", "quality", "good", "words", "held", "stamps", "zone", "shift", "sort"):
            if getattr(source, key, None):
                raise ValueError(f"{path}: columns.{name}.{key}: expected no such key for an MCAP log; leave it out")


def _seconds(path: Path, time: ChannelSource | None) -> float:
    """The unit of the time field, in s."""
    try:
        return unit_factor(time.unit, "s") if time and time.unit else 1.0
    except ValueError as error:
        raise ValueError(f"{path}: t: {error}") from None


Column = tuple[np.ndarray, np.ndarray, str]
"""Values (T,), whether each is valid (T,), and their unit ('' if the log does not state it)."""


def _in_si(path: Path, name: str, source: ChannelSource, table: Mapping[str, Column], samples: int) -> Column:
    if source.constant is not None:
        values = np.full(samples, source.constant)
        return values, np.isfinite(values), source.unit or "1"
    values, counts, logged_unit = table[name]
    unit = source.unit or logged_unit
    if not unit:
        raise ValueError(f"{path}: {name}: expected a unit, got none; give it under columns: {{{name}: {{unit: cm}}}}")
    si_unit = si_unit_of(unit)
    values = values * unit_factor(unit, si_unit)
    return values, counts & np.isfinite(values), si_unit


def _by_name(signals: Signals) -> dict[str, Column]:
    always = np.ones(len(signals.time), dtype=bool)
    inputs = zip(signals.input_names, signals.inputs.T, signals.input_units, strict=True)
    outputs = zip(signals.output_names, signals.outputs.T, signals.mask.T, signals.output_units, strict=True)
    return {
        **{name: (values, always, unit) for name, values, unit in inputs},
        **{name: (values, mask, unit) for name, values, mask, unit in outputs},
    }


def _find(path: Path, name: str, source: ChannelSource, table: Mapping[str, Column]) -> Column:
    column = source.column or name
    if column not in table:
        raise ValueError(f"{path}: {name}: {unknown('a channel of the log', column, table)}")
    return table[column]


def _place(path: Path, name: str, source: ChannelSource) -> tuple[str, str]:
    topic, _, field = (source.column or "").rpartition(":")
    if not topic or not field:
        raise ValueError(
            f"{path}: {name}: expected a column TOPIC:FIELD as in /rig/levels:left, got '{source.column}'; "
            f"map it under columns: {{{name}: {{column: ..., unit: ...}}}}"
        )
    return topic, field
