"""The blocks of docs/how-to/python.md run one after the other and give what the page says; in short: test_in_python."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

PAGE = (Path(__file__).parent.parent / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_page_runs_as_printed(here: Path) -> None:
    names: dict[str, object] = {"__name__": "page"}
    for code in re.findall(r"```python\n(.*?)```", PAGE, flags=re.S):
        exec(compile(code, "docs/how-to/python.md", "exec"), names)
    assert "single fault: leak at A" in names["found"].headline  # type: ignore[attr-defined]
    assert "leak at A" in names["gap"].headline  # type: ignore[attr-defined]
    assert "leak at B" in names["events"].headline  # type: ignore[attr-defined]
    assert tuple(names["readings"].shape) == (1000, 601, 2)  # type: ignore[attr-defined]
    assert tuple(names["jacobian"].shape) == (10, 601, 2, 2)  # type: ignore[attr-defined]
    slope = names["slope"]
    assert isinstance(slope, torch.Tensor) and float(slope[0, 0]) < 0.0
    flow = names["model"].outflow(names["levels"]).detach() / names["hole"]  # type: ignore[attr-defined]
    assert float((flow - 1.0).abs().max()) < 0.02
