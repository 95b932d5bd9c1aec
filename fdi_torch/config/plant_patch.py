"""Edits of a plant file that change only the differing values; comments, order, wildcards and units are kept."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from fnmatch import fnmatchcase
from typing import Any

import yaml

from fdi_torch.amounts import decimals
from fdi_torch.clock import MOMENTS
from fdi_torch.config.plant_file import build_plant
from fdi_torch.config.plant_in_code import absolute_units
from fdi_torch.config.plant_writer import dump_plant, plant_mapping
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.yaml_files import compose_yaml, parse_yaml
from fdi_torch.effects import units_for_display
from fdi_torch.plant.description import FLOW_KINDS, PlacedEffect, PlantDescription
from fdi_torch.quantities import display_unit, displayed_in, si_unit_of
from fdi_torch.units import UnitError, in_unit, number_and_unit, si_factor
from fdi_torch.untrusted_input import printable

DIGITS = 7
"""Significant digits of numbers without a standard error."""
_SAME = 1e-6  # relative tolerance of numbers written with `DIGITS` digits
_PARTS = ("tanks", *(kind.part() for kind in FLOW_KINDS), "sensors")
Path = tuple[str | int, ...]


def patched_plant(
    text: str,
    before: PlantDescription,
    after: PlantDescription,
    errors: Mapping[str, float] | None = None,
    recording: str = "",
) -> tuple[str, bool]:
    """The text of a plant file changed to describe `after`, and whether its format could be kept.

    text: the file from which `before` was read. errors: standard errors by full name, SI. Numbers are written in the
    unit of the text with as many digits as show two digits of the error, those without an error with `DIGITS`. If
    the changes cannot be located in the text (anchors shared by several components), they are made in the plant written
    anew. recording: in which new effects begin, for the comment of their lines.
    """
    for source in (text, dump_plant(before)):
        if _describes(_edited(source, before, after, {}), after):
            return _edited(source, before, after, errors or {}, recording), source == text
    return dump_plant(after), False


def _describes(text: str, plant: PlantDescription) -> bool:
    """Whether the text is a plant file of this plant, up to rounding."""
    try:
        return _equal(build_plant({"name": plant.name, **parse_yaml(text.encode(), "patched")}, "patched"), plant)
    except ConfigError:
        return False


def _edited(
    text: str, before: PlantDescription, after: PlantDescription, errors: Mapping[str, float], recording: str = ""
) -> str:
    edits = _Edits(text)
    with displayed_in(units_for_display(after)):
        for path, value in _changes(before, after):
            edits.set(path, value, _unit_of(path, after), errors.get(_full_name(path, after)))
        known = {(e.effect, e.location) for e in before.effects}
        for placed in after.effects:
            if (placed.effect, placed.location) not in known:
                edits.append(("effects",), _rounded(placed, after, errors), _validity(placed, recording))
    return edits.applied()


def _validity(placed: PlacedEffect, recording: str) -> str:
    """For which recordings an effect that begins at a moment of one recording holds, as a comment; empty for others."""
    moments = [name for name in MOMENTS if placed.parameters.get(name)]
    if not (moments and recording):
        return ""
    (them, it) = " and ".join(moments), "it" if len(moments) == 1 else "them"
    return f"  # {them} within {printable(recording)}: delete {it} for recordings made later"


def _full_name(path: Path, plant: PlantDescription) -> str:
    """The name of the parameter at that path; a tolerance has none."""
    if path[0] == "effects":
        return plant.effects[int(path[1])].full_name(str(path[-1]))
    return "" if path[0] == "tolerances" else f"{path[1]}.{path[2]}"


def _changes(before: PlantDescription, after: PlantDescription) -> Iterator[tuple[Path, str | float]]:
    """Path and new value of every changed constant, effect parameter and tolerance."""
    old, new = plant_mapping(before), plant_mapping(after)
    for part in _PARTS:
        for name, fields in new.get(part, {}).items():
            for field, value in fields.items():
                if old[part][name].get(field) != value:
                    yield (part, name, field), value
    places = {(e.effect, e.location): k for k, e in enumerate(before.effects)}
    for k, placed in enumerate(after.effects):
        place = places.get((placed.effect, placed.location))
        if place is not None:
            for name, value in new["effects"][k]["parameters"].items():
                if old["effects"][place]["parameters"].get(name) != value:
                    yield ("effects", place, "parameters", name), value
    for name, value in new.get("tolerances", {}).items():
        if old.get("tolerances", {}).get(name) != value:
            yield ("tolerances", name), value


def _unit_of(path: Path, plant: PlantDescription) -> str:
    """The unit of a new entry whose SI unit is "1": % for a relative tolerance, otherwise that for display."""
    name = ".".join(map(str, path[-2:])) if path[0] == "sensors" else str(path[-1])
    if path[0] == "tolerances" and name not in absolute_units(plant):
        return "%"
    return display_unit("1", name)[0] or "1"


def _rounded(placed: PlacedEffect, plant: PlantDescription, errors: Mapping[str, float]) -> dict[str, Any]:
    """The mapping of the effect in a plant file."""
    mapping: dict[str, Any] = plant_mapping(plant)["effects"][plant.effects.index(placed)]
    written = {}
    for name, value in mapping["parameters"].items():
        full = placed.full_name(name)
        written[name] = _in_display_unit(value, display_unit("1", full)[0] or "1", errors.get(full))
    return mapping | {"parameters": written}


class _Edits:
    """Edits of a YAML text, at the positions that the parser reports for its values."""

    def __init__(self, text: str) -> None:
        self._text = text if text.endswith("\n") or not text else f"{text}\n"
        self._root = compose_yaml(self._text)
        self._replaced: list[tuple[int, int, str]] = []
        self._added: dict[Path, list[str]] = {}
        self._comments: dict[str, str] = {}  # of added items that have a line of their own

    def set(self, path: Path, value: str | float, unit: str, std: float | None) -> None:
        """Replace the value at a path, or add its key. It is written in the unit of the value that stands there, or of
        the pattern that covers it, otherwise in `unit`. std: its standard error, SI.
        """
        node = self._at(path)
        if isinstance(node, yaml.ScalarNode):
            quote = node.style if node.style in ("'", '"') else ""
            new = f"{quote}{_in_unit_of(value, node.value, std)}{quote}"
            self._replaced.append((node.start_mark.index, node.end_mark.index, new))
        else:
            pattern = self._pattern_of(path)
            new = _in_display_unit(value, unit, std) if pattern is None else _in_unit_of(value, pattern, std)
            self._added.setdefault(path[:-1], []).append(_flow({path[-1]: new})[1:-1])

    def append(self, path: Path, item: Mapping[str, Any], comment: str = "") -> None:
        """Add an item to a list, with the comment if it gets a line of its own."""
        self._added.setdefault(path, []).append(_flow(dict(item)))
        self._comments[_flow(dict(item))] = comment

    def applied(self) -> str:
        """The edited text; edits are applied from the end, so that positions remain valid."""
        edits = [*self._replaced, *(self._inserted(path, items) for path, items in self._added.items())]
        text = self._text
        for start, end, new in sorted(edits, reverse=True):
            text = text[:start] + new + text[end:]
        return text

    def _at(self, path: Path) -> Any:
        """The node at that path, or None."""
        node: Any = self._root
        for step in path:
            if isinstance(node, yaml.SequenceNode) and isinstance(step, int):
                node = node.value[step]
            elif isinstance(node, yaml.MappingNode):
                node = next((value for key, value in node.value if key.value == step), None)
            else:
                return None
        return node

    def _pattern_of(self, path: Path) -> str | None:
        """The value of the last pattern in the mapping that matches the key."""
        node = self._at(path[:-1]) if path[0] == "tolerances" else None
        known = node.value if isinstance(node, yaml.MappingNode) else []
        return next((str(v.value) for k, v in reversed(known) if fnmatchcase(str(path[-1]), k.value)), None)

    def _inserted(self, path: Path, items: list[str]) -> tuple[int, int, str]:
        """The edit (start, end, text) that adds items to the collection at that path."""
        node = self._at(path)
        is_list = path == ("effects",)
        if node is None or isinstance(node, yaml.ScalarNode):  # the collection is not in the file yet
            whole = f"[{', '.join(items)}]" if is_list else f"{{{', '.join(items)}}}"
            if len(path) == 1 and not self._root.flow_style:
                lines = "".join(f"  {self._line(item, is_list)}\n" for item in items)
                return len(self._text), len(self._text), f"\n{path[0]}:\n{lines}"
            return self._inserted(path[:-1], [f"{path[-1]}: {whole}"])
        if node.flow_style:
            end = node.end_mark.index - 1
            return end, end, (", " if node.value else "") + ", ".join(items)
        first = node.value[0] if is_list else node.value[0][0]
        column = node.start_mark.column if is_list else first.start_mark.column
        end = self._text.index("\n", _end(node))
        return end, end, "".join(f"\n{' ' * column}{self._line(item, is_list)}" for item in items)

    def _line(self, item: str, is_list: bool) -> str:
        return f"{'- ' if is_list else ''}{item}{self._comments.get(item, '')}"


def _end(node: Any) -> int:
    """End of a block's content; the mark of the block itself is after following comments and empty lines."""
    while isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        node = last[1] if isinstance(node, yaml.MappingNode) else last
    return int(node.end_mark.index)


def _flow(value: Any) -> str:
    """YAML on one line."""
    return str(yaml.safe_dump(value, default_flow_style=True, sort_keys=False, allow_unicode=True, width=10**6)).strip()


def _in_display_unit(value: str | float, unit: str, std: float | None) -> Any:
    """A quantity in the unit for display if it has one, else in `unit`."""
    si_unit = si_unit_of(number_and_unit(str(value))[1])
    return _in_unit_of(value, f"1 {unit if si_unit == '1' else display_unit(si_unit)[0] or si_unit}", std)


def _in_unit_of(value: str | float, written: str | None, std: float | None) -> Any:
    """A quantity in the unit of `written`; a bare number stays one. std: standard error, SI."""
    number, unit = number_and_unit(str(value))
    if written is not None:
        try:
            _, written_unit = number_and_unit(written)
            number, unit = in_unit(number, unit, written_unit), written_unit
        except UnitError:
            pass  # `written` is a word such as equilibrium
    short = f"{number:.{DIGITS}g}"
    if std:
        short = f"{round(number, decimals(min(std / si_factor(unit), abs(number) or 1.0))):.{DIGITS}g}"
    return float(short) if unit == "1" else f"{short} {unit}"


def _equal(one: PlantDescription, other: PlantDescription) -> bool:
    """Whether two plants are equal up to rounding, with effects in any order."""
    return _nearly_equal(_plain(one), _plain(other))


def _plain(plant: PlantDescription) -> dict[str, Any]:
    plain = asdict(plant)
    return plain | {"units": {}, "effects": sorted(plain["effects"], key=lambda e: (e["effect"], e["location"]))}


def _nearly_equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_nearly_equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_nearly_equal, one, other))
    if isinstance(one, float | int) and isinstance(other, float | int):
        return math.isclose(one, other, rel_tol=_SAME, abs_tol=1e-15)
    return bool(one == other)
