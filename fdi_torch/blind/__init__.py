"""The blind benchmark of gap diagnosis: hidden rigs with other equations and another integrator than the library's.

`blind_benchmark(cases, seed, out, diagnose)` makes recordings, seals their causes, has them diagnosed, opens and
judges; `tables` sums up, of one benchmark or of several `joined`. Nothing here imports the library's effects, network
or engines.
"""

from fdi_torch.blind.kinds import KINDS, ON_NETWORKS, STANDARD
from fdi_torch.blind.networks import Networks
from fdi_torch.blind.plants import RIGS, Rig
from fdi_torch.blind.rows import Row, Tables, joined, tables
from fdi_torch.blind.run import blind_benchmark

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
