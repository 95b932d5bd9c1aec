"""The list of deliberate faults fits the source as it is; `make mutants` applies them and runs their tests."""

from __future__ import annotations

import ast
from collections import Counter

import pytest

from tests.mutants import ROOT, Mutant, mutants

ROOMS = ("config", "effects", "estimate", "gap", "logbook", "monitor", "plant", "recordings", "simulate", "study")


@pytest.mark.parametrize("mutant", mutants(), ids=lambda m: f"{m.file}: {m.breaks}")
def test_a_deliberate_fault_is_another_program_and_its_tests_are_there(mutant: Mutant) -> None:
    intact = (ROOT / mutant.file).read_text(encoding="utf-8")
    assert ast.dump(ast.parse(mutant.applied_to(intact))) != ast.dump(ast.parse(intact))
    for test in mutant.tests:
        file, _, name = test.partition("::")
        assert f"def {name.partition('[')[0]}(" in (ROOT / file).read_text(encoding="utf-8")


def test_each_room_of_the_core_has_deliberate_faults() -> None:
    faults = Counter(mutant.file.split("/")[1] for mutant in mutants())
    assert set(faults) == set(ROOMS) and sum(faults.values()) >= 100 and min(faults.values()) >= 5


def test_a_fault_that_the_source_has_outgrown_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one line `x = 1`, got 2"):
        Mutant("", "a.py", "x = 1", "x = 2", []).applied_to("x = 1\nx = 1\n")
