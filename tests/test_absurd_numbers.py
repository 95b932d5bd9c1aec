"""Sizes and steps that no rig and no recording has are refused in a sentence, before anything is simulated."""

from __future__ import annotations

import pytest

from fdi_torch.config.problems import ConfigError
from fdi_torch.config.run_file import load_run
from fdi_torch.config.study_file import load_study
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.jobs.train import train
from tests.test_gap import nominal_plant, recorded


def test_a_simulated_fault_lies_within_its_range(tmp_path: pytest.TempPathFactory) -> None:
    run = load_run(overrides=["simulate.faults={T1.leak: 1e11}", f"output.folder={tmp_path}"])
    with pytest.raises(ConfigError, match=r"simulate.faults.T1.leak: expected a size from 0 to 1, got 1e\+11"):
        train(run)


def test_a_step_of_a_diagnosis_lies_within_the_recording() -> None:
    with pytest.raises(ValueError, match=r"step: expected one within the 99 s recorded, got 1e\+18 s"):
        diagnose(nominal_plant(), recorded({}, 1, samples=100), settings=Settings(step=1e18))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (["study.trials=10000000"], "expected at most 4096 settings and 1000000 trials in all, got 1 settings"),
        (["study.steps=[1e9 s]"], "expected steps within the"),
        (
            [
                "study.faults=modes",
                "estimate.parameters=["
                + ",".join(
                    f"{t}.{e}"
                    for t in ("T1", "T2", "T3")
                    for e in ("leak", "area", "area_taper", "internal_body", "evaporation")
                )
                + "]",
            ],
            "expected at most 4096 settings",
        ),
    ],
)
def test_a_study_has_no_more_trials_than_are_drawn_in_seconds(changes: list[str], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        load_study("configs/studies/random_faults.yaml", changes)
