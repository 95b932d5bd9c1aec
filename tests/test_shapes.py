"""The shapes in the signatures of plant, simulate, estimate and study, checked while a share of the tests runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parent
CHECKED = """
import sys

import pytest
import torch
from jaxtyping import TypeCheckError, install_import_hook

sys.path.insert(0, "tests")
install_import_hook([f"fdi_torch.{room}" for room in ("plant", "simulate", "estimate", "study")], "shapes.checked")
from fdi_torch.simulate.scan import scan_in_time

with pytest.raises(TypeCheckError, match="parameter 'b'"):
    scan_in_time(torch.zeros(1, 2, 2, 3), torch.zeros(1, 2, 1, 4), torch.zeros(1, 2, 1))
sys.exit(pytest.main(sys.argv[1:]))
"""
RUN = (
    "test_objectives.py",
    "test_uncertainty.py",
    "test_levenberg_marquardt.py",
    "test_state_noise.py",
    "test_profile_and_draws.py::test_ridge_coordinates_are_undone_exactly_and_have_the_information_of_their_gradient",
    "test_shade.py",
    "test_step_control.py::test_sums_are_those_of_readings_and_jacobian",
    "test_step_control.py::test_a_lane_depends_on_no_neighbour",
    "test_joint_collocation.py::test_each_recording_is_simulated_as_if_it_were_alone",
    "test_study.py::test_bounds_are_those_of_central_differences_at_tight_steps",
    "test_study.py::test_uniform_faults_fill_the_box",
    "test_study.py::test_intervals_hold_the_truth_as_often_as_they_say",
    "test_evolution.py::test_interrupted_search_resumes_bit_for_bit",
)


def test_shapes_in_signatures_are_true_while_tests_run() -> None:
    """In a process of its own, because the checks are put in when a module is imported."""
    parts = [str(TESTS / part) for part in RUN]
    done = subprocess.run(
        [sys.executable, "-c", CHECKED, "-q", "-p", "no:cacheprovider", "-W", "ignore:Module already imported", *parts],
        cwd=TESTS.parent,
        env=os.environ | {"PYTHONPATH": str(TESTS.parent)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
