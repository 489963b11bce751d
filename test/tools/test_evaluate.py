# SPDX-License-Identifier: Apache-2.0
"""The command `evaluate`, as a user calls it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from iwm_power_manager.control.settings import DEFAULTS
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_power_manager.tools.command import plain
from iwm_sim.study import cases, reproduce, single, unseen, variants
from iwm_sim.study.content import Study
from iwm_sim.study.frontier import Frontier, Point
from iwm_sim.study.study_figures import Drawn
from iwm_sim.tools import evaluate, evaluate_run

ROOT = Path(__file__).resolve().parents[2]
VEHICLE = "jalalmaab_2015"


def rows_of(path):
    return json.loads(Path(path).read_text())["rows"]


def test_two_strategies_on_a_cycle_give_a_table_and_rows(hill, small_policy, tmp_path, capsys):
    out = tmp_path / "out.json"
    arguments = ["--cycle", str(hill), "--friction", "0.9", "--strategy", "sdp", "--idle-drive", "none"]
    code = evaluate.main([*arguments, "--policy", str(small_policy), "--json", str(out), "--jobs", "1"])
    assert code == 0
    shown = capsys.readouterr().out
    assert "hill, friction 0.9, idle drive none" in shown
    equal, sdp = rows_of(out)
    assert (equal["strategy"], sdp["strategy"]) == ("equal", "sdp")
    assert f"{sdp['wh_per_km']:.2f}" in shown
    assert set(sdp) >= {
        *("cycle", "friction", "strategy", "idle_drive", "delta_soc_percent", "wh_per_km", "distance_m"),
        *("rms_speed_error_mps", "max_speed_error_mps", "trace_held", "min_slip", "max_slip", "locked_s"),
        *("share_changes_per_min", "saving_percent", "share_of_possible"),
        *("settings", "vehicle_hash", "policy_checksum"),
    }
    assert sdp["trace_held"] is True
    assert equal["policy_checksum"] is None


def test_all_combinations_are_driven_and_short_names_resolve(tmp_path):
    out = tmp_path / "out.json"
    cycle = tmp_path / "creep.csv"
    cycle.write_text("time_s,speed_mps,grade\n0,0,0\n2,2,0.02\n6,2,0.02\n8,0,0\n")
    arguments = ["--vehicle", VEHICLE, "--cycle", str(cycle), "--friction", "0.9", "0.5"]
    assert (
        evaluate.main(
            [*arguments, "--idle-drive", "none", "drag", "--strategy", "instantaneous", "--json", str(out), "--quiet"]
        )
        == 0
    )
    seen = [(row["friction"], row["idle_drive"], row["strategy"]) for row in rows_of(out)]
    assert len(seen) == len(set(seen)) == 8


def test_a_cycle_is_driven_with_the_settings_that_the_node_has(hill, tmp_path):
    out = tmp_path / "out.json"
    assert evaluate.main(["--cycle", str(hill), "--strategy", "equal", "--json", str(out), "--quiet"]) == 0
    settings = rows_of(out)[0]["settings"]
    assert {name: settings[name] for name in ("slip_target", "critical_slip", "gate_hysteresis")} == {
        name: getattr(DEFAULTS, name) for name in ("slip_target", "critical_slip", "gate_hysteresis")
    }


def test_json_goes_to_standard_output_where_it_is_asked_to(hill, capsys):
    assert evaluate.main(["--cycle", str(hill), "--strategy", "equal", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["strategy"] == "equal"


@pytest.mark.parametrize("mode", [["--strategy", "equal"], ["--fit-battery", "--idle-drive", "none"]])
def test_a_gap_in_a_cycle_is_said_whatever_is_printed(mode, tmp_path, capsys):
    cycle = tmp_path / "tunnel.csv"
    cycle.write_text("time_s,speed_mps\n0,9\n1,10\n2,10\n62,10\n63,9\n64,9\n")
    assert evaluate.main(["--cycle", str(cycle), *mode, "--json", "-"]) == 0
    assert f"warning: {cycle}: line 5: is 60 s after the one before" in capsys.readouterr().err


def test_a_gap_in_a_scenarios_cycle_is_said(tmp_path, capsys):
    cycle, road = tmp_path / "tunnel.csv", tmp_path / "tunnel.yaml"
    cycle.write_text("time_s,speed_mps\n0,9\n1,10\n2,10\n62,10\n63,9\n64,9\n")
    road.write_text(f"format: 1\nabout: A tunnel.\ncycle: {cycle}\nroad: {{friction: 0.9}}\nuntil: {{time_s: 1}}\n")
    assert evaluate.main(["--scenario", str(road), "--strategy", "equal", "--json", "-"]) == 0
    assert f"warning: {cycle}: line 5: is 60 s after the one before" in capsys.readouterr().err


def test_law_settings_reach_the_law(hill, tmp_path):
    out = tmp_path / "out.json"
    law = ["--gate-mode", "table2", "--no-gate-driving", "--switching-power", "5", "--critical-slip", "0.1"]
    arguments = ["--cycle", str(hill), "--strategy", "instantaneous_slip", "--assumed-friction", "0.5", "--jobs", "1"]
    run = ["--dt", "0.02", "--initial-soc", "0.5", "--noise", "0.1", "0.3", "--seed", "3"]
    assert evaluate.main([*arguments, *law, *run, "--json", str(out), "--quiet"]) == 0
    row = rows_of(out)[1]
    settings = row["settings"]
    assert (settings["gate_mode"], settings["gate_driving"], settings["gate_hysteresis"]) == ("table2", False, 0.0)
    assert settings["strategy"] == "instantaneous_slip"
    assert (settings["switching_power_w"], settings["critical_slip"]) == (5.0, 0.1)
    assert settings["slip_target"] < settings["critical_slip"]
    assert (row["assumed_friction"], row["dt_s"], row["initial_soc"]) == (0.5, 0.02, 0.5)
    assert row["noise"] == {"speed_mps": 0.1, "wheel_radps": 0.3, "seed": 3}


def test_series_are_saved_with_an_array_for_each_signal(hill, tmp_path):
    folder = tmp_path / "series"
    arguments = ["--cycle", str(hill), "--strategy", "equal", "--idle-drive", "drag", "--save-series", str(folder)]
    assert evaluate.main([*arguments, "--quiet"]) == 0
    with np.load(folder / "hill_drag_mu090_equal.npz") as series:
        assert series["speed_mps"].max() == pytest.approx(10.0, abs=0.2)
        assert len(series["time_s"]) == len(series["soc"])


def test_two_frictions_that_are_nearly_one_have_a_file_each(hill, tmp_path):
    arguments = ["--cycle", str(hill), "--friction", "0.9", "0.901", "--strategy", "equal", "--quiet"]
    assert evaluate.main([*arguments, "--save-series", str(tmp_path)]) == 0
    assert len(list(tmp_path.glob("hill_drag_mu*_equal.npz"))) == 2


def test_two_cycles_of_one_name_are_told_apart_or_refused(hill, tmp_path, capsys):
    other = tmp_path / "hill.csv"
    other.write_bytes(hill.read_bytes())
    arguments = ["--cycle", str(hill), str(other), "--strategy", "equal", "--quiet"]
    assert evaluate.main(arguments) == 0
    other.write_bytes(hill.read_bytes() + b"# longer\n")
    cases.cycle_of.cache_clear()
    assert evaluate.main(arguments) == 2
    assert f"--cycle: {hill} and {other} are both called hill" in capsys.readouterr().err


def test_what_stands_saves_nothing(tmp_path, capsys):
    parked = tmp_path / "parked.csv"
    parked.write_text("time_s,speed_mps\n0,0\n20,0\n")
    assert evaluate.main(["--cycle", str(parked), "--strategy", "instantaneous", "--json", "-"]) == 0
    assert [row["saving_percent"] for row in json.loads(capsys.readouterr().out)["rows"]] == [None, None]


def test_the_default_is_our_strategy_beside_equal_split_and_several_values_are_given_either_way(
    hill, small_policy, tmp_path
):
    out = tmp_path / "out.json"
    arguments = ["--cycle", str(hill), "--friction", "0.9", "--friction", "0.5", "--idle-drive", "none", "--quiet"]
    assert evaluate.main([*arguments, "--policy", str(small_policy), "--json", str(out)]) == 0
    seen = [(row["friction"], row["strategy"]) for row in rows_of(out)]
    assert seen == [(mu, name) for mu in (0.9, 0.5) for name in ("equal", "sdp_lookahead")]


def test_every_result_says_what_it_was_made_with(hill, small_policy, tmp_path, capsys):
    arguments = ["--cycle", str(hill), "--idle-drive", "none", "--policy", str(small_policy), "--jobs", "1"]
    assert evaluate.main([*arguments, "--strategy", "sdp", "preview", "--decision-period", "0.1", "--dt", "0.02"]) == 0
    shown = capsys.readouterr().out
    assert "friction 0.9, idle drive none, control at 50 Hz" in shown
    assert f"small {load_policy(small_policy).checksum[:8]}" in shown
    assert "preview: 0 J a move + 20 J for any change" in shown
    assert "split decided every 0.1 s" in shown


def test_the_papers_strategy_has_a_name_a_grid_and_a_period_of_its_own(hill, small_grid, tmp_path, monkeypatch):
    monkeypatch.setitem(variants.VARIANTS, "paper_sdp", variants.VARIANTS["paper_sdp"]._replace(grid=str(small_grid)))
    out = tmp_path / "out.json"
    assert evaluate.main(["--cycle", str(hill), "--strategy", "paper_sdp", "--json", str(out), "--quiet"]) == 0
    row = rows_of(out)[1]
    assert (row["label"], row["strategy"], row["policy_grid"]) == ("paper_sdp", "sdp", "small")
    assert row["settings"]["decision_period_s"] == 0.1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--strategy", "equal", "--policy", "policies"], "--policy: has no effect"),
        (["--strategy", "paper_sdp", "--grid", "fine"], "--grid: has no effect"),
        (["--strategy", "paper_sdp", "--decision-period", "0.02"], "decide every 0.1 s"),
        (["--switching-power", "5"], "--switching-power: has no effect"),
        (["--switching-cost", "5"], "--switching-cost: has no effect"),
        (["--seed", "3"], "there is no --noise"),
        (["--gate-mode", "off", "--no-gate-driving"], "gates nothing"),
        (["--gate-mode", "off", "--critical-slip", "0.1"], "gates nothing"),
        (["--plot", "a.svg"], "--plot: has no effect"),
        (["--strategy", "equal", "--no-solve"], "--no-solve: has no effect"),
        (["--strategy", "instantaneous", "--assumed-friction", "0.5"], "--assumed-friction: has no effect"),
        (["--friction-source", "estimated", "--assumed-friction", "0.5"], "--assumed-friction: has no effect"),
        (["--friction-source", "estimated", "--grid", "fine"], "--grid: has no effect"),
        (["--budgets", "4"], "it is for --frontier"),
        (["--seeds", "4"], "it is for --unseen"),
        (["--study", "out"], "--cycle: has no effect: not with --study"),
        (["--fit-battery", "--dt", "0.02"], "--dt: has no effect: not with --fit-battery"),
        (["--fit-battery", "--friction", "0.9", "0.5"], "--friction: has 2 values; allowed: one here"),
        (["--paper", "3", "--friction", "0.5"], "not with --paper: table 3 is of 0.9"),
    ],
)
def test_an_option_without_effect_is_refused(arguments, words, capsys):
    assert evaluate.main(["--cycle", "nycc", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_a_grid_that_is_asked_for_is_used_or_refused(hill, small_policy, small_grid, capsys):
    arguments = ["--cycle", str(hill), "--idle-drive", "none", "--strategy", "sdp", "--policy", str(small_policy)]
    assert evaluate.main([*arguments, "--grid", str(small_grid), "--quiet"]) == 0
    assert evaluate.main([*arguments, "--grid", "fine"]) == 2
    assert "was solved on grid small, not on fine" in capsys.readouterr().err


@pytest.mark.parametrize(("ending", "begin"), [("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")])
def test_a_figure_is_drawn_alone_as_what_its_name_ends_in(ending, begin, tmp_path, capsys):
    assert evaluate.main(["--figure", "9", "--plot", str(tmp_path / f"nine.{ending}")]) == 0
    assert "Figure 9" in capsys.readouterr().out
    assert (tmp_path / f"nine.{ending}").read_bytes().lstrip().startswith(begin)


def test_a_figure_says_what_it_was_drawn_for(tmp_path, capsys):
    assert evaluate.main(["--figure", "8", "--plot", str(tmp_path / "eight.svg")]) == 0
    assert "idle drive none" in capsys.readouterr().out
    assert "idle drive none" in (tmp_path / "eight.svg").read_text()  # matplotlib notes each text in a comment


def test_a_figure_refuses_what_it_does_not_heed(capsys):
    assert evaluate.main(["--figure", "9", "--policy", "policies", "--plot", "nine.svg"]) == 2
    assert "--policy: has no effect: not with --figure 9" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "words"), [("11", "a flow chart"), ("4", "the tyre's formula")])
def test_a_figure_without_a_result_is_refused_with_what_it_shows(name, words, capsys):
    with pytest.raises(SystemExit):
        evaluate.main(["--figure", name, "--plot", "a.svg"])
    assert f"figure {name} is {words}" in capsys.readouterr().err


def test_what_a_figure_draws_is_there_as_numbers(capsys):
    assert evaluate.main(["--figure", "10", "--json", "-"]) == 0
    drawn = json.loads(capsys.readouterr().out)
    assert "Figure 10" in drawn["title"] and "idle drive none" in drawn["note"]
    assert [panel["curves"][0]["label"] for panel in drawn["panels"]] == ["1 kW", "5 kW", "10 kW"]
    for panel in drawn["panels"]:
        assert (panel["x"], panel["y"]) == ("Power of the front axle, kW", "ΔSoC per step, %")
        curve = panel["curves"][0]
        assert len(curve["x"]) == len(curve["y"]) > 20
        assert f"{max(curve['x']):.2g} kW" == curve["label"]


def test_a_map_of_a_figure_has_its_values_between_its_edges(tmp_path):
    figure, axes = plt.subplots()
    axes.pcolormesh([0, 1, 2], [5, 6], [[0.25, 0.75]])
    (panel,) = Drawn("a_map", "A map", "", figure).data()
    (drawn,) = plain(panel)["maps"]
    assert drawn == {"x": [0, 1, 2], "y": [5, 6], "values": [[0.25, 0.75]]}


def test_a_figure_needs_a_file(capsys):
    assert evaluate.main(["--figure", "9"]) == 2
    assert "--plot: is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("SDP", "did you mean sdp (the share of the solved policy, looked up in its table) or paper_sdp (the paper's"),
        ("GRDP", "did you mean rule (a straight line"),
    ],
)
def test_a_strategy_by_the_papers_name_is_answered_with_those_it_may_be_and_what_they_are(given, words, capsys):
    with pytest.raises(SystemExit):
        evaluate.main(["--cycle", "nycc", "--strategy", given])
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("table", "printed"),
    [
        (
            "5",
            {
                "cycle": "nycc",
                "friction": 0.2,
                "delta_soc_percent": {"ED": 3.41, "GRDP": 3.4, "SDP": 2.64},
                "saving_percent": 22.58,
            },
        ),
        ("6", {"cycle": "nycc", "SDP": 1.58, "with_skid_avoidance": 0.32}),
    ],
)
def test_the_json_of_a_table_of_the_paper_has_what_the_paper_prints(table, printed, hill, monkeypatch, capsys):
    monkeypatch.setattr(single, "paper_table", lambda *_: [])
    assert evaluate.main(["--paper", table, "--cycle", "nycc", str(hill), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["printed"] == [printed]


def stopped(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        (["--study"], (reproduce, "Policies")),
        (["--cycle", "nycc", "--frontier"], (unseen, "budgets_of")),
        (["--unseen"], (evaluate_run, "on_all_cores")),
        (["--cycle", "nycc", "--strategy", "equal", "--save-series"], (evaluate_run, "drive_all")),
    ],
)
def test_what_is_stopped_leaves_no_folder_but_that_of_the_user(arguments, place, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(*place, stopped)
    assert evaluate.main([*arguments, str(tmp_path / "runs" / "out")]) == 130
    assert "nothing half-written is left" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    (tmp_path / "runs" / "out").mkdir(parents=True)
    assert evaluate.main([*arguments, str(tmp_path / "runs" / "out")]) == 130
    assert (tmp_path / "runs" / "out").is_dir()


@pytest.mark.nightly
@pytest.mark.parametrize("table", ["3", "6"])
def test_a_cell_of_the_papers_tables_is_that_of_the_study(table, tmp_path, capsys):
    out = tmp_path / "table.json"
    assert evaluate.main(["--paper", table, "--cycle", "nycc", "--idle-drive", "none", "--json", str(out)]) == 0
    shown = capsys.readouterr().out
    assert {"ED", "ours"} <= {row["label"] for row in rows_of(out)}
    stored = Study.load(ROOT / "docs" / "study.json")
    (ours,) = (row for row in stored.cells if row.place == ("nycc", 0.9, "none") and row.label == "ours")
    assert f"{ours.metrics.delta_soc_percent:.3f}" in shown
    assert "paper_sdp" in shown and "coupled" in shown


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "--cycle: is missing"),
        (["--cycle", "no_such_cycle"], "no_such_cycle: cannot be read"),
        (["--cycle", "nycc", "--vehicle", "no_such_car"], "no_such_car: cannot be read"),
        (["--cycle", "nycc", "--policy", "no_such_folder"], "neither a policy file nor a folder"),
        (["--cycle", "nycc", "--strategy", "preview", "--switching-cost", "1", "--dt", "0.013"], "does not divide"),
        (["--cycle", "nycc", "--strategy", "equal", "--save-series", "/dev/null/x"], "cannot be created"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, words, capsys):
    assert evaluate.main(arguments) == 2
    captured = capsys.readouterr()
    errors = [line for line in captured.err.splitlines() if line.startswith("evaluate: error")]
    assert len(errors) == 1
    assert words in errors[0]


@pytest.mark.parametrize(
    "arguments", [["--friction", "3"], ["--friction", "nan"], ["--dt", "1"], ["--jobs", "0"], ["--strategy", "magic"]]
)
def test_a_value_out_of_range_is_refused_with_its_range(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        evaluate.main(["--cycle", "nycc", *arguments])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert "allowed" in error or "choose from" in error


def test_the_command_runs_as_a_process(hill, tmp_path):
    out = tmp_path / "out.json"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "iwm_sim.tools.evaluate", "--cycle", str(hill), "--json", str(out)]
    made = subprocess.run(
        [*command, "--strategy", "equal", "instantaneous"], env=environment, capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr
    assert len(rows_of(out)) == 2
    assert "Traceback" not in made.stderr


def test_the_battery_fit_prints_its_estimates_and_draws(hill, tmp_path, capsys):
    picture, out = tmp_path / "fit.svg", tmp_path / "fit.json"
    arguments = ["--fit-battery", "--cycle", str(hill), "--plot", str(picture), "--json", str(out)]
    assert evaluate.main(arguments) == 0
    assert "0.063 ohm" in capsys.readouterr().out
    assert picture.read_text().lstrip().startswith("<?xml")
    assert json.loads(out.read_text())["plant"]["resistance_ohm"] > 0.0


def test_scenarios_are_driven_with_each_strategy_and_say_what_they_require(tmp_path, capsys):
    scenario = tmp_path / "short_stop.yaml"
    scenario.write_text(
        "format: 1\nabout: A short stop.\nstart: {speed_mps: 5.0}\ndemand: [{from_s: 0.1, brake: 0.5}]\n"
        "road: {friction: 0.9}\nuntil: {time_s: 4.0, standstill: true}\n"
        "require: {stopping_distance_m: {at_most: 20.0}, stopping_time_s: {at_most: 0.1}}\n"
    )
    rows = tmp_path / "rows.json"
    given = ["--scenario", str(scenario), "--strategy", "equal", "instantaneous", "--json", str(rows)]
    assert evaluate.main(given) == 1
    out = capsys.readouterr().out
    assert out.count("FAIL  short_stop: A short stop.") == 2
    found = json.loads(rows.read_text())
    assert [row["strategy"] for row in found] == ["equal", "instantaneous"]
    assert not found[0]["passed"]
    assert found[0]["values"]["stopping_distance_m"] < 20.0
    met = tmp_path / "met.yaml"
    met.write_text(scenario.read_text().replace("at_most: 0.1", "at_most: 3.0"))
    assert evaluate.main(["--scenario", str(met), "--strategy", "equal", "--quiet"]) == 0
    assert evaluate.main(["--scenario", str(met), str(scenario), "--strategy", "equal", "--quiet"]) == 1


def test_a_strategy_that_knows_the_future_drives_no_scenario(capsys):
    assert evaluate.main(["--scenario", "split_stop", "--strategy", "preview"]) == 2
    assert "preview drives no scenario" in capsys.readouterr().err


def test_a_cars_name_leads_no_picture_out_of_its_folder(hill, tmp_path, monkeypatch):
    car = tmp_path / "car.yaml"
    text = share_path("config/vehicles/jalalmaab_2015.yaml").read_text()
    car.write_text(text.replace("name: jalalmaab_2015", "name: ../outside"))
    rival = Point("instantaneous_slip", 60.0, 0.41, 5.5, 6.5, 4.4, 7, True)
    monkeypatch.setattr(unseen, "budgets_of", lambda place, *_: Frontier(place.label, "made", (rival,), (rival,), ()))
    folder = tmp_path / "frontier"
    assert evaluate.main(["--frontier", str(folder), "--cycle", str(hill), "--vehicle", str(car)]) == 0
    assert [path.parent for path in tmp_path.rglob("*.svg")] == [folder]


def test_a_frontier_is_printed_drawn_and_written_with_what_it_was_made_with(hill, tmp_path, monkeypatch, capsys):
    rival = Point("instantaneous_slip", 60.0, 0.41, 5.5, 6.5, 4.4, 7, True)
    ours = Point("sdp_lookahead", 8.0, 0.47, 5.2, 6.1, 4.3, 7, True, "coupled 12345678")
    made_with = "friction 0.9, idle drive drag, control at 100 Hz, split decided every 0.02 s"
    monkeypatch.setattr(unseen, "budgets_of", lambda place, *_: Frontier(place.label, made_with, (rival,), (ours,), ()))
    out = tmp_path / "out.json"
    assert evaluate.main(["--frontier", str(tmp_path), "--cycle", str(hill), "--json", str(out)]) == 0
    shown = capsys.readouterr().out
    assert f"jalalmaab_2015 on hill, {made_with}" in shown
    assert [line.split() for line in shown.splitlines() if line.startswith(("instantaneous_slip ", "sdp_look"))] == [
        ["instantaneous_slip", "60", "W", "5.5", "6.5", "4.4", "7", "0.410", "held"],
        ["sdp_lookahead", "8", "a", "minute", "5.2", "6.1", "4.3", "7", "0.470", "held", "coupled", "12345678"],
    ]
    (cell,) = json.loads(out.read_text())["cells"]
    assert cell["made_with"] == made_with and cell["ours"][0]["policy"] == "coupled 12345678"
    picture = next(tmp_path.glob("*.svg")).read_text()
    assert made_with in picture and "coupled 12345678" in picture
