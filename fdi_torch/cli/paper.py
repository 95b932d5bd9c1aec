"""`fdi paper`: what it does and prints. Its options: `options/paper.py`."""

from __future__ import annotations

import argparse
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.paper.paper_page import make_page


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    folder = Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    with screen.progress("paper") as advance:
        files = make_page(folder, advance)
        advance(1.0, "done")
    screen.say(f"page: {files[0]}")
    screen.result({"format": "fdi_torch.paper/1", "page": str(files[0]), "pictures": [str(f) for f in files[1:]]})
    return DONE
