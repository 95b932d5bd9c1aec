"""YAML files: reading, overriding by --set, writing and finding, and their kinds, recognized by their keys. This is the
only file that imports yaml.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml

from fdi_torch.config.problems import ConfigError, shown
from fdi_torch.names import nearest, shortened, unknown
from fdi_torch.untrusted_input import MOST_DIGITS, MOST_YAML_BYTES, MOST_YAML_VALUES

MOST_EXTENSIONS = 8
YAML_ENDINGS = (".yaml", ".yml")
SHIPPED = Path(__file__).resolve().parents[1] / "configs"
DEFAULT_RUN = SHIPPED / "default.yaml"


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises ConfigError if there is no such file, no YAML or no mapping."""
    if not path.is_file():
        raise ConfigError([f"{path}: file not found; check the path"])
    with path.open("rb") as file:
        return parse_yaml(file.read(MOST_YAML_BYTES + 1), str(path))


def parse_yaml(text: bytes, source: str) -> dict[str, Any]:
    """The mapping in YAML text with plain values. Raises ConfigError, naming `source`, if it is none or too large."""
    if len(text) > MOST_YAML_BYTES:
        raise ConfigError([f"{source}: expected at most {MOST_YAML_BYTES} bytes of YAML, got more; split the file"])
    data = _values(text, source)
    if not isinstance(data, dict):
        got = "nothing" if data is None else "a list" if isinstance(data, list) else "a single value"
        raise ConfigError([f"{source}: expected keys and values such as plant: three_tank, got {got}"])
    return data


def _values(text: bytes, source: str) -> Any:
    try:
        return yaml.load(text.decode("utf-8"), _Loader)
    except RecursionError:
        raise ConfigError([f"{source}: expected YAML of a few levels, got hundreds of nested ones"]) from None
    except UnicodeDecodeError:
        raise ConfigError(
            [f"{source}: expected a YAML file (text in UTF-8), got other bytes; name another file"]
        ) from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # the last two for impossible numbers and dates
        where = getattr(error, "problem_mark", None)
        line = f"line {where.line + 1}: " if where else ""
        problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
        if "'\\t'" in problem:
            problem = "a line is indented by a tab; indent by spaces"
        if getattr(error, "context", None) == "while scanning an alias" or "undefined alias" in problem:
            problem = 'text that begins with * needs quotes, as in "*.area": 3 %'
        sentence = problem if isinstance(error, _RejectedError) else f"not valid YAML: {problem}"
        raise ConfigError([f"{source}: {line}{sentence}"]) from None


def compose_yaml(text: str) -> yaml.Node:
    """The nodes of a YAML text that has been read before, with their positions."""
    loader = _Loader(text)
    try:
        return loader.get_single_node()
    finally:
        loader.dispose()


def read_extended(path: Path, depth: int = 0) -> dict[str, Any]:
    """A YAML file merged key by key over the file that its key `extends` names (a path relative to it)."""
    data = read_yaml(path)
    if "extends" not in data:
        return data
    if depth >= MOST_EXTENSIONS:
        raise ConfigError([f"{path}: extends: expected at most {MOST_EXTENSIONS} files in a row, got more; a circle?"])
    base_file = path.parent / str(data.pop("extends"))
    return _merged(read_extended(base_file, depth + 1), data)


def _merged(base: Any, override: Any) -> Any:
    if not (isinstance(base, dict) and isinstance(override, dict)):
        return override
    return base | {key: _merged(base.get(key), value) for key, value in override.items()}


class _Loader(yaml.SafeLoader):
    """Loads plain values only, at most `MOST_YAML_VALUES` with all aliases expanded, and refuses repeated keys.

    Values are counted during reading, because nested aliases make a few bytes huge. Of a repeated key, YAML would
    silently drop the first.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._spelled_out = 0
        self._sizes: dict[int, int] = {}  # of every node, by its identity

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            raise _rejected(f"expected plain values, got the tag {shortened(event.tag)}; remove it", event)
        count_before = self._spelled_out
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            if id(node) not in self._sizes:
                raise _rejected(f"expected plain values, got *{event.anchor} within itself; remove it", event)
            self._spelled_out += self._sizes[id(node)]
        else:
            self._spelled_out += 1
            self._sizes[id(node)] = self._spelled_out - count_before
        if self._spelled_out > MOST_YAML_VALUES:
            raise _rejected(f"expected at most {MOST_YAML_VALUES} values, aliases spelled out, got more", event)
        return node

    def construct_scalar(self, node: Any) -> Any:
        if node.tag in _NUMBERS and len(node.value) > MOST_DIGITS:
            raise _rejected(f"expected a number of at most {MOST_DIGITS} digits, got {len(node.value)}", node)
        return super().construct_scalar(node)

    def construct_yaml_int(self, node: Any) -> int:
        value: int = super().construct_yaml_int(node)
        if not abs(value) < 2**63:
            raise _rejected(f"expected a whole number below 2^63, got {shortened(node.value)}", node)
        return value

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in keys:
                    sentence = f"expected each key once, got {shortened(key.value)} twice; rename or remove one"
                    raise _rejected(sentence, key)
                keys.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")


class _RejectedError(yaml.constructor.ConstructorError):
    """Valid YAML that a configuration may not contain."""


def _rejected(sentence: str, where: Any) -> _RejectedError:
    return _RejectedError(None, None, sentence, where.start_mark)


def write_yaml(data: dict[str, Any]) -> str:
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=1000, default_flow_style=None)


def with_overrides(data: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """A copy of the mapping with each 'a.b.0.c=value' (YAML) set. Keys are checked later with the whole mapping."""
    changed = deepcopy(data)
    for override in overrides:
        path, equals, text = override.partition("=")
        if not equals or not path:
            raise ConfigError([f"--set {override}: expected KEY=VALUE such as estimate.search.population=40"])
        value = _values(text.encode("utf-8", "surrogateescape"), f"--set {override}")
        _set(changed, path.split("."), value, override)
    return changed


def _set(node: Any, keys: Sequence[str], value: Any, override: str) -> None:
    """Set the value at the end of a path of keys and indices; missing mappings are created."""
    for i, key in enumerate(keys):
        index: Any = key
        place = ".".join(keys[:i])
        if not isinstance(node, dict | list):
            raise ConfigError(
                [f"--set {override}: {place}: expected keys or a list there, got {shown(node)}; set it whole"]
            )
        if isinstance(node, list):
            if not (key.isdecimal() and key.isascii() and len(key) < 10 and int(key) < len(node)):
                raise ConfigError([f"--set {override}: {place}: expected an index below {len(node)}, got '{key}'"])
            index = int(key)
        if i == len(keys) - 1:
            node[index] = value
            return
        if isinstance(node, dict) and not isinstance(node.get(index), dict | list):
            node[index] = {}
        node = node[index]


def find_file(name: str, base: Path, also: Sequence[Path] = ()) -> Path:
    """A file named in a configuration: as given, relative to its folder, the current folder, or `also`."""
    folders = [base, Path.cwd(), *also]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    for folder in folders:
        if (folder / name).is_dir():
            raise ConfigError([f"{folder / name}: expected a file, got a folder; name a file in it"])
    looked = ", ".join(dict.fromkeys(str(folder) for folder in folders))
    beside = {path.name for folder in folders for path in (folder / name).parent.glob("*")}
    raise ConfigError([f"{name}: file not found (looked in {looked}){nearest(Path(name).name, beside)}"])


def find_data(name: str, base: Path) -> Path:
    """The path of a recording, searched as by `find_file` and in the folder that the environment variable
    FDI_TORCH_DATA names. Raises ConfigError if there is none, and for a YAML file.
    """
    if Path(name).suffix in YAML_ENDINGS:
        raise ConfigError([f"{name}: expected a recording, got a YAML file; take the entries of its list recordings"])
    data = os.environ.get("FDI_TORCH_DATA")
    try:
        return find_file(name, base, [Path(data)] if data else [])
    except ConfigError as error:
        hint = "" if data else "; to look in a further folder, set FDI_TORCH_DATA to it"
        raise ConfigError([error.problems[0] + hint]) from None


def shipped_plants() -> dict[str, Path]:
    """The plant files in the package, by name."""
    return {path.stem: path for path in sorted((SHIPPED / "plants").glob("*.yaml"))}


def find_plant(name: str, base: Path) -> Path:
    """A plant file, or a shipped plant by its name ('three_tank')."""
    plants = shipped_plants()
    if name in plants:
        return plants[name]
    if Path(name).suffix in YAML_ENDINGS:
        return find_file(name, base)
    raise ConfigError([unknown("a plant file (.yaml) or a shipped plant", name, plants)], "plant")


_OWN_KEYS = {
    "plant": ("tanks",),
    "study": ("study",),
    "monitor": ("fault_free", "recording", "source"),
    "rehearsal": ("reading_noise", "false_alarms", "faults_found", "naming"),
    "run": ("recordings", "simulate", "estimate"),
}
_READ_BY = {
    "study": "fdi study reads it; without its block study it is a run file",
    "monitor": "fdi monitor reads it",
    "rehearsal": "fdi rehearse reads it",
    "run": "fdi train and fdi simulate read it",
}


def expect_kind(data: Mapping[str, Any], kind: str, file: Path, expected: str = "") -> None:
    """Raises ConfigError if the keys of a file are those of another kind: plant, run, study, monitor or rehearsal.

    expected: what could be there, in words; by default a file of that kind. A run file may become a study by --set.
    """
    kinds = [each for each, keys in _OWN_KEYS.items() if any(key in data for key in keys)]
    base = "run" if kind == "study" else kind
    if not kinds or kinds[0] == kind or (base in kinds and (kind == "study" or "study" not in kinds)):
        return
    given = kinds[0]
    if given == "plant":
        advice = f"name it under the key plant of such a file: fdi new {kind} --plant {file.name} writes one"
    else:
        advice = _READ_BY[given]
    raise ConfigError([f"{file}: expected {expected or f'a {kind} file'}, got a {given} file; {advice}"])
