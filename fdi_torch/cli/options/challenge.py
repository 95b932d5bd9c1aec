"""The blind benchmark of the gap diagnosis: hidden rigs of other equations and another integrator, causes sealed.

Recordings are made, their causes sealed (the hash of the key stands in each recording), every recording is diagnosed
without the key, then the key is opened and the answers are judged: by kind of case, with 95 % intervals, beside
baselines. All of it is kept in --out, where an interrupted benchmark goes on when it is started again.
"""

from __future__ import annotations

import argparse
import math

RIGS = ("cascaded_tanks", "quadruple_tank", "three_tank")

EXAMPLES = """
kinds of cases:
  single    one effect of usual strength          pair      two effects
  weak      a fifth of that                       messy     one full effect among three faint ones
  coloured  noise that is not white               poor      inputs that excite little
  null      nothing is wrong                      twins     one of a family that is nearly collinear
  unknown   a law that no effect of the library has: `unknown` at its place is right
  left_out  an effect that the diagnosis is denied (--leave-out)
  dnull     nothing is wrong, the flows into the tanks are disturbed at random
  dsingle   the same with one effect that shows
and, with --plant network, on a random network of tanks in each case:
  site      one or two effects                    law       a law that no effect of the library has
  hidden    a third of the levels is unmeasured   mixed     one effect beside such a law elsewhere
  loop      a level is controlled                 null, dnull, dsingle as above

--out then holds rows.jsonl (a line an answer), scores.json, scores.md and challenge.mcap (`fdi report` makes the page).
The workers of a --cluster have to see that folder.

examples:
  fdi challenge                                            22 cases, two a kind, about four minutes on one core
  fdi challenge --cases 450 --seed 7 --out logs/seven      fifty a kind; Ctrl-C and the same words again go on
  fdi challenge --cases 450 --seed 7 --out logs/seven --minutes 30      what is answered in half an hour is scored
  fdi challenge --rig quadruple_tank --kinds single,pair --no-bic
  fdi challenge --plant my_rig.yaml                        hidden rigs built as a plant file of yours describes
  fdi challenge --plant network --tanks 3..6 --cases 16    random networks of three to six tanks
  fdi challenge --leave-out all --cases 24 --out logs/denied
  fdi challenge --join logs/seven logs/denied --out docs/gap     one set of tables from several folders
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", metavar="N", type=int, help="recordings, spread over the kinds (22)")
    parser.add_argument("--seed", metavar="S", type=int, help="of causes, places, noise and inputs (0)")
    parser.add_argument("--out", metavar="DIR", default="logs/challenge", help="folder (logs/challenge)")
    parser.add_argument(
        "--rig", choices=("cascaded_tanks", "quadruple_tank", "three_tank"), help="which hidden rig (three_tank)"
    )
    parser.add_argument("--plant", metavar="NAME|FILE", help="instead: a rig as this file describes, or network")
    parser.add_argument("--tanks", metavar="N..M", help="of random networks (3..12)")
    parser.add_argument(
        "--kinds", metavar="KIND,...", help="by default those listed first; on networks those listed for them"
    )
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="deny these, one a case: 'all' in turn")
    parser.add_argument("--no-bic", action="store_true", help="spare the one-at-a-time BIC winner, the dear baseline")
    parser.add_argument("--minutes", metavar="M", type=float, default=math.inf, help="begin no case after so long")
    parser.add_argument(
        "--cluster",
        metavar="local|ADDRESS",
        help="diagnose on Dask: local, or tcp://host:8786, or tls://host:8786; what answers there is trusted",
    )
    parser.add_argument("--join", metavar="DIR", nargs="+", help="diagnose nothing: join the answers of these folders")
