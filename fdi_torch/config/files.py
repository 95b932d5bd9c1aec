"""YAML files: read, changed by --set, written, and found. The only importer of yaml."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from fdi_torch.config.problems import ConfigError, nearest

SHIPPED = Path(__file__).resolve().parents[1] / "configs"
DEFAULT_RUN = SHIPPED / "default.yaml"


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises ConfigError where there is no file, no YAML or no mapping."""
    if not path.is_file():
        raise ConfigError([f"{path}: expected a YAML file, got none there; check the path"])
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f"line {where.line + 1}: " if where else ""
        raise ConfigError([f"{path}: {line}expected YAML, got {getattr(error, 'problem', None) or error}"]) from error
    if not isinstance(data, dict):
        raise ConfigError([f"{path}: expected keys and values, got {type(data).__name__}"])
    return data


def write_yaml(data: dict[str, Any]) -> str:
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=1000, default_flow_style=None)


def with_overrides(data: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """A copy of the mapping in which each 'a.b.0.c=value' (YAML) is set. Keys are checked with the whole, later."""
    changed = yaml.safe_load(yaml.safe_dump(data))
    for override in overrides:
        path, equals, text = override.partition("=")
        if not equals or not path:
            raise ConfigError([f"--set {override}: expected KEY=VALUE such as estimate.search.population=40"])
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError([f"--set {override}: expected a YAML value after '=', got {text}"]) from error
        _set(changed, path.split("."), value, override)
    return dict(changed)


def _set(node: Any, keys: Sequence[str], value: Any, override: str) -> None:
    for i, key in enumerate(keys):
        place = ".".join(keys[:i]) or "the top level"
        if isinstance(node, list):
            if not key.isdigit() or int(key) >= len(node):
                raise ConfigError([f"--set {override}: {place}: expected an index below {len(node)}, got '{key}'"])
            index: Any = int(key)
        elif isinstance(node, dict):
            index = key
        else:
            raise ConfigError([f"--set {override}: {place}: expected keys and values, got {node!r}"])
        if i == len(keys) - 1:
            node[index] = value
        else:
            if isinstance(node, dict) and node.get(index) is None:
                node[index] = {}
            node = node[index]


def find_file(name: str, base: Path, also: Sequence[Path] = ()) -> Path:
    """A file named in a configuration: as given, or below the configuration's folder, here, or one of `also`."""
    folders = [base, Path.cwd(), *also]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
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
    shipped = SHIPPED / "plants" / f"{name}.yaml"
    return shipped if shipped.is_file() else find_file(name, base, [SHIPPED.parent, SHIPPED])


def _similar(name: str, folders: Sequence[Path]) -> str:
    beside = {path.name for folder in folders for path in (folder / name).parent.glob("*")}
    return nearest(Path(name).name, beside)
