"""Untrusted YAML: plain values only, a limited number with aliases expanded, in bounded time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdi_torch.config.problems import ConfigError
from fdi_torch.config.yaml_files import parse_yaml, with_overrides, write_yaml
from fdi_torch.untrusted_input import MOST_YAML_BYTES

LEVELS = range(1, 10)
MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in LEVELS)
LISTS = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in LEVELS)
TEXTS = "a0: &a0 {x: 1}\n" + "".join(f"a{i}: &a{i} {{p: *a{i - 1}, q: *a{i - 1}}}\n" for i in range(1, 40))
REFUSED = {
    "merge keys of merge keys": (MERGES, "expected at most 100000 values, aliases spelled out, got more"),
    "lists of lists": (LISTS, "expected at most 100000 values, aliases spelled out, got more"),
    "mappings of mappings": (TEXTS, "expected at most 100000 values, aliases spelled out, got more"),
    "many values": ("a: [" + "1," * 200_000 + "]", "expected at most 100000 values"),
    "within itself": ("a: &a [*a]", "line 1: expected plain values, got *a within itself"),
    "merged into itself": ("a: &a {<<: *a}", "line 1: expected plain values, got *a within itself"),
    "brackets": ("[" * 500_000, "expected YAML of a few levels"),
    "dashes": ("- " * 200_000, "expected YAML of a few levels"),
    "large": ("a: " + "x" * MOST_YAML_BYTES, f"expected at most {MOST_YAML_BYTES} bytes of YAML"),
    "number of many digits": ("a: " + "9" * 400, "line 1: expected a whole number below 2^63"),
    "number of more digits": ("a: " + "9" * 9000, "line 1: expected a number of at most 400 digits"),
    "sixtieths": ("a: 1" + ":59" * 100_000, "line 1: expected a number of at most 400 digits"),
    "no date": ("a: 2026-13-45", "not valid YAML: month must be in 1..12"),
    "tag": ("a: !!python/object/apply:os.system [ls]", "line 1: expected plain values, got the tag"),
    "bytes": ("a: !!binary aGVsbG8=", "line 1: expected plain values, got the tag"),
    "truth that is none": ("a: !!bool x", "line 1: expected plain values, got the tag"),
    "key that is a list": ("a: {[1]: 2}", "line 1: not valid YAML: found unhashable key"),
    "alias": ("*.area: 3 %", 'line 1: not valid YAML: text that begins with * needs quotes, as in "*.area": 3 %'),
    "undefined alias": ("a: *b", "line 1: not valid YAML: text that begins with * needs quotes"),
    "tab": ("a:\n\tb: 1", "line 2: not valid YAML: a line is indented by a tab; indent by spaces"),
    "list": ("[1]", "expected keys and values such as plant: three_tank, got a list"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_yaml_that_is_too_much_is_refused_in_one_sentence(case: str) -> None:
    text, sentence = REFUSED[case]
    with pytest.raises(ConfigError) as error:
        parse_yaml(text.encode(), "plant.yaml")
    assert str(error.value).startswith("plant.yaml: ") and sentence in str(error.value)
    assert len(str(error.value)) < 300 and "\n" not in str(error.value)


def test_a_bomb_costs_neither_time_nor_memory(tmp_path: Path) -> None:
    """In a process that may have 2 GB of addresses and a minute."""
    path = tmp_path / "bomb.yaml"
    path.write_text(MERGES + "tanks: {T1: {area: 1 m^2, height: 1 m}}\n")
    code = (
        "import resource\nresource.setrlimit(resource.RLIMIT_DATA, (2**31, 2**31))\n"
        f"from fdi_torch.cli import main\nraise SystemExit(main(['check', 'x.csv', '--plant', {str(path)!r}]))"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, env=os.environ)
    assert done.returncode == 2 and "expected at most 100000 values" in done.stderr


def test_aliases_and_merge_keys_of_usual_size_are_taken() -> None:
    assert parse_yaml(b"a: &a {b: 1}\nc: *a\nd: {<<: *a, e: 2}", "x") == {
        "a": {"b": 1},
        "c": {"b": 1},
        "d": {"b": 1, "e": 2},
    }
    wide = {f"k{i}": [i, float(i), f"{i} cm", None, True] for i in range(5000)}
    assert parse_yaml(write_yaml(wide).encode(), "x") == wide


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("names.0.low=1", "--set names.0.low=1: names.0: expected keys or a list there, got 'T1.leak'; set it whole"),
        ("names.x=1", "names: expected an index below 1, got 'x'"),
        ("names.²=1", "names: expected an index below 1, got '²'"),
        ("names." + "9" * 5000 + "=1", "names: expected an index below 1"),
        ("seed=" + "9" * 400, "line 1: expected a whole number below 2^63"),
        ("seed=!!set {1}", "line 1: expected plain values, got the tag"),
    ],
)
def test_an_override_that_cannot_be_is_one_sentence(override: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as error:
        with_overrides({"names": ["T1.leak"], "seed": 1}, [override])
    assert sentence in str(error.value) and "\n" not in str(error.value)
