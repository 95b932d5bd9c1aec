"""Hypothesis strategies for files from outside: mostly such as people write, with a slip, a bound or malice in some.

Each strategy draws (name, bytes). A grammar makes the file, so that most of them pass the schema and reach what lies
behind it; `spoiled` then damages some of them.
"""

from __future__ import annotations

import copy
import json
import math
from typing import Any

from hypothesis import strategies as st

NAMES = st.sampled_from(["[/b]", "[red]T", "a b", "ü", "T1-T2", "\x9b31m", "outside"])
EXTREMES = st.sampled_from([0, -1, 1e-320, 1e-12, 1e12, 1e300, -1e300, math.inf, math.nan, 2**63, 10**399, True, None])
EXTREME_TEXTS = st.sampled_from(
    ["0 m", "-1 m", "1e300 m", "1e-300 s", "nan s", "9**9**9 cm^2", "1 m^9", "5", "m", "", "1 cm cm", "1 µm", "1e999 s"]
)
ANYTHING = st.recursive(
    st.one_of(EXTREMES, EXTREME_TEXTS, st.text(max_size=6)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)


def amount(low: float, high: float, *units: str) -> st.SearchStrategy[str]:
    """A quantity of usual size, mostly with four digits."""
    number = st.floats(low, high, allow_nan=False).map(lambda x: f"{x:.4g}")
    return st.tuples(number, st.sampled_from(units)).map(" ".join)


def one_in(n: int, rare: st.SearchStrategy[Any], usual: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.sampled_from([usual] * (n - 1) + [rare]).flatmap(lambda chosen: chosen)


SELDOM = st.sampled_from([False] * 4 + [True])


@st.composite
def plants(draw: st.DrawFn) -> dict[str, Any]:
    """One to four tanks, pipes between them, pumps and sensors, effects, tolerances."""
    plain = [f"T{i}" for i in range(1, draw(st.integers(1, 4)) + 1)]
    tanks = list(dict.fromkeys(draw(one_in(8, NAMES, st.just(name))) for name in plain))
    pipes = [f"P{i}" for i in range(draw(st.integers(0, 4)))]
    pumps, sensors = (
        [f"Q{i}" for i in range(draw(st.integers(0, 2)))],
        [f"h{i}" for i in range(draw(st.integers(1, 3)))],
    )
    tank = st.sampled_from(tanks)
    ends = tank.map(lambda t: (t, "outside")) | st.permutations([*tanks, "outside", "outside"]).map(
        lambda p: (p[0], p[1]) if p[0] != "outside" else (tanks[0], "outside")
    )
    gains = amount(0.01, 2, "V/cm", "mbar/cm", "%/cm", "mA/cm") | st.just(1)
    effects = st.one_of(
        st.fixed_dictionaries(
            {"effect": st.sampled_from(["pump_lag", "pump_delay"]), "location": st.sampled_from(pumps or ["Q0"])}
        ),
        st.fixed_dictionaries(
            {
                "effect": st.just("sensor_lag"),
                "location": st.sampled_from(sensors),
                "parameters": st.fixed_dictionaries({"time_constant": amount(0, 50, "s")}),
            }
        ),
        st.fixed_dictionaries(
            {"effect": st.sampled_from(["leak", "evaporation", "overflow", "stuck"]), "location": tank}
        ),
    )
    made: dict[str, Any] = {
        "tanks": {
            t: {"area": draw(amount(1, 500, "cm^2", "m^2")), "height": draw(amount(5, 200, "cm"))} for t in tanks
        },
        "pipes": {
            p: {
                **dict(zip(("source", "target"), draw(ends), strict=True)),
                "area": draw(amount(0.1, 5, "cm^2")),
                "discharge_coefficient": draw(st.floats(0.05, 1.2)),
            }
            for p in pipes
        },
        "pumps": {q: {"target": draw(tank), "max_flow": draw(amount(10, 500, "cm^3/s", "l/h"))} for q in pumps},
        "sensors": {h: {"tank": draw(tank), "gain": draw(gains)} for h in sensors},
    }
    if draw(st.booleans()):
        made["tolerances"] = {"*.area": draw(amount(0.1, 9, "%"))}
        made["varying"] = draw(st.sampled_from([[], ["T1.area"], ["*.area"]]))
    if draw(st.integers(0, 3)) == 0:
        made["effects"] = draw(st.lists(effects, max_size=2))
    return made


@st.composite
def inputs(draw: st.DrawFn) -> Any:
    flow = amount(0, 90, "cm^3/s", "l/min", "m^3/h")
    stepped = st.lists(flow, min_size=1, max_size=3).map(
        lambda v: {"steps": [[f"{18 * i} s", x] for i, x in enumerate(v)]}
    )
    return draw(flow | stepped)


SEARCH = st.fixed_dictionaries(
    {},
    optional={"population": st.integers(4, 60), "evaluations": st.integers(4, 500), "archive_share": st.floats(0, 9)},
)
RECORDING = st.fixed_dictionaries(
    {"file": st.just("rig.csv")},
    optional={
        "every": st.integers(1, 4),
        "start": amount(0, 2.5, "s"),
        "mask": st.just([["3 s", "5 s"]]),
        "start_levels": st.sampled_from(["free", "equilibrium", {"T1": "40 cm"}]),
    },
)
STUDY = st.fixed_dictionaries(
    {"trials": st.integers(1, 4)},
    optional={
        "faults": st.sampled_from(["simulated", "uniform", "modes"]),
        "snr_db": st.lists(st.none() | st.floats(-20, 60), min_size=1, max_size=3),
        "population": st.integers(4, 50),
    },
)


@st.composite
def run_files(draw: st.DrawFn, study: bool = False) -> dict[str, Any]:
    """Faults of a shipped plant (now and then of another) in a recording, in a simulation, or in many of them."""
    suspects = ["T1.leak", "T2.leak", "P13.plugging", "P32.openness", "P13.discharge_coefficient"]
    named = draw(st.lists(st.sampled_from(suspects), min_size=1, max_size=3, unique=True))
    made: dict[str, Any] = {
        "plant": draw(one_in(20, plants(), st.just("three_tank"))),
        "estimate": {
            "parameters": [draw(st.sampled_from([name, {"name": name}])) for name in named],
            "search": draw(SEARCH),
            "confidence": draw(st.floats(0.01, 0.99)),
        },
        "seed": draw(st.integers(0, 2**31)),
    }
    if study or draw(st.booleans()):
        simulated = [name for name in named if name.endswith(("leak", "plugging"))][:1]
        made["simulate"] = {
            "inputs": {"Q1": draw(inputs()), "Q2": draw(inputs())},
            "duration": draw(st.sampled_from(["60 s", "2 min", "0.1 h"])),
            "sample_time": draw(st.sampled_from(["1 s", "0.5 s", "2000 ms", "0.05 min"])),
            "faults": {name: draw(st.floats(0, 0.5)) for name in simulated},
            "noise": draw(st.sampled_from([{}, {"snr_db": 30}, {"std": {"h1": "1 mm"}}])),
        }
    else:
        made["recordings"] = [draw(RECORDING)]
    if study:
        made["study"] = draw(STUDY)
    return made


@st.composite
def spoiled(draw: st.DrawFn, whole: st.SearchStrategy[dict[str, Any]]) -> bytes:
    """The document as YAML (JSON is YAML); in a fifth of them one value is replaced, removed or misplaced."""
    document = copy.deepcopy(draw(whole))  # a strategy draws the same object again
    if draw(SELDOM):
        _spoil(draw, document)
    text = json.dumps(document, ensure_ascii=False).replace("NaN", ".nan").replace("Infinity", ".inf")
    return text.replace("\x9b", "\\x9b").encode("utf-8", "replace")


def _spoil(draw: st.DrawFn, node: Any) -> None:
    while True:
        places = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not places:
            return
        place = draw(st.sampled_from(places))
        if not isinstance(node[place], dict | list) or draw(st.integers(1, 4)) == 1:
            break
        node = node[place]
    if isinstance(node, dict) and draw(st.integers(1, 5)) == 1:
        node[draw(st.text(max_size=8))] = node.pop(place)
    else:
        node[place] = draw(ANYTHING)


CHANNELS = (
    ("t_s", "Q1_cm3_s", "Q2_cm3_s", "h1_cm", "h2_cm", "h3_cm"),
    ("t [s]", "Q1 [l/min]", "Q2 [l/min]", "h1 [mm]", "h2 [m]", "h3 (cm)"),
)
CELLS = st.one_of(
    st.floats(0, 60).map(lambda x: f"{x:.3f}"),
    st.sampled_from(
        ["", "nan", "1e300", "-1e-300", "inf", "1,5", "bad", "#N/A", '"4"', "0x1", "\x1b[2J", "９", "1e5000", "-"]
    ),
)


@st.composite
def csv_files(draw: st.DrawFn) -> bytes:
    """A header, rows that increase in time, now and then an odd cell, another delimiter, encoding, header or damage."""
    header = list(draw(st.sampled_from(CHANNELS)))
    rows = draw(st.integers(2, 40))
    step = draw(st.sampled_from([1.0, 0.1, 60.0, 1e-6]))
    levels = draw(st.lists(st.floats(0, 60), min_size=3, max_size=3))
    table = [[f"{k * step:.9g}", "50", "40", *(f"{h + 0.1 * math.sin(k):.4f}" for h in levels)] for k in range(rows)]
    for _ in range(draw(st.sampled_from([0, 0, 0, 0, 0, 0, 1, 3]))):
        table[draw(st.integers(0, rows - 1))][draw(st.integers(0, 5))] = draw(CELLS)
    if draw(SELDOM):
        header[draw(st.integers(0, 5))] = draw(
            st.sampled_from(["h1 [9**9**9]", "_" * 300, "h1_cm", "", "[/b]_cm", "t_h", "Q1_V"])
        )
    delimiter = draw(st.sampled_from([",", ",", ";", "\t"]))
    ends = draw(st.sampled_from(["\n", "\r\n"]))
    text = ends.join(delimiter.join(row) for row in [header, *table]) + ends
    data = text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-8-sig", "utf-16", "cp1252"])), "replace")
    return draw(damaged(data)) if draw(SELDOM) else data


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes changed, cut, doubled or put in."""
    spoilt = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(spoilt) - 1, 0)))
        kind = draw(st.sampled_from(["change", "cut", "put in", "double", "zero"]))
        if kind == "change" and spoilt:
            spoilt[place] = draw(st.integers(0, 255))
        elif kind == "cut":
            del spoilt[place : place + draw(st.integers(1, 64))]
        elif kind == "put in":
            spoilt[place:place] = draw(st.binary(max_size=16))
        elif kind == "double":
            spoilt[place:place] = spoilt[place : place + 50]
        else:
            spoilt[place : place + 8] = bytes(8)
    return bytes(spoilt)


JSON_VALUES = one_in(6, ANYTHING.filter(lambda v: v not in (math.inf, -math.inf)), st.floats(0, 1))


@st.composite
def own_messages(draw: st.DrawFn) -> list[tuple[str, dict[str, Any]]]:
    """Messages of a log of ours, as a program that writes what it likes would: null, lists and objects for numbers."""
    topics = st.sampled_from(
        [
            "/plant/input",
            "/plant/output",
            "/plant/truth",
            "/estimate/final",
            "/estimator/de/generation",
            "/gap/verdict",
            "/observer/residual",
            "/observer/alarm",
            "/diagnosis/fault",
            "/study/trial",
            "/study/summary",
            "/gap/where",
            "/log",
        ]
    )
    keys = [
        "t",
        "h1",
        "h2",
        "h3",
        "Q1",
        "Q2",
        "masked",
        "non_finite",
        "value",
        "std",
        "name",
        "parameter",
        "generation",
    ]
    keys += [
        "best_cost",
        "size",
        "confidence",
        "answer",
        "trial",
        "group",
        "status",
        "unit",
        "message",
        "location",
        "fault",
    ]
    payload = st.dictionaries(st.sampled_from(keys), JSON_VALUES, max_size=6)
    return draw(st.lists(st.tuples(topics, payload), max_size=8))
