# SPDX-License-Identifier: Apache-2.0
"""The package from Python, as the documentation shows it."""

import re
from pathlib import Path

import numpy as np
import pytest

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_sim import api
from iwm_sim.closed_loop import COLUMNS

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def car():
    return api.load_car("jalalmaab_2015", idle_drive="drag")


@pytest.fixture(scope="module")
def bank(car):
    return api.load_bank("policies", car)


def test_the_bank_gives_the_policy_the_power_manager_takes(bank):
    assert sorted(policy.friction for policy in bank.policies) == [0.2, 0.5, 0.9]
    assert bank.nearest(0.45).friction == 0.5


def test_a_share_map_has_the_axes_of_its_policy_and_a_picture(bank):
    policy = bank.nearest(0.9)
    power_w, speed_mps, share = api.share_map(policy, previous_share=1.0)
    assert share.shape == (power_w.size, speed_mps.size)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    assert not np.array_equal(share, api.share_map(policy, previous_share=0.0)[2])
    figure = api.plot_share(policy)
    assert figure.axes[0].get_ylabel() == "Power demand, kW"
    assert "idle drive drag" in figure.axes[0].get_title()
    with pytest.raises(ConfigError, match="previous_share: 5 is out of range; allowed: 0 to 1"):
        api.plot_share(policy, previous_share=5)


def test_a_printed_policy_is_one_line_that_says_which_it_is(bank):
    policy = bank.nearest(0.9)
    (line,) = repr(policy).splitlines()
    for said in ("jalalmaab_2015", "idle drive drag", "friction 0.9", policy.problem.name, policy.checksum[:12]):
        assert said in line
    assert len(line) < 200


def test_a_drive_gives_metrics_a_saving_and_a_frame(car, bank):
    ours = api.drive("nycc", car, 0.9, bank.nearest(0.9), until_s=60.0)
    equal = api.drive("nycc", car, 0.9, strategy="equal", until_s=60.0)
    assert (ours.strategy, equal.strategy) == ("sdp_lookahead", "equal")
    assert ours.saving_percent(equal) > 0.0
    assert np.isnan(ours.saving_percent(api.drive("nycc", car, 0.9, until_s=50.0)))
    with pytest.raises(IwmError, match=r"one drive has friction 0\.9, the other 0.5"):
        ours.saving_percent(api.drive("nycc", car, 0.5, until_s=60.0))
    with pytest.raises(IwmError, match="one drive has cycle nycc, the other udds"):
        ours.saving_percent(api.drive("udds", car, 0.9, until_s=60.0))
    assert set(ours.columns()) == set(COLUMNS)
    pd = pytest.importorskip("pandas")
    frame = ours.frame()
    assert isinstance(frame, pd.DataFrame)
    assert frame.index.name == "time_s"
    np.testing.assert_array_equal(frame["speed_mps"], ours.run["speed_mps"])


def test_bad_input_is_one_line(car, bank):
    with pytest.raises(ConfigError, match="magic"):
        api.drive("nycc", car, 0.9, strategy="magic")
    with pytest.raises(ConfigError, match="sdp needs one"):
        api.drive("nycc", car, 0.9, strategy="sdp")
    other = api.load_car("jalalmaab_2015", idle_drive="none")
    with pytest.raises(IwmError, match="was solved for"):
        api.drive("nycc", other, 0.9, bank.nearest(0.9))


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ({"friction": 9}, "friction: 9 is out of range"),
        ({"soc": 8.0}, "soc: 8.0 is out of range"),
        ({"dt_s": -1}, "dt_s: -1 is out of range"),
        ({"untils": 3}, "until_s"),
        ({"strategy": "preview"}, "knows the whole cycle"),
        ({"strategy": "rule"}, "rule: has 0 numbers"),
        ({"settings": default_settings()._replace(decision_period_s=-1.0)}, "decision_period_s: -1.0 is not allowed"),
        ({"settings": default_settings()._replace(slip_target=0.5)}, "slip_target"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_one_line(car, what, said):
    with pytest.raises(IwmError, match=re.escape(said)) as error:
        api.drive("nycc", car, **{"friction": 0.9, "strategy": "equal", **what})
    assert "\n" not in str(error.value)


def test_a_car_may_be_named(car):
    named, loaded = (api.drive("nycc", which, 0.9, until_s=20.0) for which in ("jalalmaab_2015", car))
    assert named.metrics == loaded.metrics


def test_a_rule_drives_by_its_coefficients(car):
    front = api.drive("nycc", car, 0.9, strategy="rule", rule=(0.0, 1.0, 0.0, 1.0), until_s=60.0)
    equal = api.drive("nycc", car, 0.9, strategy="equal", until_s=60.0)
    assert front.run["front_power_w"].max() > 1.5 * equal.run["front_power_w"].max()


def test_the_page_names_every_column_of_a_frame():
    page = (DOCS / "python.md").read_text()
    rows = re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} | {"time_s"} == set(COLUMNS)


@pytest.mark.parametrize("page", ["solver.md", "python.md"])
def test_what_the_pages_show_runs(page, tmp_path, monkeypatch):
    snippets = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)
    assert snippets
    monkeypatch.chdir(tmp_path)
    for snippet in snippets:
        exec(compile(snippet, page, "exec"), {})
