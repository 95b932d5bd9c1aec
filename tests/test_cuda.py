"""Work on a GPU gives the results of the CPU, from run files and from Python."""

from pathlib import Path

import pytest
import torch

import fdi_torch
from fdi_torch.config.run_file import load_run
from fdi_torch.recording import Recording

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
CUDA = torch.device("cuda")
SHORT = [
    "simulate.duration=60 s",
    "simulate.sample_time=5 s",
    "simulate.faults={T1.leak: 0.3}",
    "estimate.parameters=[T1.leak]",
    "estimate.search.population=12",
    "estimate.search.evaluations=240",
    "estimate.step.search=5 s",
    "estimate.step.refine=5 s",
]


@pytest.fixture(scope="module")
def recording() -> Recording:
    steps = {"steps": [["0 s", "50 cm^3/s"], ["60 s", "70 cm^3/s"]]}
    noise = {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}}
    return fdi_torch.simulate(inputs={"Q1": steps, "Q2": "50 cm^3/s"}, duration="120 s", noise=noise)


def test_train_gives_the_same_estimate(tmp_path: Path) -> None:
    found = {}
    for device in ("cpu", "cuda"):
        run = load_run(None, [*SHORT, f"device={device}", f"output.folder={tmp_path / device}"])
        found[device] = fdi_torch.train(run)
    cpu, cuda = (found[d].result for d in ("cpu", "cuda"))
    assert cuda.estimate.value.device.type == "cuda" and "runs on cuda" in cuda.engine
    assert torch.equal(cuda.search.generations.cpu(), cpu.search.generations)
    torch.testing.assert_close(cuda.estimate.value.cpu(), cpu.estimate.value, rtol=1e-9, atol=0.0)
    torch.testing.assert_close(cuda.estimate.std.cpu(), cpu.estimate.std, rtol=1e-6, atol=0.0)
    limits = [found[d].profile("T1.leak.size")[0] for d in ("cpu", "cuda")]
    assert limits[1].low == pytest.approx(limits[0].low, rel=1e-6)
    assert found["cuda"]._repr_html_() and found["cuda"].log.exists()


@pytest.mark.parametrize("engine", ["traced", "reference"])
def test_engines_follow_the_device_of_the_recording(recording: Recording, engine: str) -> None:
    names, results = ["T1.leak", "Q1.pump_lag", "h2.sensor_lag"], []
    for device in (torch.device("cpu"), CUDA):
        here = recording.to(device)
        fitting = fdi_torch.set_up(fdi_torch.load_plant("three_tank"), [here], names, "equilibrium", engine)
        low, high = fitting.space.low(here.time), fitting.space.high(here.time)
        theta = (low + 0.3 * (high - low)).expand(3, -1).clone().requires_grad_(True)
        readings = fitting.engines(2.0)[0].readings(theta)
        (slope,) = torch.autograd.grad(readings.square().sum(), theta)
        results.append((readings.detach().cpu(), slope.cpu()))
    for cpu, cuda in zip(*results, strict=True):
        torch.testing.assert_close(cuda, cpu, rtol=1e-9, atol=1e-12)


def test_plant_ode_follows_the_device_of_its_inputs() -> None:
    inputs, levels = torch.tensor([50e-6, 50e-6]).double(), torch.full((3,), 0.3).double()
    plant, time = fdi_torch.load_plant("three_tank"), torch.zeros(())
    there = plant.ode(inputs.to(CUDA), {"T1.leak.size": torch.tensor(0.2, device=CUDA)})(time, levels.to(CUDA))
    torch.testing.assert_close(there.cpu(), plant.ode(inputs, {"T1.leak.size": 0.2})(time, levels))


def test_what_computes_on_the_cpu_takes_recordings_of_a_gpu(recording: Recording, tmp_path: Path) -> None:
    plant, there = fdi_torch.load_plant("three_tank"), recording.to(CUDA)
    assert str(fdi_torch.predict(plant, there)) == str(fdi_torch.predict(plant, recording))
    written = fdi_torch.write_csv(there, tmp_path / "run.csv")
    torch.testing.assert_close(
        fdi_torch.read_recording(written, plant).outputs, recording.outputs, rtol=1e-11, atol=0.0
    )
