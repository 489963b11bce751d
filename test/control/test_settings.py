# SPDX-License-Identifier: Apache-2.0
"""The law's settings as people give them: by name, within their ranges, and together."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control import settings
from iwm_power_manager.control.settings import DEFAULTS, TABLE
from iwm_power_manager.errors import ConfigError


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("critical_slip", "0.25", 0.25),
        ("gate_mode", "table2", settings.GATE_MODE_TABLE2),
        ("gate_driving", "true", True),
        ("gate_driving", "false", False),
    ],
)
def test_a_setting_is_given_as_text(name, text, value):
    assert settings.parse("--set", name, text) == value
    assert settings.from_shown({name: settings.shown(name, value), "other": 1}) == {name: value}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("critical_slip", "much", "'much' is not allowed"),
        ("critical_slip", "nan", "'nan' is not allowed"),
        ("critical_slip", "7", "'7' is not allowed"),
        ("gate_mode", "2", "'2' is not allowed"),
        ("gate_driving", "yes", "'yes' is not allowed"),
        ("grip", "1", "is no setting of the law"),
    ],
)
def test_what_is_not_allowed_is_refused_with_what_is(name, text, words):
    with pytest.raises(ConfigError) as caught:
        settings.parse("--set", name, text)
    assert words in str(caught.value)
    allowed = TABLE[name].allowed() if name in TABLE else "critical_slip"
    assert allowed in str(caught.value)


@pytest.mark.parametrize("value", [math.nan, True, "0.2", -1.0])
def test_a_number_is_a_number_in_its_range(value):
    assert "is not allowed" in settings.problem_with(TABLE["critical_slip"], value)


@pytest.mark.parametrize(("small", "large"), settings.ORDERED)
def test_of_two_that_depend_on_each_other_the_first_is_at_most_the_second(small, large):
    values = DEFAULTS._asdict()
    assert settings.check_together(values) == ""
    assert settings.check_together(values | {small: values[large]}) == ""
    problem = settings.check_together(values | {small: 2.0 * values[large]})
    assert problem.startswith(f"{small}: ")
    assert f"at most {large} = " in problem


def test_settings_are_shown_as_they_are_given():
    given = DEFAULTS._replace(gate_mode=settings.GATE_MODE_TABLE2, gate_driving=False, critical_slip=0.25)
    there = settings.as_shown(given)
    assert (there["gate_mode"], there["gate_driving"], there["critical_slip"]) == ("table2", False, 0.25)
    assert DEFAULTS._replace(**settings.from_shown(there)) == given
