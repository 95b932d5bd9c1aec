"""Every public name exists, and the package loads without torch."""

from __future__ import annotations

import inspect
import pydoc
import subprocess
import sys

import pytest
import torch

import fdi_torch


@pytest.mark.parametrize("name", fdi_torch.__all__)
def test_public_names_are_there(name: str) -> None:
    found = getattr(fdi_torch, name)
    assert found.__name__.removeprefix("fdi_torch.") == name if name != "EFFECTS" else len(found) > 20
    assert callable(found) or name == "EFFECTS"


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = fdi_torch.nonsense


def test_loading_the_package_does_not_load_torch() -> None:
    code = "import sys, fdi_torch; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("before", ["", "import fdi_torch.gap.answer, fdi_torch.simulate.build, fdi_torch.effects"])
def test_a_package_with_a_function_s_name_is_both(before: str) -> None:
    """Whichever is asked for first, the package or the function."""
    code = f"""
{before}
import inspect
from fdi_torch import effects, gap, simulate
import fdi_torch
import fdi_torch.gap.answer as answer
assert "recordings" in inspect.signature(gap).parameters and fdi_torch.gap is gap
assert "holdouts" in gap.__doc__
assert len(effects()) == len(effects.EFFECTS) and fdi_torch.gap.answer is answer
assert fdi_torch.simulate.experiment.Experiment
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["gap", "train", "monitor", "simulate", "study", "report", "effects"])
def test_help_of_a_function_with_a_package_s_name_begins_with_its_signature(name: str) -> None:
    function = getattr(fdi_torch, name)
    first, empty, said, *_ = pydoc.getdoc(function).splitlines()
    assert first.startswith(f"{name}(") and all(p in first for p in inspect.signature(function).parameters)
    assert "'Any" not in first and not empty and said
    assert f"fdi_torch.{name} - {first}" in pydoc.plain(pydoc.render_doc(function))


def test_public_names_are_completed() -> None:
    assert set(fdi_torch.__all__) <= set(dir(fdi_torch))


def test_tensors_in_tensors_out() -> None:
    plant = fdi_torch.load_plant("three_tank")
    rest = fdi_torch.equilibrium(fdi_torch.build_network(plant), torch.tensor([50e-6, 50e-6], dtype=torch.float64))
    time = torch.arange(601, dtype=torch.float64)
    inputs = torch.full((601, 2), 50e-6, dtype=torch.float64)
    names = ("T1.leak.size", "P13.plugging.size")
    blank = fdi_torch.Recording(
        time, inputs, torch.full((601, 3), torch.nan), ("Q1", "Q2"), ("h1", "h2", "h3"), ("m^3/s",) * 2, ("m",) * 3
    )
    fitting = fdi_torch.set_up(plant, [blank], names, "equilibrium")
    engine = fitting.engines(1.0)[0]
    truth = torch.tensor([[0.2, 0.3]], dtype=torch.float64)
    readings = engine.readings(truth)[0]
    assert torch.allclose(readings[0], rest, atol=1e-6)
    seen = fdi_torch.Recording(time, inputs, readings, ("Q1", "Q2"), ("h1", "h2", "h3"), ("m^3/s",) * 2, ("m",) * 3)
    found = fdi_torch.estimate_parameters(fdi_torch.set_up(plant, [seen], names, "equilibrium"))
    assert torch.allclose(found.estimate.value, truth[0], atol=1e-4)
