"""--adopt: write a plant file with the adopted effects and constants, and show what changed."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import unified_diff
from pathlib import Path

from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant_patch import patched_plant
from fdi_torch.config.yaml_files import find_plant
from fdi_torch.disk import expect_writable, write_text
from fdi_torch.plant.description import PlantDescription


def expect_adoptable(target: str | None, replace: bool) -> None:
    """Raises ValueError if the file of --adopt exists and --replace is not given, before long work for it."""
    if target is None:
        return
    if Path(target).is_file() and not replace:
        raise ValueError(
            f"{target}: expected a new file for --adopt, but it exists; choose another name, or add --replace"
        )
    expect_writable(Path(target))


def write_adopted(
    name: str,
    before: PlantDescription,
    after: PlantDescription,
    target: Path,
    screen: Screen,
    errors: Mapping[str, float] | None = None,
    recording: str = "",
) -> list[str]:
    """Write the plant file `name` (a file or a shipped plant, read as `before`) changed to `after`. Returns the diff,
    line by line. errors: standard errors of fitted values, which determine their digits. recording: as of
    `patched_plant`.
    """
    text = find_plant(name, Path.cwd()).read_text(encoding="utf-8")
    changed, kept = patched_plant(text, before, after, errors, recording)
    write_text(target, changed)
    if not kept:
        screen.note(f"{target}: rewritten without the comments of {name}, because components share values in it")
    return [*unified_diff(text.splitlines(), changed.splitlines(), name, str(target), lineterm="", n=1)]
