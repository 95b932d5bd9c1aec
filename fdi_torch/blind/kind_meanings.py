"""What each kind of case of the blind benchmark is, for its page and for `fdi challenge --help`."""

KIND_MEANINGS = {
    "single": "one effect of usual size",
    "weak": "one effect of a fifth of that size",
    "coloured": "one effect, correlated noise",
    "null": "no discrepancy",
    "pair": "two effects",
    "unknown": "a law outside the library: the right answer is unknown at its location",
    "messy": "one full effect and three weak ones",
    "poor": "one effect, inputs with little excitation",
    "twins": "one of several nearly collinear effects",
    "left_out": "an effect that the diagnosis is not given (--leave-out)",
    "dnull": "no discrepancy, but random disturbance flows into the tanks",
    "dsingle": "random disturbance flows and one effect",
    "dloop": "random disturbance flows alone, a level controlled",
    "site": "random network of tanks: one or two effects",
    "hidden": "random network of tanks: one effect, a third of the levels unmeasured",
    "law": "random network of tanks: a law outside the library",
    "mixed": "random network of tanks: one effect, and such a law elsewhere",
    "loop": "random network of tanks: one effect, a level controlled",
}
