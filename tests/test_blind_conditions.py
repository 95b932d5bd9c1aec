"""Random flows, level control and random networks of the hidden rigs, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fdi_torch.blind import case_drafts, cases
from fdi_torch.blind.case_drafts import plans
from fdi_torch.blind.cases import make
from fdi_torch.blind.conditions import commands_of_pumps
from fdi_torch.blind.inputs import BAND, LevelControl, draw_control
from fdi_torch.blind.kinds import ON_NETWORKS
from fdi_torch.blind.networks import HIGHEST, LOWEST, Networks, equilibrium, with_unmeasured
from fdi_torch.blind.plants import three_tank
from fdi_torch.blind.random_flows import HOLDS, KINDS, Disturbance, draw_disturbance
from fdi_torch.blind.simulator import Drive, HiddenRigs, conductance, simulate
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank

AREA = 0.016
TANK = PlantDescription("one", (Tank("A", AREA, 1.0),), (), (Pump("Q", "A", 1e-4),), (Sensor("a", "A"),))
DRAINED = replace(TANK, pipes=(Pipe("O", "A", OUTSIDE, 6e-5, 0.6),))


def lag_one(x: np.ndarray) -> float:
    return float(np.mean(x[1:] * x[:-1]) / np.mean(x * x))


@pytest.mark.parametrize(
    ("kind", "time", "expected"), [("white", 1.0, 0.0), ("held", 15.0, 14 / 15), ("slow", 100.0, math.exp(-0.01))]
)
def test_a_disturbance_has_the_size_and_correlation_asked_for(kind: str, time: float, expected: float) -> None:
    values = Disturbance(kind, time, np.array([0.5, 2.0]), 1.0).values(np.random.default_rng(1), 400_000)
    assert values.shape == (400_000, 2)
    np.testing.assert_allclose(values.std(axis=0), [0.5, 2.0], rtol=0.05)
    assert lag_one(values[:, 0]) == pytest.approx(expected, abs=5e-3)


def test_a_held_disturbance_changes_only_at_the_end_of_its_hold() -> None:
    values = Disturbance("held", 60.0, np.ones(1), 1.0).values(np.random.default_rng(2), 150)[:, 0]
    assert np.flatnonzero(np.diff(values)).tolist() == [59, 119]


def test_all_kinds_of_disturbances_are_drawn() -> None:
    drawn = [draw_disturbance(np.random.default_rng(seed), 3) for seed in range(200)]
    assert {d.kind for d in drawn} == set(KINDS)
    assert {d.time for d in drawn if d.kind == "held"} == set(HOLDS)
    assert all(100 <= d.time <= 600 for d in drawn if d.kind == "slow")
    assert 0.3 <= min(d.ratio for d in drawn) < 0.4 and 2.5 < max(d.ratio for d in drawn) <= 3.0


def test_what_disturbances_bring_is_in_the_tank() -> None:
    flows = np.random.default_rng(3).normal(size=(101, 1)) * 1e-5
    drive = Drive(np.full((101, 1), 2e-5), np.array([0.4]), flows)
    level = simulate(HiddenRigs([TANK], [()]), [drive])[0].levels[:, 0]
    brought = np.concatenate(([0.0], np.cumsum(flows[:-1, 0]))) + 2e-5 * np.arange(101)
    np.testing.assert_allclose(AREA * (level - 0.4), brought, atol=1e-14)


def test_disturbances_move_levels_as_far_as_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "STEP", 0.5)
    monkeypatch.setattr(
        case_drafts, "draw_disturbance", lambda rng, tanks: Disturbance("held", 15.0, np.ones(tanks), 1.7)
    )
    (case,) = make(plans(1, 1, ("dnull",)), three_tank(), 1)
    assert case.truth["causes"] == [] and case.truth["gap_rms_m"]["recording"] == 0
    assert case.truth["disturbance"] == {
        "kind": "held",
        "time_s": 15.0,
        "moves_levels_by_noise": pytest.approx(1.7, rel=0.05),
    }


def held(law: str, set_point: float, seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Level and flow of a drained tank under a control."""
    control = LevelControl(law, 0, 0, np.full(seconds + 1, set_point), 2e-5, 9e-5, 0.01, 2e-3, 1e-7)
    drive = Drive(np.zeros((seconds + 1, 1)), np.array([0.2]), control=control, error=np.zeros(seconds + 1))
    (ran,) = simulate(HiddenRigs([DRAINED], [()]), [drive], 0.1)
    return ran.levels[:, 0], ran.asked[:, 0]


def test_a_two_point_control_keeps_the_level_in_its_band() -> None:
    level, flow = held("two_point", 0.1, 2000)
    assert set(np.round(flow[1000:] * 1e6).tolist()) == {20.0, 90.0}
    # Beyond its band by what a second of the largest net flow brings, at most.
    assert np.abs(level[1000:] - 0.1).max() < 0.01 + 9e-5 / AREA


def test_a_proportional_integral_control_comes_to_rest_at_the_set_point() -> None:
    level, flow = held("proportional_integral", 0.1, 3000)
    drained = float(conductance(DRAINED)[0]) * math.sqrt(0.1)
    assert level[-1] == pytest.approx(0.1, abs=5e-4) and flow[-1] == pytest.approx(drained, abs=3e-7)
    np.testing.assert_allclose(flow * 1e7, np.round(flow * 1e7), atol=1e-6)
    np.testing.assert_allclose(commands_of_pumps(DRAINED, flow[:, None])[:, 0], flow * 1e6, atol=1e-9)


def test_a_control_needs_a_measured_tank_with_a_pump() -> None:
    two = PlantDescription("two", (*TANK.tanks, Tank("B", AREA, 1.0)), (), TANK.pumps, (Sensor("b", "B"),))
    with pytest.raises(ValueError, match="expected a pump into a measured tank, got none"):
        draw_control(np.random.default_rng(0), two, [np.zeros((5, 2))], np.ones((1, 2)), np.ones(1))
    (drawn,) = draw_control(np.random.default_rng(0), TANK, [np.linspace(0.2, 0.6, 900)[:, None]], *_limits())
    assert drawn.band == BAND and 0.28 < drawn.set_points.min() < drawn.set_points.max() < 0.52


def _limits() -> tuple[np.ndarray, np.ndarray]:
    return np.array([[1e-5, 9e-5]]), np.array([1e-7])


@pytest.mark.parametrize("seed", range(6))
def test_a_random_network_rests_within_its_tanks(seed: int) -> None:
    rig = Networks(3, 12).rig(np.random.default_rng(seed))
    plant, heights = rig.plant, np.array([t.height for t in rig.plant.tanks])
    assert 3 <= len(plant.tanks) <= 12 and len(plant.pumps) >= 2 and any(p.is_outlet for p in plant.pipes)
    assert len(plant.pipes) >= len(plant.tanks)  # a tree and an outlet at least
    assert (np.array(rig.rest) / heights).min() > LOWEST and (np.array(rig.rest) / heights).max() < HIGHEST


def test_a_network_at_equilibrium_stays_there() -> None:
    plant = Networks(5, 5).rig(np.random.default_rng(7)).plant
    flows = 0.35 * np.array([p.max_flow for p in plant.pumps])
    rest = equilibrium(plant, flows)
    (ran,) = simulate(HiddenRigs([plant], [()]), [Drive(np.tile(flows, (201, 1)), rest)], 0.1)
    np.testing.assert_allclose(ran.levels, np.tile(rest, (201, 1)), atol=1e-5)


def test_networks_of_no_tanks_are_refused() -> None:
    with pytest.raises(ValueError, match="2 <= fewest <= most tanks, got 5 and 3"):
        Networks(5, 3)


def test_rigs_of_other_layouts_run_together_as_alone() -> None:
    rng = np.random.default_rng(8)
    plants = [three_tank().plant, Networks(4, 6).rig(rng).plant]
    drives = [
        Drive(0.3 * np.tile([p.max_flow for p in plant.pumps], (61, 1)), rng.uniform(0.1, 0.6, len(plant.tanks)))
        for plant in plants
    ]
    together = simulate(HiddenRigs(plants, [(), ()]), drives, 0.1)
    for plant, drive, ran in zip(plants, drives, together, strict=True):
        (alone,) = simulate(HiddenRigs([plant], [()]), [drive], 0.1)
        np.testing.assert_array_equal(ran.levels, alone.levels)


def test_a_third_of_the_levels_is_unmeasured() -> None:
    rig = Networks(9, 9).rig(np.random.default_rng(9))
    left = with_unmeasured(rig, 1 / 3, np.random.default_rng(1))
    assert len(left.plant.sensors) == 6 and left.believed.sensors == left.plant.sensors
    assert left.plant.tanks == rig.plant.tanks
    assert len(with_unmeasured(rig, 1.0, np.random.default_rng(1)).plant.sensors) == 1


@pytest.mark.slow
def test_cases_on_networks_are_as_their_kinds_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "STEP", 0.5)
    made = {case.plan.kind: case for case in make(plans(8, 3, ON_NETWORKS), Networks(3, 4), 3)}
    causes = {kind: case.truth["causes"] for kind, case in made.items()}
    assert causes["null"] == causes["dnull"] == [] and len(causes["site"]) in (1, 2)
    assert [c["effect"] for c in causes["law"]] == ["unknown"] and causes["mixed"][-1]["effect"] == "unknown"
    assert len(causes["mixed"]) == 2 and len({c["location"] for c in causes["mixed"]}) == 2
    assert len(made["hidden"].rig.plant.sensors) < len(made["hidden"].rig.plant.tanks)
    assert made["loop"].truth["control"]["law"] and made["dsingle"].truth["disturbance"]["kind"] in KINDS
    for kind, case in made.items():
        heights = {t.name: t.height for t in case.rig.plant.tanks}
        assert not case.truth["over_rim"] and np.isfinite(case.readings[0]).all(), kind
        if kind in ("null", "dnull"):
            shares = case.readings[0] / [heights[s.tank] for s in case.rig.plant.sensors]
            assert shares.min() > LOWEST - 0.05 and shares.max() < HIGHEST + 0.05


@pytest.mark.slow
def test_random_flows_may_act_beside_a_level_control(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "STEP", 0.5)
    (case,) = make(plans(1, 3, ("dloop",)), three_tank(), 3)
    assert case.truth["control"]["law"] and case.truth["disturbance"]["kind"] in KINDS
    assert case.truth["causes"] == [] and case.truth["disturbance"]["moves_levels_by_noise"] > 0.1
