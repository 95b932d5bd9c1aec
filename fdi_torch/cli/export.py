"""`fdi export`: what it does and prints. Its options: `options/export.py`.

Path: cli.export.run → jobs.fmu_export.export_fmu → simulate.fmu.write_fmu
"""

from __future__ import annotations

import argparse
from collections import Counter

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.jobs.fmu_export import export_fmu
from fdi_torch.names import counted


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    table = export_fmu(arguments.plant, arguments.fmu, effects=arguments.effect)
    counts = Counter(table.columns["causality"])
    numbers = ", ".join(counted(counts[kind], kind) for kind in ("input", "output", "parameter"))
    screen.say(f"{arguments.fmu}: FMU for co-simulation (FMI 2.0) with {numbers}")
    screen.show(table)
    screen.result({"format": "fdi_torch.export/1", "fmu": str(arguments.fmu), "variables": table.records})
    return DONE
