"""Blind benchmark of the gap diagnosis on simulated rigs with other equations and another integrator than the
library's.

`blind_benchmark(cases, seed, out, diagnose)` simulates recordings, seals their causes, runs the diagnosis, opens the
key and scores the answers; `tables` summarises one benchmark or several `joined` ones. Nothing here imports the
library's effects, network or engines.
"""

from fdi_torch.blind.benchmark import blind_benchmark
from fdi_torch.blind.case_kinds import KINDS, ON_NETWORKS, STANDARD
from fdi_torch.blind.networks import Networks
from fdi_torch.blind.plants import RIGS, Rig
from fdi_torch.blind.scored_rows import Row, Tables, joined, tables

__all__ = [
    "KINDS",
    "ON_NETWORKS",
    "RIGS",
    "STANDARD",
    "Networks",
    "Rig",
    "Row",
    "Tables",
    "blind_benchmark",
    "joined",
    "tables",
]
