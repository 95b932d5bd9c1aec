"""Fault or missing effect? A gap that was named and adopted is no longer taken for a fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.run_file import load_run
from fdi_torch.gap.answer import adopted
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.jobs.train import train
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_writing import write_csv
from tests.test_gap import nominal_plant, recorded

LAMINAR = {"P13.laminar_flow.transition_head": 0.1}
LEAK = 0.15
RUN = """
plant: rig.yaml
recordings:
  - {file: fault.csv}
estimate:
  parameters: [T1.leak, P13.plugging]
  search: {evaluations: 600}
  step: {search: 5 s, refine: 1 s}
output: {folder: logs}
"""


def trained(plant: PlantDescription, recording: Recording, folder: Path) -> dict[str, tuple[float, float]]:
    """Size and standard error of each fault that `fdi train` estimates."""
    folder.mkdir()
    (folder / "rig.yaml").write_text(dump_plant(plant))
    (folder / "run.yaml").write_text(RUN)
    write_csv(recording, folder / "fault.csv")
    estimate = train(load_run(folder / "run.yaml", [f"output.folder={folder}"])).result.estimate
    return {n: (float(v), float(s)) for n, v, s in zip(estimate.names, estimate.value, estimate.std, strict=True)}


@pytest.fixture(scope="module")
def better() -> PlantDescription:
    """The plant file with what a fault-free recording of the rig showed it to lack."""
    settings = Settings(("laminar_flow", "pump_lag", "leak", "plugging"), named_only=True)
    answer = diagnose(nominal_plant(), recorded(LAMINAR, 3), settings=settings)
    assert [(c.effect, c.location) for c in answer.causes] == [("laminar_flow", "P13")]
    return adopted(nominal_plant(), answer, constants=True)


def test_the_size_of_a_fault_is_right_once_the_gap_is_adopted(better: PlantDescription, tmp_path: Path) -> None:
    faulty = recorded({**LAMINAR, "T1.leak.size": LEAK}, 11)
    found = trained(better, faulty, tmp_path / "better")
    leak, plugging = found["T1.leak.size"], found["P13.plugging.size"]
    assert abs(leak[0] - LEAK) < 4.0 * leak[1] and leak[1] < 0.01
    assert abs(plugging[0]) < 4.0 * plugging[1]
    print(found)
    absorbed = trained(nominal_plant(), faulty, tmp_path / "nominal")
    leak, plugging = absorbed["T1.leak.size"], absorbed["P13.plugging.size"]
    print(absorbed)
    # Without it the pipe is taken to be plugged, far beyond what the estimate says it may be wrong.
    assert plugging[0] > 4.0 * plugging[1] and plugging[0] > 0.1
    assert abs(leak[0] - LEAK) > 4.0 * leak[1]
