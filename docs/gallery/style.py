"""The look that the gallery's pictures share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

GREY, BLUE, ORANGE, GREEN, INK = "#9aa5b1", "#0b6cab", "#b84a00", "#0b7558", "#1f2933"


def figure(rows: int, columns: int, title: str, height: float = 3.6, **settings: Any) -> tuple[Any, Any]:
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True})
    plt.rcParams.update({"grid.color": "#d3d9e0", "grid.linewidth": 0.5, "axes.axisbelow": True})
    drawn, axes = plt.subplots(rows, columns, figsize=(11, height), layout="constrained", squeeze=False, **settings)
    drawn.suptitle(title, x=0.01, ha="left", color=INK, fontsize=12)
    return drawn, axes


def save(drawn: Any, script: str) -> None:
    """Write the picture next to its script."""
    path = Path(script).with_suffix(".png")
    drawn.savefig(path, dpi=100, facecolor="white")
    print(f"picture: {path}")
