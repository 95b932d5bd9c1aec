"""The withheld check of gap diagnosis: hidden rigs with other equations and another integrator than the library's.

`challenge(cases, seed, out, diagnose)` makes recordings, seals their causes, has them diagnosed, opens and judges;
`tables` sums up, of one challenge or of several `joined`. Nothing here imports the library's effects, network or
engines.
"""

from fdi_torch.gap.challenge.kinds import KINDS, STANDARD
from fdi_torch.gap.challenge.plants import RIGS, Rig
from fdi_torch.gap.challenge.rows import Row, Tables, joined, tables
from fdi_torch.gap.challenge.run import challenge

__all__ = ["KINDS", "RIGS", "STANDARD", "Rig", "Row", "Tables", "challenge", "joined", "tables"]
