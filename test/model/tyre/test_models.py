# SPDX-License-Identifier: Apache-2.0
"""Each tyre model's parameters stand in its own module and in no other."""

from __future__ import annotations

from pathlib import Path

import pytest

import iwm_power_manager
import iwm_sim
from iwm_power_manager.model import tyre

SOURCES = [path for package in (iwm_power_manager, iwm_sim) for path in Path(package.__path__[0]).rglob("*.py")]
KEYS = [(name, key) for name, model in tyre.MODELS.items() for key in model.ranges]


@pytest.mark.parametrize(("model", "key"), KEYS)
def test_no_other_file_names_a_model_s_parameters(model, key):
    naming = [path.name for path in SOURCES if key in path.read_text()]
    assert naming == [f"{model}.py"]


def test_every_model_is_made_from_its_numbers_and_gives_them_back():
    for name, model in tyre.MODELS.items():
        values = {key: low + 0.3 * (high - low) for key, (low, high) in model.ranges.items()}
        assert tyre.numbers(tyre.make(name, values, 0.5)) == (name, values)
