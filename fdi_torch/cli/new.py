"""`fdi new`: what it does and prints. Its options: `options/new.py`.

Path: cli.new.run → config.file_templates.template (or config.plant_from_columns.plant_from_recording)
"""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.disk import named_errors

NEXT = {
    "plant": "correct what follows a !, then fdi check --plant {}{recording}",
    "run": "fdi train --config {}",
    "monitor": "fdi monitor --config {}",
    "rehearsal": "fdi rehearse --config {}",
    "study": "fdi study --config {}",
}


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    path = Path(arguments.out or f"{arguments.kind}.yaml")
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(f"--out: expected a file that ends in .yaml, got {path}; rename it")
    if arguments.recording and arguments.kind in ("rehearsal", "study"):
        raise ValueError(f"--recording: expected none for a {arguments.kind}, which simulates its own; leave it out")
    text = _text(arguments, path.stem)
    if path.exists():
        raise ValueError(f"{path}: expected a new file, but it exists; choose another name with --out")
    with named_errors(path), path.open("x", encoding="utf-8") as file:
        file.write(text)
    recording = f" --recording {arguments.recording}" if arguments.recording else ""
    unknown = {"unit: ...": "complete the columns, then ", "tag: null": "complete the tags, then "}
    to_complete = next((words for mark, words in unknown.items() if mark in text), "")
    screen.say(f"{path}; next: {to_complete}{NEXT[arguments.kind].format(path, recording=recording)}")
    screen.result({"format": "fdi_torch.new/1", "file": str(path), "kind": arguments.kind})
    return DONE


def _text(arguments: argparse.Namespace, name: str) -> str:
    """The text of the new file. torch, slow to import, is imported only if a plant or a recording is read."""
    if arguments.kind != "plant":
        from fdi_torch.config.file_templates import template
        from fdi_torch.config.plant_file import chosen_plant

        return template(arguments.kind, chosen_plant(arguments.plant), arguments.plant, name, arguments.recording)
    if arguments.recording:
        from fdi_torch.config.plant_from_columns import plant_from_recording
        from fdi_torch.config.yaml_files import find_data

        return plant_from_recording(find_data(arguments.recording, Path.cwd()), name)
    return files("fdi_torch.config").joinpath("templates", "plant.yaml").read_text(encoding="utf-8")
