"""The key reference is complete, and each of its keys is accepted in a file."""

from __future__ import annotations

import pytest

from fdi_torch.config.key_reference import config_reference, keys
from fdi_torch.config.plant_file import PlantConfig
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.run_file import RunConfig, load_run

RUN = {path: (default, meaning) for path, default, meaning in keys(RunConfig)}


def test_keys_of_all_depths_are_there_with_default_and_meaning() -> None:
    assert RUN["seed"] == ("0", "seed of all random numbers")
    assert RUN["simulate.duration"] == ("1000.0", "length of the recording, s")
    assert RUN["recordings.N.columns.NAME.unit"][0] == "none"
    assert RUN["recordings.N.file"][0] == "required"
    assert RUN["estimate.search.strategy"][0] == "l-shade"


@pytest.mark.parametrize("path", [p for p in RUN if p.startswith("estimate.search.")])
def test_every_key_is_known_to_the_models(path: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_run(overrides=[f"{path}=[wrong]"])
    assert "known key" not in str(error.value)


def test_reference_has_one_line_a_key() -> None:
    lines = config_reference(PlantConfig).splitlines()
    assert len(lines) == len(list(keys(PlantConfig)))
    assert any(line.split()[:2] == ["pipes.NAME.discharge_coefficient", "[required]"] for line in lines)
