"""The readers used by viewers accept the logs, by index and as a stream."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_logs import FIXED, write_chunks, write_finished

from fdi_torch.logbook import RunLog, read_run, recover

NODE = Path(__file__).parents[1] / "node"
GOLDEN = Path(__file__).parents[1] / "data"

needs_node = pytest.mark.skipif(
    "CI" not in os.environ and not (shutil.which("node") and (NODE / "node_modules/@mcap/core").is_dir()),
    reason="needs Node and `npm install --prefix tests/node`",
)


def read_with_node(*paths: Path) -> dict[str, Any]:
    done = subprocess.run(
        ["node", str(NODE / "read_log.mjs"), *map(str, paths)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def check(path: Path, report: dict[str, Any]) -> None:
    """Both ways of reading agree with each other and with us."""
    run = read_run(path)
    ours = Counter(message.topic for message in run.messages())
    assert report["indexed"] == report["streamed"]
    assert report["indexed"]["topics"] == ours and report["indexed"]["count"] == sum(ours.values())
    assert report["indexed"]["attachments"] == list(run.attachments)
    assert report["indexed"]["metadata"] == list(run.metadata)


@needs_node
def test_node_reads_every_kind_of_log(tmp_path: Path) -> None:
    full = write_finished(tmp_path / "full.mcap")
    long = tmp_path / "long.mcap"
    with RunLog(long, "simulate", **FIXED) as log:
        samples = 5000
        log.recording(np.arange(samples), np.ones((samples, 2)), np.ones((samples, 1)), "ab", "c", ("1", "1"), ("m",))
    broken = write_chunks(tmp_path / "broken.mcap")
    broken.write_bytes(broken.read_bytes()[:-300])
    paths = [full, long, recover(broken).target, *sorted(GOLDEN.glob("*.mcap"))]
    report = read_with_node(*paths)
    for path in paths:
        check(path, report[str(path)])


@needs_node
def test_node_would_notice_a_wrong_crc(tmp_path: Path) -> None:
    path = write_chunks(tmp_path / "a.mcap")
    chunk = next(part for part in read_run(path).parts if getattr(part, "opcode", 0) == 6)
    data = bytearray(path.read_bytes())
    data[chunk.start + 9 + 24] ^= 1
    path.write_bytes(data)
    with pytest.raises(AssertionError, match="CRC"):
        read_with_node(path)
