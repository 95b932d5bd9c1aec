"""Kinds of cases (strata) of the blind benchmark."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """A kind of cases. meaning: for the benchmark's page and for `fdi challenge --help`.

    strength: of full effects (1 is usual). causes: number of full effects; perhaps: further ones in every other case;
    faint: further ones of an eighth of the usual strength. unseen: whether a law outside the library is added. inputs:
    see `draw_conditions`. coloured: probability of correlated noise. disturbed: random disturbance flows. unmeasured:
    share of levels without a sensor. looped: whether a level is controlled. shows: whether causes are drawn again until
    each is visible in the readings.
    """

    name: str
    meaning: str
    strength: float = 1.0
    causes: int = 1
    perhaps: int = 0
    faint: int = 0
    unseen: bool = False
    inputs: str = "rich"
    coloured: float = 0.0
    disturbed: bool = False
    unmeasured: float = 0.0
    looped: bool = False
    shows: bool = False


FAINT = 0.125
_NETWORK = "random network of tanks: "
KINDS = {
    kind.name: kind
    for kind in (
        Kind("single", "one effect of usual size"),
        Kind("weak", "one effect of a fifth of that size", strength=0.2),
        Kind("coloured", "one effect, correlated noise", coloured=1.0),
        Kind("null", "no discrepancy", causes=0, coloured=0.3),
        Kind("pair", "two effects", causes=2),
        Kind("unknown", "a law outside the library: the right answer is unknown at its location",
             causes=0, unseen=True),
        Kind("messy", "one full effect and three weak ones", faint=3),
        Kind("poor", "one effect, inputs with little excitation", inputs="poor"),
        Kind("twins", "one of several nearly collinear effects", strength=0.6),
        Kind("left_out", "an effect that the diagnosis is not given (--leave-out)"),
        Kind("dnull", "no discrepancy, but random disturbance flows into the tanks",
             causes=0, inputs="steps", disturbed=True),
        Kind("dsingle", "random disturbance flows and one effect", inputs="steps", disturbed=True, shows=True),
        Kind("dloop", "random disturbance flows alone, a level controlled",
             causes=0, inputs="steps", disturbed=True, looped=True),
        Kind("site", _NETWORK + "one or two effects", perhaps=1, inputs="steps", shows=True),
        Kind("hidden", _NETWORK + "one effect, a third of the levels unmeasured",
             inputs="steps", unmeasured=1 / 3, shows=True),
        Kind("law", _NETWORK + "a law outside the library", causes=0, unseen=True, inputs="steps", shows=True),
        Kind("mixed", _NETWORK + "one effect, and such a law elsewhere", unseen=True, inputs="steps", shows=True),
        Kind("loop", _NETWORK + "one effect, a level controlled", inputs="steps", looped=True, shows=True),
    )
}  # fmt: skip
ON_NETWORKS = ("site", "hidden", "law", "mixed", "null", "loop", "dnull", "dsingle")
"""Default kinds for random networks."""
_EXTRA = {"left_out", "dloop", "site", "hidden", "law", "mixed", "loop"}
STANDARD = tuple(name for name in KINDS if name not in _EXTRA)
"""Default kinds for all other rigs."""
