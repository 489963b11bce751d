# SPDX-License-Identifier: Apache-2.0
"""The page of a fleet: savings of fair places only, and a browser shows it without a complaint."""

import json
import shutil
import subprocess

import pytest

from iwm_power_manager.errors import ConfigError
from iwm_sim.fleet import report
from iwm_sim.fleet.run import runner
from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Car, Road, fingerprint
from iwm_sim.study.report import render

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def row(car, cycle, saving, strategy="sdp", fair=True):
    place = {"key": f"{car} {cycle}", "car": car, "idle_drive": "none", "cycle": cycle, "friction": 0.9}
    return place | {"strategy": strategy, "fair": fair, "saving_percent": saving, "share_changes_per_min": 2.0}


ROWS = [row("a", "x", 1.0), row("a", "y", 3.0), row("b", "x", -1.0), row("b", "y", None, fair=False)]


def test_only_fair_places_count_for_a_saving():
    (made,) = report.savings_of([*ROWS, row("a", "x", 0.0, "equal")])
    assert (made.places, made.fair) == (4, 3)
    assert (made.mean, made.lowest, made.median, made.highest) == (1.0, -1.0, 1.0, 3.0)


def test_cars_stand_by_their_mean_and_a_cell_without_a_fair_place_is_empty():
    found = report.by_car_and_cycle(ROWS, "sdp")
    assert list(found) == ["b, none", "a, none"]
    assert found["a, none"] == {"x": 1.0, "y": 3.0}
    assert found["b, none"]["x"] == -1.0
    assert found["b, none"]["y"] != found["b, none"]["y"]


def test_a_strategy_without_a_fair_place_has_no_saving():
    (made,) = report.savings_of([row("a", "x", None, fair=False)])
    assert (made.places, made.fair) == (1, 0)
    assert made.mean != made.mean


def test_a_folder_without_rows_is_refused(tmp_path):
    store = Store(tmp_path)
    with pytest.raises(ConfigError, match=r"fleet\.json"):
        report.page_of(store)
    store.begin(fingerprint(), [])
    with pytest.raises(ConfigError, match="holds no rows"):
        report.page_of(store)


def test_scenarios_stand_with_what_they_require(tmp_path):
    store = Store(tmp_path)
    car = Car("config/vehicles/jalalmaab_2015.yaml", "drag")
    with runner(store, [], None, 1, 0.0) as running:
        running.run(Road, [Road("config/scenarios/stop_09.yaml", car, "equal")])
    text = render(report.page_of(store)[0])
    assert "Requirements met" in text
    assert "stop_09" in text


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_browser_shows_the_page_without_a_word_on_its_console(serial, tmp_path):
    page = tmp_path / "fleet.html"
    report.make(serial.folder, page, tmp_path / "fleet.png", tmp_path / "fleet.json")
    assert (tmp_path / "fleet.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "fleet.json").read_text())["savings"][0]["places"] == 10
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    options = [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=390,800", "--dump-dom", page.as_uri()]
    run = subprocess.run([*command, *options], capture_output=True, text=True, timeout=120, check=True)
    assert "CONSOLE" not in run.stderr
    for words in ("Savings", "Worst places", "Saving by car and cycle", "jalalmaab_2015, chassis.mass_kg 900, none"):
        assert words in run.stdout
