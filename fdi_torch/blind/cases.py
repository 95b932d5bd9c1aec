"""Cases of the blind benchmark: drafts are simulated in one batch, and their sensors are read; and their files.

spec.json          settings: seed, kinds, rig
cases/caseNNNN_plant.json: nominal plant for the diagnosis (also as .yaml, for manual use)
cases/caseNNNN_recording.csv.gz, cases/caseNNNN_holdout.csv.gz: above the header, the SHA-256 of the sealed key
manifest.jsonl     one line per case: SHA-256 of the plant, of both recordings and of the sealed key
key.jsonl          one line per case: the truth; opened after the diagnosis
answers_WHO.jsonl  one line per case: the answer, its computing time and the state of the code
rows.jsonl         one line per answer: its scores; see `scored_rows`
"""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.blind.case_drafts import CaseDraft, CasePlan, draft_cases
from fdi_torch.blind.case_readings import PARTS, noisy_readings
from fdi_torch.blind.conditions import Lane, commands_of_pumps, moved_by, simulated
from fdi_torch.blind.deviation import Array
from fdi_torch.blind.inputs import DECIMALS, command_unit, pumps_of_channels
from fdi_torch.blind.networks import Networks
from fdi_torch.blind.plants import Rig, decimals
from fdi_torch.blind.simulator import STEP, SimulatedRun
from fdi_torch.plant.description import FLOW_KINDS, FaultPriority, PlantDescription, Sensor, Tank
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_files import read_csv
from fdi_torch.recordings.source import file_sha256

INVISIBLE = 0.03
"""If a cause moves the readings by less than this share of the noise beside the other causes, it is not asked for."""


@dataclass(frozen=True)
class Case:
    """A simulated case; its truth will be sealed.

    commands, readings: of recording and hold-out, (T, C) in the header's unit and (T, S) m.
    """

    plan: CasePlan
    rig: Rig
    commands: tuple[Array, Array]
    readings: tuple[Array, Array]
    truth: dict[str, Any]


def make(
    todo: Sequence[CasePlan],
    rigs: Rig | Networks,
    seed: int,
    library: Collection[str] = (),
    leave_out: Sequence[str] = (),
) -> list[Case]:
    """Make the planned cases, with all rigs simulated in one batch. A case does not depend on the others."""
    drafts = draft_cases(todo, rigs, seed, library, leave_out)
    return [_case(draft, runs) for draft, runs in zip(drafts, _run(drafts), strict=True)]


def _lanes(draft: CaseDraft) -> list[Lane]:
    """The simulations of a case: recording and hold-out with the deviations; both without; the recording without each
    one of several full causes; and, with random flows, the recording without deviations and without random flows.
    """
    c, off = draft.conditions, draft.deviations
    without = [(c, 0, draft.without(k), True) for k in (draft.full if len(draft.full) > 1 else [])]
    undisturbed: list[Lane] = [(c, 0, (), False)] if c.disturbances else []
    return [(c, 0, off, True), (c, 1, off, True), (c, 0, (), True), (c, 1, (), True), *without, *undisturbed]


def _run(drafts: Sequence[CaseDraft]) -> list[list[SimulatedRun]]:
    """The runs of each case in the order of its lanes."""
    lanes = [_lanes(draft) for draft in drafts]
    runs = iter(simulated([lane for case_lanes in lanes for lane in case_lanes], STEP))
    return [[next(runs) for _ in case_lanes] for case_lanes in lanes]


def _case(draft: CaseDraft, runs: Sequence[SimulatedRun]) -> Case:
    c, rig, readings, noise_rms, gap_rms = draft.conditions, draft.conditions.rig, [], {}, {}
    for part, (name, _) in enumerate(PARTS):
        noisy, clean = noisy_readings(c, runs[part], part, draft.deviations)
        _, nominal = noisy_readings(c, runs[part + 2], part, ())
        readings.append(noisy)
        noise_rms[name] = (rig.scales.length * np.sqrt(np.mean((noisy - clean) ** 2, axis=0))).tolist()
        gap_rms[name] = rig.scales.length * float(np.sqrt(np.mean((clean - nominal) ** 2)))
    invisible = []  # full causes masked by others, such as a weir above a level that a leak lowers
    for k, run in zip(draft.full, runs[4:], strict=False) if len(draft.full) > 1 else ():
        other, _ = noisy_readings(c, run, 0, draft.without(k))
        if np.sqrt(np.mean(((other - readings[0]) / c.noise) ** 2)) < INVISIBLE:
            invisible.append(k)
    highest = np.maximum(*(run.levels.max(axis=0) for run in runs[:2]))
    causes = [draft.deviations[k] for k in draft.full if k not in invisible]
    truth: dict[str, Any] = {
        "case": draft.plan.name,
        "kind": draft.plan.kind,
        "index": draft.plan.index,
        "causes": [
            {"effect": d.effect, "location": d.location} | ({"really": d.law} if d.effect == "unknown" else {})
            for d in causes
        ],
        "leave_out": list(draft.chosen.leave_out),
        "deviations": [d.as_dict() for d in draft.deviations],
        "noise_rms_m": noise_rms,
        "gap_rms_m": gap_rms,
        "signal": c.signal,
        "colour": c.correlation.name,
        "repeats": c.correlation.repeats,
        "scales": rig.scales.as_dict(),
        "over_rim": bool((highest >= [t.height for t in c.built.tanks]).any()),
    }
    if c.disturbance:
        moved = moved_by(c, runs[2].levels, runs[-1].levels)
        truth["disturbance"] = c.disturbance.as_dict() | {"moves_levels_by_noise": moved}
    if c.control:
        truth["control"] = {"law": c.control[0].law, "pump": rig.plant.pumps[c.control[0].pump].name}
    if not draft.shows:
        truth["shows"] = False
    commands = c.commands
    if c.control:
        asked = (runs[part].asked for part in (0, 1))
        commands = tuple(commands_of_pumps(c.built, q) for q in asked)  # type: ignore[assignment]
    return Case(draft.plan, rig, commands, (readings[0], readings[1]), truth)


_DECIMALS_OF_LEVEL = 3


def as_csv(rig: Rig, commands: Array, readings: Array, seal: str) -> str:
    """The recording, rescaled to the rig's own lengths and times. seal: hash of the case's sealed key.

    commands (T, C) in the header's unit, readings (T, S) as levels in m, both of the simulated rig, one per second.
    """
    header, columns, places = ["t_s"], [np.arange(len(commands)) * rig.scales.time], [decimals(0, rig.scales.time)]
    for i, pump in enumerate(pumps_of_channels(rig.plant)):
        unit, scale = command_unit(pump), rig.scales.command(pump)
        header.append(f"{pump.channel}_{unit}")
        columns.append(commands[:, i] * scale)
        places.append(decimals(DECIMALS[unit], scale))
    for i, sensor in enumerate(rig.plant.sensors):
        in_metres = sensor.unit == "m"
        header.append(f"{sensor.column}_{'cm' if in_metres else sensor.unit}")
        shown = np.clip(sensor.gain * readings[:, i] + sensor.offset, sensor.low, sensor.high)
        columns.append(shown * (100 * rig.scales.length if in_metres else 1))
        places.append(decimals(_DECIMALS_OF_LEVEL, rig.scales.length if in_metres else 1.0))
    rows = zip(*([f"{v:.{d}f}" for v in column] for column, d in zip(columns, places, strict=True)), strict=True)
    return (
        "\n".join([f"# SHA-256 of the sealed key: {seal}", ",".join(header), *(",".join(row) for row in rows)]) + "\n"
    )


def digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def sealed_line(truth: Mapping[str, Any]) -> str:
    """The truth as the one line that is hashed: sorted, without blanks."""
    return json.dumps(truth, sort_keys=True, separators=(",", ":"))


def write_cases(out: Path, made: Iterable[Case], secrets: Iterable[str]) -> None:
    """Recordings first, then their line in the key and in the manifest: what the manifest names is complete.

    secrets: a random word a case, kept in the key, without which its hash would give the cause away by trial.
    """
    (out / "cases").mkdir(parents=True, exist_ok=True)
    for case, secret in zip(made, secrets, strict=True):
        line: dict[str, Any] = {"case": case.plan.name, "leave_out": case.truth["leave_out"]}
        key = sealed_line(case.truth | {"nonce": secret})
        path = _plant_file(out, case.plan.name)
        path.write_text(json.dumps(asdict(case.rig.believed), indent=1) + "\n")
        line["plant"] = file_sha256(path)
        for (part, _), commands, readings in zip(PARTS, case.commands, case.readings, strict=True):
            text = as_csv(case.rig, commands, readings, digest(key))
            path = out / "cases" / f"{case.plan.name}_{part}.csv.gz"
            path.write_bytes(gzip.compress(text.encode(), compresslevel=5, mtime=0))
            line[part] = file_sha256(path)
        append(out / "key.jsonl", key)
        append(out / "manifest.jsonl", json.dumps(line | {"key": digest(key)}))


def append(path: Path, line: str) -> None:
    with path.open("a") as file:
        file.write(line + "\n")


def lines_of(path: Path) -> list[dict[str, Any]]:
    """All whole lines of a JSON-lines file; a last line cut short by an interruption is dropped from the file too."""
    if not path.exists():
        return []
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole)
    return [json.loads(line) for line in whole.splitlines()]


def _plant_file(out: Path, case: str) -> Path:
    return out / "cases" / f"{case}_plant.json"


def read_plant(out: Path, line: Mapping[str, Any]) -> PlantDescription:
    """The nominal plant of a case, checked against its line of the manifest."""
    path = _plant_file(out, line["case"])
    _expect_unchanged(line, "plant", file_sha256(path))
    data = json.loads(path.read_text())
    kinds = {"tanks": Tank, "sensors": Sensor, "matters": FaultPriority} | {kind.part(): kind for kind in FLOW_KINDS}
    parts = {name: tuple(kind(**fields) for fields in data.get(name, ())) for name, kind in kinds.items()}
    return PlantDescription(**(data | parts | {"effects": (), "varying": tuple(data["varying"])}))


def read_recording(out: Path, line: Mapping[str, Any], part: str, plant: PlantDescription) -> Recording:
    """One recording of a case, checked against its line of the manifest. Its source names the case and nothing else."""
    path = out / "cases" / f"{line['case']}_{part}.csv.gz"
    recording = read_csv(path, plant.channels(), plant.outputs())
    _expect_unchanged(line, part, recording.sha256)
    return replace(recording, source=f"{line['case']}/{part}")


def _expect_unchanged(line: Mapping[str, Any], part: str, actual: str) -> None:
    if actual != line[part]:
        raise ValueError(
            f"{line['case']}: expected a {part} of SHA-256 {line[part][:12]}..., got {actual[:12]}...; "
            "it was changed after it was sealed: repeat `fdi challenge`"
        )


def answers(out: Path, name: str) -> Path:
    return out / f"answers_{name}.jsonl"


def manifest(out: Path) -> dict[str, dict[str, Any]]:
    return {line["case"]: line for line in lines_of(out / "manifest.jsonl")}


def open_key(out: Path) -> dict[str, dict[str, Any]]:
    """The truths by case, each checked against the manifest.

    Raises ValueError where a key was changed or is missing.
    """
    keys = {line["case"]: line for line in lines_of(out / "key.jsonl")}
    for case, line in manifest(out).items():
        if case not in keys:
            raise ValueError(f"{case}: expected a sealed key, got none; repeat `fdi challenge`")
        _expect_unchanged(line, "key", digest(sealed_line(keys[case])))
    return keys
