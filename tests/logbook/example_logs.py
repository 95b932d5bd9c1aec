"""Example logs: a run with every topic, written with a fixed clock, and a log of several chunks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.logbook import RunLog
from fdi_torch.logbook.schemas import json_schema
from fdi_torch.logbook.sink import Sink
from fdi_torch.logbook.topic_definitions import Channel, topic_definition

FROZEN = 1_790_000_000_123_456_789
FIXED: dict[str, Any] = {
    "config_text": "plant: three_tank\n",
    "config": {"plant": "three_tank", "search": {"size": 50, "bounds": [0.0, 1.0]}},
    "seeds": {"noise": 7},
    "data": [{"path": "rig.csv", "sha256": "ab" * 32}],
    "env": {"python": "3.11"},
    "git": {"commit": "0" * 40, "changed": "no"},
    "clock": lambda: FROZEN,
}


def log_generation(log: RunLog, generation: int, cost: float, numbers: dict[str, Any], problem: int = 0) -> None:
    """A generation of the search."""
    fields = {"problem": problem, "generation": generation, "best_cost": cost, **numbers}
    log.write("/estimator/de/generation", fields, generation)


def write_everything(log: RunLog, samples: int = 50) -> None:
    """At least one message on every topic, with awkward numbers among them."""
    rng = np.random.default_rng(0)
    time = np.arange(samples) * 0.1
    outputs = 0.5 + 0.01 * rng.standard_normal((samples, 3))
    outputs[3, 1] = np.nan
    mask = np.isfinite(outputs)
    mask[5, 0] = False
    log.recording(
        time,
        rng.random((samples, 2)) * 1e-4,
        outputs,
        ("Q1", "Q2"),
        ("h1", "h2", "h3"),
        ("m^3/s",) * 2,
        ("m",) * 3,
        mask=mask,
        hold="linear",
    )
    log.write("/source/clock", {"origin": 1.7e9}, 0.0)
    log.write("/plant/truth", {"T1.leak.size": 0.1}, 0.0, units={"T1.leak.size": "1"})
    levels = ("h1", "h2", "h3")
    tested = dict.fromkeys([f"{name}_statistic" for name in levels], 4.2) | {"h1_threshold": 5.0}
    log.write("/observer/residual", dict.fromkeys(levels, 1e-3) | tested, 1.0, units=dict.fromkeys(levels, "m"))
    log.alarm(2.0, "raised", "h1", "h1 left its band", value=6.1, threshold=5.0, onset=1.5)
    for generation in range(3):
        numbers: dict[str, Any] = {"T1.leak.size": 0.1, "mean_cost": np.inf, "evaluations": 50}
        log_generation(log, generation, 1.0 / (generation + 1), numbers)
    log.population(2, {"population": rng.random((4, 2)), "cost": np.array([1.0, np.nan, 2.0, np.inf])})
    steps = {"step": 0.01, "gradient": 1e-6, "damping": 1e-3, "accepted": True, "T1.leak.size": 0.1}
    log.write("/estimator/refine/iteration", {"problem": 0, "iteration": 0, "cost": 0.5, **steps}, 0.0)
    log.estimate(
        ["a", "b"], np.array([0.1, np.nan]), [0.01, np.inf], np.eye(2), "converged", units=["1", "1"], cost=2.0
    )
    log.predictions(time, outputs, np.full((samples, 3), 0.5), levels, ("m",) * 3, mask=mask, noise_std=[1e-2] * 3)
    log.fault("leak", "T1", True, confidence=0.99, size=0.1, size_std=0.01, unit="1", flow=1e-5, hole_diameter=3e-3)
    log.gap_where("Q1", 0.91, p_value=1e-9)
    log.gap_verdict(VERDICT)
    log.trial(0, {"T1.leak.size": 0.1, "error": 1e-3}, group="snr 50", seed=2**63, status="converged")
    log.summary("snr 50", 1, {"rmse": 1e-3})
    log.say("done")


VERDICT = {
    "format": "fdi_torch.gap/1",
    "verdict": "named",
    "alarm": {"p_value": 1e-9},
    "where": [{"location": "Q1", "share": 0.91}],
    "causes": [{"effect": "pump_lag", "location": "Q1", "parameters": {}}],
    "ambiguity_set": [[{"effect": "pump_lag", "location": "Q1"}]],
    "posterior": [{"causes": [{"effect": "pump_lag", "location": "Q1"}], "probability": 0.97}],
    "closure": {"metric": "rmse", "nominal": 1.9, "augmented": 0.1, "closed": 0.998, "closed_ci95": [0.99, 1.0]},
}


_TRIAL = topic_definition("/study/trial")
TRIAL = Channel("/study/trial", "json", _TRIAL.schema, "jsonschema", json_schema(_TRIAL, {}))


def write_finished(path: Path) -> Path:
    """A finished log with every topic, results and arrays in it."""
    with RunLog(path, "train", **FIXED) as log:
        write_everything(log)
        log.result({"estimate": {"T1.leak.size": 0.1}})
        log.result_arrays(covariance=np.eye(2))
    return path


def write_chunks(path: Path, chunks: int = 4, per_chunk: int = 20) -> Path:
    """A finished log of trials 0, 1, 2... in chunks of a given number."""
    sink = Sink(path, "fdi_torch test")
    sink.metadata("fdi_torch.run", {"kind": "test", "run_id": "1"})
    sink.attachment("config.yaml", "application/yaml", b"a: 1\n")
    for number in range(chunks * per_chunk):
        sink.message(TRIAL, number, number, number, b'{"t":%d,"trial":%d}' % (number, number))
        if number % per_chunk == per_chunk - 1:
            sink.flush()
    sink.metadata("fdi_torch.status", {"status": "completed"})
    sink.finish()
    return path
