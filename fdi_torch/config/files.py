"""YAML files: read, changed by --set, written, and found. The only importer of yaml."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml

from fdi_torch.config.problems import ConfigError
from fdi_torch.names import nearest, unknown

MOST_EXTENSIONS = 8
SHIPPED = Path(__file__).resolve().parents[1] / "configs"
DEFAULT_RUN = SHIPPED / "default.yaml"


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises ConfigError where there is no file, no YAML or no mapping."""
    if not path.is_file():
        raise ConfigError([f"{path}: expected a YAML file, got none there; check the path"])
    return parse_yaml(path.read_bytes(), str(path))


def parse_yaml(text: bytes, source: str) -> dict[str, Any]:
    """The mapping in YAML text of plain values. Raises ConfigError, naming `source`, where it is none."""
    try:
        data = yaml.load(text.decode("utf-8"), _Loader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        where = getattr(error, "problem_mark", None)
        line = f"line {where.line + 1}: " if where else ""
        problem = getattr(error, "problem", None) or str(error)
        told = problem if problem.startswith("expected each key") else f"expected YAML, got something else: {problem}"
        raise ConfigError([f"{source}: {line}{told}"]) from error
    if not isinstance(data, dict):
        got = "nothing" if data is None else type(data).__name__
        raise ConfigError([f"{source}: expected keys and values such as plant: three_tank, got {got}"])
    return data


def read_extended(path: Path, depth: int = 0) -> dict[str, Any]:
    """A YAML file laid over the one that its key `extends` names (a path beside it), mappings merged key by key."""
    data = read_yaml(path)
    if "extends" not in data:
        return data
    if depth >= MOST_EXTENSIONS:
        raise ConfigError([f"{path}: extends: expected at most {MOST_EXTENSIONS} files in a row, got more; a circle?"])
    below = path.parent / str(data.pop("extends"))
    return _merged(read_extended(below, depth + 1), data)


def _merged(below: Any, above: Any) -> Any:
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    return below | {key: _merged(below.get(key), value) for key, value in above.items()}


class _Loader(yaml.SafeLoader):
    """Plain values only. A key that stands twice is refused: the first would be lost without a word."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    told = f"expected each key once, got {key.value} twice; rename or remove one"
                    raise yaml.constructor.ConstructorError(None, None, told, key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def write_yaml(data: dict[str, Any]) -> str:
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=1000, default_flow_style=None)


def with_overrides(data: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """A copy of the mapping in which each 'a.b.0.c=value' (YAML) is set. Keys are checked with the whole, later."""
    changed = deepcopy(data)
    for override in overrides:
        path, equals, text = override.partition("=")
        if not equals or not path:
            raise ConfigError([f"--set {override}: expected KEY=VALUE such as estimate.search.population=40"])
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError([f"--set {override}: expected a YAML value after '=', got {text}"]) from error
        _set(changed, path.split("."), value, override)
    return changed


def _set(node: Any, keys: Sequence[str], value: Any, override: str) -> None:
    """Sets the value at the end of a path of keys and indices, making mappings where there are none yet."""
    for i, key in enumerate(keys):
        index: Any = key
        if isinstance(node, list):
            if not key.isdigit() or int(key) >= len(node):
                place = ".".join(keys[:i])
                raise ConfigError([f"--set {override}: {place}: expected an index below {len(node)}, got '{key}'"])
            index = int(key)
        if i == len(keys) - 1:
            node[index] = value
            return
        if isinstance(node, dict) and not isinstance(node.get(index), dict | list):
            node[index] = {}
        node = node[index]


def find_file(name: str, base: Path, also: Sequence[Path] = ()) -> Path:
    """A file named in a configuration: as given, or below the configuration's folder, here, or one of `also`."""
    folders = [base, Path.cwd(), *also]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    for folder in folders:
        if (folder / name).is_dir():
            raise ConfigError([f"{folder / name}: expected a file, got a folder; name a file in it"])
    looked = ", ".join(dict.fromkeys(str(folder) for folder in folders))
    raise ConfigError([f"{name}: expected a file, got none there (looked in {looked}){_similar(name, folders)}"])


def find_data(name: str, base: Path) -> Path:
    """A recording: also below the folder that the environment variable FDI_TORCH_DATA names."""
    data = os.environ.get("FDI_TORCH_DATA")
    try:
        return find_file(name, base, [Path(data)] if data else [])
    except ConfigError as error:
        hint = "" if data else "; set FDI_TORCH_DATA to the folder that holds the recordings"
        raise ConfigError([error.problems[0] + hint]) from None


def find_plant(name: str, base: Path) -> Path:
    """A plant file, or a plant that is shipped, by its name ('three_tank')."""
    plants = {path.stem: path for path in sorted((SHIPPED / "plants").glob("*.yaml"))}
    if name in plants:
        return plants[name]
    if Path(name).suffix in (".yaml", ".yml"):
        return find_file(name, base)
    raise ConfigError([f"plant: {unknown('a plant file (.yaml) or a shipped plant', name, plants)}"])


def _similar(name: str, folders: Sequence[Path]) -> str:
    beside = {path.name for folder in folders for path in (folder / name).parent.glob("*")}
    return nearest(Path(name).name, beside)
