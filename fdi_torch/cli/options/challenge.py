"""Blind benchmark of the gap diagnosis on hidden rigs with other equations and another integrator.

The benchmark simulates recordings and seals their causes (each recording contains the hash of the key). It diagnoses
every recording without the key, then opens the key and scores the answers by kind of case, with 95 % intervals, beside
two answers without skill. Everything is written to --out; repeating the command resumes an interrupted benchmark.
"""

import math

from fdi_torch.blind.kinds import KINDS
from fdi_torch.cli.options import names, shared

RIGS = ("cascaded_tanks", "quadruple_tank", "three_tank")

STEP, SUMMARY = "validate", "blind benchmark of the gap diagnosis on hidden rigs"
LONG = True
_KINDS = "".join(f"  {kind.name:<10}{kind.meaning}\n" for kind in KINDS.values())
EXAMPLES = f"""
kinds of cases (on random networks also null, dnull and dsingle):
{_KINDS}
--out contains rows.jsonl (one line per answer), scores.json, scores.md and challenge.mcap (for `fdi report`).
The workers of a --cluster need access to that folder.

examples:
  fdi challenge                                            22 cases, two of each kind, four minutes on one core
  fdi challenge --cases 450 --seed 7 --out logs/seven      fifty of each kind; the same command resumes after Ctrl-C
  fdi challenge --cases 450 --seed 7 --out logs/seven --minutes 30      score what is diagnosed within half an hour
  fdi challenge --rig quadruple_tank --kinds single,pair
  fdi challenge --plant my_rig.yaml                        hidden rigs built like your plant file
  fdi challenge --plant network --tanks 3..6 --cases 16    random networks of three to six tanks
  fdi challenge --leave-out all --cases 24 --out logs/denied
  fdi challenge --join logs/seven logs/denied --out docs/gap     one set of tables from several folders
"""
ARGUMENTS = {
    "--cases": {"metavar": "N", "type": int, "help": "number of recordings over all kinds (22)"},
    **shared("--seed", help="seed of causes, places, noise and inputs (0)"),
    **shared("--out", default="logs/challenge", help="folder (logs/challenge)"),
    "--rig": {"choices": RIGS, "help": "hidden rig (three_tank)"},
    **shared("--plant", help="instead of --rig: a rig like this plant file, or network"),
    "--tanks": {"metavar": "N..M", "help": "number of tanks of random networks (3..12)"},
    "--kinds": {
        "metavar": "KIND,...",
        "type": names,
        "default": (),
        "help": "kinds of cases (default: those of the first list; of networks, the second)",
    },
    **shared("--leave-out", help="effects to remove from the library, or all, one per case"),
    "--minutes": {"metavar": "M", "type": float, "default": math.inf, "help": "start no case after this time"},
    **shared("--cluster"),
    "--join": {"metavar": "DIR", "nargs": "+", "help": "no diagnosis: merge the answers of these folders"},
}
