"""Logs to make pages of: small runs of every kind, with names that try to break the page."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.logbook import RunLog, read_run
from fdi_torch.report.material import Material, gather

FIXED: dict[str, Any] = {
    "env": {"python": "3.11"},
    "git": {"commit": "0" * 40, "changed": "no"},
    "seeds": {"seed": 7},
    "data": [{"path": "rig.csv", "sha256": "ab" * 32}],
}
NASTY = '<script>alert("1")</script>'


def write_train(path: Path, name: str = "T1.leak.size", predicted: bool = True, setting: str = "") -> Path:
    """A diagnosis of two parameters; the first is called `name`."""
    rng = np.random.default_rng(0)
    time = np.arange(1000.0)
    clean = np.stack([0.3 + 0.1 * np.exp(-time / 300), 0.2 + 0.05 * np.exp(-time / 200)], 1)
    read = clean + 1e-3 * rng.standard_normal(clean.shape)
    inputs = np.stack([5e-5 + 1e-5 * (time % 200 > 100), np.full(1000, 4e-5)], 1)
    config = {"estimate.parameters": setting} if setting else None
    with RunLog(path, "train", config=config, config_text="plant: three_tank\n", **FIXED) as log:
        log.recording(time, inputs, read, ("Q1", "Q2"), ("h1", "h2"), ("m^3/s",) * 2, ("m",) * 2)
        log.write("/plant/truth", {name: 0.3, "P13.openness.size": 0.6}, 0.0)
        for g in range(20):
            fields = {"problem": 0, "generation": g, "best_cost": 2.0 * math.exp(-g), name: 0.3 + 0.1 / (g + 1)}
            log.write("/estimator/de/generation", fields | {"mean_cost": 3.0, "evaluations": 50 * g}, g)
        for i in range(5):
            fields = {"problem": 0, "iteration": i, "cost": 1.0 / (i + 1), name: 0.3}
            log.write("/estimator/refine/iteration", fields, i)
        names, covariance = [name, "P13.openness.size"], np.array([[4e-6, -3e-6], [-3e-6, 9e-6]])
        log.estimate(names, [0.3004, 0.599], [2e-3, 3e-3], covariance, "converged", units=["1", "1"])
        location, _, effect = name.partition(".")
        log.fault(effect, location, True, size=0.3004, size_std=2e-3, unit="1", flow=3e-5, hole_diameter=4.8e-3)
        log.fault("openness.size", "P13", False, size=0.599, size_std=3e-3, unit="1")
        log.say("converged")
        if predicted:
            log.result_arrays(predicted=clean)
    return path


def material_of(path: Path, plant: Any = None) -> Material:
    return gather(read_run(path, salvage=True), plant)


def write_gap(path: Path, **changes: Any) -> Path:
    """A named gap with everything in it that the page can draw. changes: of the answer."""
    rng = np.random.default_rng(1)
    time = np.arange(1800.0)
    inputs = np.stack([4e-5 + 3e-5 * (np.sin(time / 130) > 0), 4e-5 + 3e-5 * (np.sin(time / 210) > 0)], 1)
    augmented = 0.3 + np.stack([0.1 * np.sin(time / 130 - k) for k in range(3)], 1)
    recalibrated = augmented + 0.01 * np.diff(inputs, axis=0, prepend=inputs[:1]).cumsum(0)[:, :1] / 3e-5
    read = augmented + 1e-3 * rng.standard_normal(augmented.shape)
    half = slice(0, 900)
    with RunLog(path, "gap", config_text="plant: three_tank\n", **FIXED) as log:
        log.recording(time, inputs, read, ("Q1", "Q2"), ("h1", "h2", "h3"), ("m^3/s",) * 2, ("m",) * 3)
        for place in GAP_ANSWER["where"]:
            log.gap_where(place["location"], place["share"], p_value=1e-9)
        log.gap_verdict(GAP_ANSWER | changes)
        log.result_arrays(
            recalibrated=recalibrated,
            augmented=augmented,
            holdout_time=time[half],
            holdout_read=read[half],
            holdout_recalibrated=recalibrated[half],
            holdout_augmented=augmented[half],
        )
    return path


_LAG, _DELAY = {"effect": "pump_lag", "location": "Q1"}, {"effect": "pump_delay", "location": "Q1"}
GAP_ANSWER: dict[str, Any] = {
    "format": "fdi_torch.gap/1",
    "verdict": "named",
    "alarm": {"p_value": 1e-9},
    "where": [
        {"location": name, "share": share}
        for name, share in (("Q1", 0.91), ("T1", 0.42), ("P13", 0.3), ("h1", 0.11), ("Q2", 0.02), ("T1-T2", 0.01))
    ],
    "causes": [{**_LAG, "parameters": {"time_constant": {"value": 8.1, "std": 0.2, "unit": "s"}}, "same_as": [_DELAY]}],
    "ambiguity_set": [[_LAG], [_DELAY]],
    "posterior": [
        {"causes": [_LAG], "probability": 0.9},
        {"causes": [_DELAY], "probability": 0.08},
        {"causes": [], "probability": 0.02, "unknown_at": "Q1"},
    ],
    "closure": {
        "unit": "cm",
        "nominal": 1.9,
        "recalibrated": 0.8,
        "augmented": 0.101,
        "ceiling": 0.1,
        "noise_floor": 0.1,
        "closed": 0.998,
        "closed_ci95": [0.99, 1.0],
        "per_sensor": {"h1": {"nominal": 2.0, "recalibrated": 0.9, "augmented": 0.1}},
        "frozen": {"recalibrated": 0.5, "nominal": 0.12},
        "per_holdout": [
            {"source": f"day{k}.csv", "recalibrated": 0.8, "augmented": 0.1, "noise_floor": 0.1, "closed": closed}
            for k, closed in enumerate((0.99, None))
        ],
    },
    "next_input": {
        "separation": 60.0,
        "parted_after": 140.0,
        "input": {
            "duration": 300.0,
            "unit": {"Q1": "m^3/s"},
            "Q1": {"at": [0.0, 100.0, 200.0], "value": [2e-5, 8e-5, 2e-5]},
        },
    },
    "remarks": ["Two input steps can never separate lag from delay.", "a rate is at the end of its range (-0.5 1/s)"],
    "impostors": {
        "best": [_DELAY],
        "left_open": 0.03,
        "would_pass": False,
        "simulated": {"draws": 2400, "rivals": 60, "confused": 3, "passed": 41, "passed_for": [_DELAY]},
    },
    "excitation": {"hidden": [_DELAY], "inseparable": [{"between": [_LAG, _DELAY], "parted_by": 3.0}]},
    "constants": {
        f"{pipe}.discharge_coefficient": {
            "nominal": 0.6,
            "tolerance": 0.018,
            "recalibrated": 0.52,
            "augmented": 0.601,
            "std": 2e-4,
            "unit": "1",
        }
        for pipe in ("P13", "P32", "OUT2")
    },
    "curves": [
        {
            "location": "Q1",
            "variable": variable,
            "unit": unit,
            "quantity": "flow",
            "quantity_unit": "m^3/s",
            "at": [0.0, 0.5 * end, end],
            "free": [-1e-6, 1e-6, 3e-6],
            "free_std": [2e-7, 1e-7, 2e-7],
            "effect": [-1.1e-6, 1e-6, 2.9e-6],
        }
        for variable, unit, end in (("Q1 commanded", "m^3/s", 8e-5), ("level of T1", "m", 0.5), ("time", "s", 1800.0))
    ],
}

_ODD, _LEAK = {"effect": "unknown", "location": "Q1"}, {"effect": "leak", "location": "T1"}
GAP_ANSWER_2: dict[str, Any] = GAP_ANSWER | {
    "format": "fdi_torch.gap/2",
    "verdict": "unknown",
    "causes": [{**_LEAK, "parameters": {"size": {"value": 0.2, "std": 0.01, "unit": "1"}}}, _ODD | {"parameters": {}}],
    "ambiguity_set": [],
    "posterior": [
        {"causes": [_LEAK, _ODD], "probability": 0.9, "unknown_at": "Q1"},
        {"causes": [_LEAK, {"effect": "unknown", "location": "T1"}], "probability": 0.07, "unknown_at": "T1"},
        {"causes": [_LEAK], "probability": 0.01},
    ],
    "unexamined": 0.02,
    "certain": [_LEAK],
    "disturbances": {
        "T1": {"std": 2.5e-6, "unit": "m^3/s", "correlation_time": 15.0},
        "T2": {"std": 1e-8, "unit": "m^3/s", "correlation_time": 0.0},
    },
    "impostors": None,
}


def write_monitor(path: Path) -> Path:
    """Residuals with thresholds, an alarm and its isolation."""
    time = np.arange(0.0, 600.0, 2.0)
    rng = np.random.default_rng(2)
    with RunLog(path, "monitor", config_text="plant: three_tank\n", **FIXED) as log:
        for t in time:
            r = {f"h{k}": 1e-3 * rng.standard_normal() + (0.006 if t > 400 else 0.0) for k in (1, 2, 3)}
            tested = {"all_statistic": 3.0 + 40.0 * (t > 400), "all_threshold": 16.0}
            log.write("/observer/residual", r | tested, t, units=dict.fromkeys(r, "m"))
        log.alarm(408.0, "alarm", "h1", "the residual leaves its fault-free range", onset=400.0)
        log.alarm(468.0, "isolated", "T1.leak", "leak at T1: 0.2 ± 0.01", onset=401.0)
        log.fault("leak", "T1", True, size=0.2, size_std=0.01, unit="1")
    return path


def write_study(path: Path) -> Path:
    """Two settings of twenty trials that estimate two parameters."""
    rng = np.random.default_rng(3)
    with RunLog(path, "study", **FIXED) as log:
        for k, (group, spread) in enumerate((("SNR 50", 1e-3), ("SNR 30", 1e-2))):
            for n in range(20):
                free = (np.array([0.3, 0.6]) + spread * rng.standard_normal(2)).tolist()
                numbers = {
                    "truth": [0.3, 0.6],
                    "free": free,
                    "bound": [spread, spread],
                    "cost": float(n),
                    "iterations": 12.0,
                }
                log.trial(20 * k + n, numbers, group=group, seed=n, status="converged" if n else "stalled")
            scores = {
                f"free.{name}.{score}": spread for name in ("T1.leak", "P13.openness") for score in ("bias", "rmse")
            }
            log.summary(group, 20, {"converged": 19.0, **scores})
        log.result({"isolation": {"labels": ["none", "T1.leak"], "trials": 40, "right": 38, "missed": 2, "false": 0}})
        log.result_arrays(confusion=[[20, 0], [2, 18]])
    return path


def write_challenge(path: Path) -> Path:
    """Judged answers of two rigs by three diagnoses; the names of one case try to break the page."""
    kinds, effects = (
        ("single", "unknown", "null", "pair", "left_out"),
        ("pump_lag", "leak", "laminar_flow", "sensor_bias"),
    )
    rng = np.random.default_rng(4)
    with RunLog(path, "challenge", **FIXED) as log:
        for n in range(120):
            kind, effect, right = kinds[n % 5], effects[n // 5 % 4], bool(rng.random() < 0.8)
            truth = [f"{effect}@Q1"] * (kind != "null") + ["overflow@T2"] * (kind == "pair")
            about = {"by": ("fdi", "fdi", "random", "one_at_a_time_bic")[n % 4], "rig": ("three_tank", NASTY)[n > 100]}
            about |= {"case": f"case{n}", "index": n, "truth": truth, "causes": truth if right else ["leak@T1"]}
            about |= {"effect": effect if kind != "null" else "none", "stated": 0.7 + 0.3 * rng.random()}
            judged = {"right": right, "named_wrong": not right and kind != "null", "stated_right": right}
            numbers = {"utility": 0.9, "sec": 2.0 + 3.0 * rng.random(), "closed_error": 0.01 * rng.random()}
            verdict = "named" if kind != "unknown" else "unknown"
            log.trial(n, {**about, **judged, **numbers}, group=kind, seed=1, status=verdict)
    return path


def write_rehearsal(path: Path) -> Path:
    """Two tables; names that try to break the page, and a row that does not fit its header."""
    header = ["size", "detector", "runs", "delay, s (5 .. 95 %)", "missed", "named right", "mostly wrong"]
    rows = [["20 %", NASTY, "2", "4 (3 .. 4)", "0", "1 of 1 (21 .. 100 %)", ""], ["too short"]]
    with RunLog(path, "rehearsal", config_text="faults_found: {}\n", **FIXED) as log:
        log.trial(0, {"delay": [3.0, 4.0], "early": 0.0}, group="faults found/0.2", seed="0/0", status="done")
        log.trial(1, {"fixed": 0.0}, group="naming/open", seed="0/1", status="done")
        said = {"said": "0 of 2 faults missed, 1 of 1 named right"}
        tables = [{"title": "faults found", "header": header, "rows": rows, **said}, {"title": "rows of another kind"}]
        log.result({"tables": tables})
    return path
