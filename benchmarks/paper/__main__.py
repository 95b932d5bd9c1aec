"""`python -m benchmarks.paper [--out DIR]`: the page about the 2020 paper and its pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.paper.paper_page import make_page


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("docs/paper"), help="default: docs/paper")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    files = make_page(folder, lambda share, text: print(f"{100 * share:3.0f} % {text}", flush=True))
    print(f"page: {files[0]}")


main()
