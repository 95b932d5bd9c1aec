"""A study on a cluster: the same trials, also where a worker is lost on the way."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator

import pytest

from fdi_torch.config.study_file import load_study
from fdi_torch.study.cluster import connected, each_on, run_on_cluster
from fdi_torch.study.monte_carlo import Trial, run_block, run_blocks
from fdi_torch.study.study_plan import Plan

pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def plan() -> Plan:
    changes = ["trials=16", "block=2", "snr_db=[30]", "evaluations=300", "population=24", "steps=[1 s]", "searches=1"]
    return load_study("configs/studies/table3_noise.yaml", [f"study.{change}" for change in changes]).plan


def every_trial_once(results: Iterator[list[Trial]]) -> dict[int, Trial]:
    trials = [trial for block in results for trial in block]
    found = {trial.number: trial for trial in trials}
    assert len(found) == len(trials)
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_killing_one_of_two_workers_changes_no_trial(plan: Plan) -> None:
    alone = every_trial_once(run_blocks(plan, plan.blocks()))
    with connected("local", workers=2) as client:
        places = [client.scheduler.address, *client.scheduler_info()["workers"]]
        assert len(places) == 3 and all(place.startswith("tcp://127.0.0.1:") for place in places)

        def with_a_murder() -> Iterator[list[Trial]]:
            for k, block in enumerate(each_on(client, run_block, plan.blocks(), plan)):
                if k == 1:
                    victim = next(iter(client.run(os.getpid).values()))
                    os.kill(victim, signal.SIGKILL)
                yield block

        assert every_trial_once(with_a_murder()) == alone
    assert sorted(alone) == list(range(16))


def test_nobody_at_the_address_is_said(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdi_torch.study.cluster.CONNECT_SECONDS", 0.5)
    with pytest.raises(ValueError, match="expected a Dask scheduler at tcp"):
        next(run_on_cluster(plan, plan.blocks(), "tcp://127.0.0.1:1"))


def test_without_dask_it_says_what_to_install(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"pip install 'fdi_torch\[cluster\]'"):
        next(run_on_cluster(plan, plan.blocks(), "local"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_any_work_is_done_once_an_item() -> None:
    with connected("local", workers=1) as client:
        assert sorted(each_on(client, abs, range(-5, 1))) == [0, 1, 2, 3, 4, 5]
        with pytest.raises(ZeroDivisionError):
            list(each_on(client, (1).__truediv__, [0]))
