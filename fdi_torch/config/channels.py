"""The mapping of the plant's channels to columns of a file or to constants."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

from fdi_torch.config.recording_config import ColumnConfig, FileConfig
from fdi_torch.config.strict import Amount, quantity_at
from fdi_torch.config.yaml_files import find_data
from fdi_torch.names import distinguishing_end, shortened, unknown
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import quantity_text, si_unit_of
from fdi_torch.recordings.csv_files import clock_of, first_row, read_header
from fdi_torch.recordings.csv_tags import tag_columns
from fdi_torch.recordings.csv_text import HeaderlessError, header_unit, names_in
from fdi_torch.recordings.source import ChannelSource, ClockSource

KINDS = {
    "m": "a unit of level such as cm",
    "Pa": "a unit of pressure such as mbar",
    "V": "a unit of voltage such as V",
    "A": "a unit of current such as mA",
    "1/s": "a unit of frequency such as Hz",
    "m^3/s": "a unit of flow such as l/min",
    "1": "a share or %",
}
"""SI unit of a channel -> its units in words."""
TO_REPLACE = "..."
"""What stands in a new file for a column or a unit that the user must write."""
ONLY_CLOCK = ("stamps", "zone", "shift", "sort", "period")
ONLY_FOR = dict.fromkeys(ONLY_CLOCK, "t") | {"held": "an input"}
ONLY_FOR |= dict.fromkeys(("constant", "recorded", "words", "quality", "good", "plus"), "a channel")
"""Keys that not every column may have, and of which it is expected."""


def channel_mapping(config: FileConfig, plant: PlantDescription) -> dict[str, ChannelSource]:
    """The source of each channel mentioned; time is `t`. Raises ValueError for unknown channels and keys."""
    units = _units(plant)
    if unfinished := [name for name, column in config.columns.items() if TO_REPLACE in (column.column, column.unit)]:
        raise ValueError(
            f"{config.file}: columns: expected a column and a unit for each channel, got {TO_REPLACE} for "
            f"{', '.join(unfinished)}; replace each {TO_REPLACE}"
        )
    mapping: dict[str, ChannelSource] = {}
    for name, column in config.columns.items():
        place = f"{config.file}: columns.{name}"
        if name != "t" and name not in units:
            raise ValueError(f"{place}: {unknown('a channel of the plant or t', name, [*units, 't'])}")
        _expect_keys_that_fit(place, name, column, plant)
        if column.period is not None:
            _expect_rows_in_time(place, column, config)
        if name == "t":
            clock = {key: getattr(column, key) for key in ONLY_CLOCK}
            mapping[name] = ClockSource(column.column, column.unit, **clock)
        else:
            mapping[name] = _channel_source(place, column, units[name])
    return mapping


def _expect_keys_that_fit(place: str, name: str, column: ColumnConfig, plant: PlantDescription) -> None:
    """Raises ValueError for a key that does not apply to that channel."""
    kinds = ("t",) if name == "t" else ("a channel", "an input") if name in plant.channels() else ("a channel",)
    for key, kind in ONLY_FOR.items():
        if key in column.model_fields_set and kind not in kinds:
            raise ValueError(f"{place}.{key}: expected this key of {kind} only; leave it out")


def _expect_rows_in_time(place: str, column: ColumnConfig, config: FileConfig) -> None:
    """Raises ValueError if a file with a period has a column of time as well, or no row per instant."""
    if beside := sorted(column.model_fields_set - {"period", "shift"}):
        raise ValueError(f"{place}: expected a period or a column, got period and {', '.join(beside)}; drop one")
    if config.tags or is_log(Path(config.file)):
        raise ValueError(f"{place}.period: expected this key of a table with one row per instant only; leave it out")


def _channel_source(place: str, column: ColumnConfig, unit: str) -> ChannelSource:
    constant = None if column.constant is None else quantity_at(f"{place}.constant", column.constant, unit)
    if not column.recorded:
        constant = float("nan")
    if constant is not None:
        return ChannelSource(column.column, unit, constant)
    words = {text: _meaning(f"{place}.words.{text}", value, column.unit) for text, value in column.words.items()}
    good = tuple(str(word) for word in column.good)
    return ChannelSource(column.column, column.unit, None, column.held, words, column.quality, good, tuple(column.plus))


def _meaning(place: str, value: Amount | None, unit: str | None) -> float:
    """The number for a word, in the unit of its column; NaN for a bad reading."""
    if isinstance(value, str):
        raise ValueError(f"{place}: expected a number in the unit of the column ({unit or 'see its header'}) or null")
    return float("nan") if value is None else float(value)


def _units(plant: PlantDescription) -> dict[str, str]:
    return plant.channel_units() | plant.output_units()


def expect_units(source: str, names: Sequence[str], units: Sequence[str], plant: PlantDescription) -> None:
    """Raises ValueError if a channel's SI unit differs from the plant's."""
    expected = _units(plant)
    gains = {s.column: f"a level in %: gain: {100.0 / plant.tank(s.tank).height:.4g} %/m" for s in plant.sensors}
    gains |= {p.channel: f"a command in %: gain: {quantity_text(p.max_flow, 'm^3/s')}" for p in plant.metered_flows()}
    for name, unit in zip(names, units, strict=True):
        if unit != expected[name]:
            share = f" ({gains[name]})" if unit == "1" and name in gains else ""
            got = KINDS.get(unit, unit).partition(" such")[0]
            raise ValueError(
                f"{source}: {name}: expected {KINDS[expected[name]]} ({plant.title}), got {got}; correct the header, "
                f"columns, or the gain in the plant file{share}"
            )


def unrecorded_valves(
    path: Path, plant: PlantDescription, config: FileConfig | None = None
) -> dict[str, ChannelSource]:
    """The valves without a column, with their opening from the plant file."""
    openings = {p.valve: p.unrecorded for p in plant.pipes if p.valve and p.unrecorded is not None}
    return {name: ChannelSource(None, "1", openings[name]) for name in without_column(path, openings, config)}


def expect_columns(
    name: str, base: Path, plant: PlantDescription, also_known: Collection[str] = (), other_fix: str = ""
) -> None:
    """Raises ValueError with all channels that have no column in a table, and the YAML file that maps them.

    name: the table's file, as the user wrote it, relative to the folder `base`. also_known: channels that need no
    column. other_fix: a further way to supply inputs, with {inputs}.
    """
    path = find_data(name, base)
    missing = _missing(path, plant, also_known)
    if not missing:
        return
    inputs = [name for name in missing if name in plant.channels()]
    others = [column for column in _header(path)[1:] if names_in((column,)).isdisjoint(_units(plant))]  # first: time
    if set(missing) == set(plant.outputs()) and not others:
        raise ValueError(
            f"{path}: expected readings of {', '.join(missing)}, got inputs alone; fdi plan and fdi "
            "diagnosability show what planned inputs can reveal"
        )
    header = ", ".join(map(shortened, _header(path)))
    lines = "\n".join(f"    {line}" for line in mapped(path, plant, also_known))
    raise ValueError(
        f"{path}: expected a column for {', '.join(missing)}, got {header or 'numbers without a header'}; "
        f"{other_fix.format(inputs=inputs[0]) if other_fix and inputs else ''}"
        f"{'if columns have other names or no unit, ' if header else ''}save these lines as runs.yaml, completed and "
        f"checked, and name runs.yaml instead:\nrecordings:\n  - file: {_as_yaml(name)}\n{lines}"
    )


def _as_yaml(text: str) -> str:
    """A text as YAML on one line, quoted if it needs that."""
    return text if re.fullmatch(r"[\w./][\w./ -]*", text) else "'" + text.replace("'", "''") + "'"


def mapped(path: Path, plant: PlantDescription, also_known: Collection[str] = ()) -> list[str]:
    """Lines for a recording file, to be completed, that map the channels without a column of their name with a unit.

    Each is mapped to the column of its name, without a known unit, else by `_of_like_names` to one with a unit of its
    kind; for other channels the columns of their kind are listed in a comment. A file whose rows have more cells than
    its first line has no header: its columns are numbered. A file with a row per value is mapped by its tags. Empty if
    no channel lacks a column.
    """
    kinds, missing = _units(plant), _missing(path, plant, also_known)
    if not missing:
        return []
    header, width = _header(path), len(read_header(path, header=False))
    if width > len(header):
        row = shortened(" | ".join(first_row(path)))
        lines = [
            "header: false",
            f"columns:    # by number, 1 to {width}; first row: {row}",
            f"  t: {_clock(path)}",
        ]
        return [*lines, *(f"  {name}: {{column: ..., unit: ...}}" for name in missing)]
    if tags := tag_columns(header):
        quality = f", quality: {tags.quality}" if tags.quality else ""
        lines = [f"tags: {{tag: {tags.tag}, value: {tags.value}{quality}}}    # one row per value", "columns:"]
        return [*lines, *(f"  {name}: {{column: TAG, unit: ...}}" for name in missing)]
    legible = [column for column in header if column == shortened(column)]
    of_kind = {
        column: si_unit_of(pair[1]) for column in legible if (pair := header_unit(column)) and pair[0] not in kinds
    }
    without_unit = [column for column in legible if header_unit(column) is None]
    of_name = {
        name: next((c for c in without_unit if re.match(rf"{re.escape(name)}(?![^\W_])", c)), None) for name in missing
    }
    of_like_name: dict[str, str] = {}
    for kind in dict.fromkeys(kinds.values()):
        names = [name for name in missing if kinds[name] == kind and of_name[name] is None]
        of_like_name |= _of_like_names(names, [column for column, its_kind in of_kind.items() if its_kind == kind])
    lines = ["columns:    # units only where the header has none"]
    for name in missing:
        if column := of_like_name.get(name):
            lines.append(f'  {name}: {{column: "{column}"}}')
        elif of_name[name] is not None:
            lines.append(f'  {name}: {{column: "{of_name[name]}", unit: ...}}')
        else:
            unmapped = [c for c, kind in of_kind.items() if kind == kinds[name] and c not in of_like_name.values()]
            quoted = ", ".join(f'"{c}"' for c in unmapped)
            choice = f"}}    # one of: {quoted}" if unmapped else ", unit: ...}"
            lines.append(f"  {name}: {{column: {TO_REPLACE}{choice}")
    return lines


def _of_like_names(names: Sequence[str], columns: Sequence[str]) -> dict[str, str]:
    """The columns that clearly belong to channels of their kind of unit: of an equal name, or the only one with the
    same number or letter at its end. A last pair belongs together unless their numbers or letters differ.
    """
    words = {column: (header_unit(column) or (column,))[0] for column in columns}
    found: dict[str, str] = {}
    for key in (str.casefold, distinguishing_end):
        open_names = [name for name in names if name not in found]
        open_columns = [column for column in columns if column not in found.values()]
        for name in open_names:
            same = [column for column in open_columns if key(words[column]) == key(name) != ""]
            if len(same) == 1 and [key(other) for other in open_names].count(key(name)) == 1:
                found[name] = same[0]
    open_names = [name for name in names if name not in found]
    open_columns = [column for column in columns if column not in found.values()]
    if len(open_names) == len(open_columns) == 1:
        ends = distinguishing_end(open_names[0]), distinguishing_end(words[open_columns[0]])
        if not all(ends) or ends[0].isdigit() != ends[1].isdigit():
            found[open_names[0]] = open_columns[0]
    return found


def _clock(path: Path) -> str:
    """The entry of time for a table without a header."""
    clock = clock_of(path)
    if clock is None:
        return "{period: ...}    # no column increases as a clock does; the time between rows, such as 1 s"
    column, stamps = clock
    return f"{{column: {column}}}" if stamps else f"{{column: {column}, unit: ...}}    # it increases as a clock does"


def _missing(path: Path, plant: PlantDescription, also_known: Collection[str]) -> list[str]:
    """The channels that need a column with a unit and have none in the table."""
    if is_log(path):
        return []
    complete = names_in([column for column in _header(path) if header_unit(column)])
    known = {*unrecorded_valves(path, plant), *also_known, *complete}
    return [name for name in _units(plant) if name not in known]


def _header(path: Path) -> tuple[str, ...]:
    """The names of a table's columns; none if the table has no header."""
    try:
        return read_header(path)
    except HeaderlessError:
        return ()


def without_column(path: Path, names: Collection[str], config: FileConfig | None = None) -> list[str]:
    """The names that no header of a CSV file contains; none for an MCAP log."""
    if not names or is_log(path):
        return []
    header = _header(path) if config is None else read_header(path, config.header, config.sheet)
    present = names_in(header)
    return [name for name in names if name not in present]


def is_log(path: Path) -> bool:
    return ".mcap" in path.suffixes
