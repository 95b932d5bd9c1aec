"""The withheld check of gap diagnosis: hidden rigs with other equations and another integrator than the library's.

`challenge(cases, seed, out, diagnose)` makes recordings, seals their causes, has them diagnosed, opens and scores.
Nothing here imports the library's effects, network or engines.
"""

from fdi_torch.gap.challenge.kinds import KINDS, STANDARD
from fdi_torch.gap.challenge.plants import RIGS, Rig
from fdi_torch.gap.challenge.run import challenge
from fdi_torch.gap.challenge.score import judge, summary

__all__ = ["KINDS", "RIGS", "STANDARD", "Rig", "challenge", "judge", "summary"]
