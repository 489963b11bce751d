# SPDX-License-Identifier: Apache-2.0
"""import_motor: tables in rpm, percent, matrix layout, with decimal commas and behind a gear become a map."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from iwm_power_manager.motor_map import read_map
from iwm_power_manager.share import share_path
from iwm_power_manager.tools.import_motor import main

MAP = share_path("config/motors/siemens_pm_7500w.csv")
WHOLE = read_map(MAP)
RPM = 60.0 / (2.0 * math.pi)
DEMANDS = ("--peak-torque", 300, "--regeneration-torque", 80, "--max-power", 7500, "--top-speed", 200)


def efficiency(i, j):
    power = WHOLE.speed_radps[i] * WHOLE.torque_nm[j]
    return power / (power + WHOLE.loss_w[i, j])


def points():
    """Speed, torque and efficiency of the shipped map."""
    for i, w in enumerate(WHOLE.speed_radps):
        for j, t in enumerate(WHOLE.torque_nm):
            yield float(w), float(t), float(efficiency(i, j))


def run(capsys, *arguments):
    """Exit code, stdout and stderr of the command."""
    code = main([str(x) for x in arguments])
    return code, *capsys.readouterr()


def same(path, speed=1.0, torque=1.0):
    """Whether a written map is the shipped one, its axes scaled."""
    found = read_map(path)
    np.testing.assert_allclose(found.speed_radps, WHOLE.speed_radps * speed, rtol=1e-6)
    np.testing.assert_allclose(found.torque_nm, WHOLE.torque_nm * torque, rtol=1e-6)
    np.testing.assert_allclose(found.loss_w, WHOLE.loss_w, rtol=1e-4)


def test_a_list_in_rpm_and_percent(tmp_path, capsys):
    table = tmp_path / "sheet.csv"
    table.write_text("n/rpm,T/Nm,eta\n" + "".join(f"{w * RPM:.8f},{t},{100 * e:.8f}\n" for w, t, e in points()))
    options = ("--plot", tmp_path / "map.png", "--json", tmp_path / "map.json")
    code, out, err = run(capsys, table, "--output", tmp_path / "map.csv", *options)
    assert (code, err) == (0, "")
    assert "speeds in rpm, as the header says" in out
    assert "efficiencies in percent: most are above 1.5" in out
    assert "loss model: 46 + 0.69 w + 0.0151 w^2 + 2.03 |T| + 0.0685 T^2 W" in out
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "map.json").read_text())["best_efficiency"]["speed_radps"] == pytest.approx(150.0)
    same(tmp_path / "map.csv")
    out = run(capsys, table, "--output", tmp_path / "map.csv", "--json", "-")[1]
    assert json.loads(out) == json.loads((tmp_path / "map.json").read_text())


@pytest.mark.parametrize("down", ["speed", "torque"])
def test_a_matrix_with_decimal_commas_behind_a_gear(tmp_path, capsys, down):
    speeds, torques = WHOLE.speed_radps * 9.0, WHOLE.torque_nm / 9.0
    grid = np.array([[efficiency(i, j) for j in range(torques.size)] for i in range(speeds.size)])
    side, top, cells = (speeds, torques, grid) if down == "speed" else (torques, speeds, grid.T)
    lines = ["w\\\\T;" + ";".join(f"{x:.9f}" for x in top)]
    lines += [f"{x:.9f};" + ";".join(f"{e:.9f}" for e in row) for x, row in zip(side, cells, strict=True)]
    table = tmp_path / "sheet.csv"
    table.write_text("\n".join(lines).replace(".", ",") + "\n")
    options = ("--layout", "matrix", "--down", down, "--gear", 9, "--speed-unit", "rad/s")
    code, out, _ = run(capsys, table, "--output", tmp_path / "map.csv", *options)
    assert code == 0
    assert "decimal commas" in out
    same(tmp_path / "map.csv")


def test_units_of_both_axes_stand_in_the_corner_of_a_matrix(tmp_path, capsys):
    lines = ["torque_nm\\speed_rpm," + ",".join(f"{w * RPM:.9f}" for w in WHOLE.speed_radps)]
    for j, t in enumerate(WHOLE.torque_nm):
        lines.append(f"{t}," + ",".join(f"{efficiency(i, j):.9f}" for i in range(WHOLE.speed_radps.size)))
    table = tmp_path / "sheet.csv"
    table.write_text("\n".join(lines) + "\n")
    code, out, err = run(capsys, table, "--output", tmp_path / "map.csv", "--down", "torque")
    assert (code, err) == (0, "")
    assert "speeds in rpm, as the header says" in out
    same(tmp_path / "map.csv")
    code, out, err = run(capsys, table, "--output", tmp_path / "again.csv")
    assert (code, err) == (0, "")
    assert r"torques down: the corner says 'torque_nm\speed_rpm'" in out
    same(tmp_path / "again.csv")
    err = run(capsys, table, "--output", tmp_path / "map.csv", "--down", "speed")[2]
    assert r"although the corner says 'torque_nm\speed_rpm'" in err


def test_losses_become_efficiencies(tmp_path, capsys):
    table = tmp_path / "sheet.tsv"
    rows = [(w, t, w * t / e - w * t) for w, t, e in points()]
    table.write_text("rad/s\tNm\tW\n" + "".join("\t".join(f"{x:.9f}" for x in row) + "\n" for row in rows))
    assert run(capsys, table, "--output", tmp_path / "map.csv", "--quantity", "loss", "--quiet")[:2] == (0, "")
    same(tmp_path / "map.csv")


def test_losses_in_kw_are_warned_of(tmp_path, capsys):
    rows = "".join(f"{w},{t},{1e-3 * (w * t / e - w * t)}\n" for w, t, e in points())
    (tmp_path / "sheet.csv").write_text("speed,torque,loss\n" + rows)
    code, _, err = run(capsys, tmp_path / "sheet.csv", "--output", tmp_path / "map.csv", "--quantity", "loss")
    assert code == 0
    assert "half of its efficiencies are above 0.99: losses in kW?" in err


def test_what_the_map_lacks_of_what_the_motor_shall_do_is_said(tmp_path, capsys):
    code, _, err = run(capsys, MAP, "--output", tmp_path / "map.csv", *DEMANDS)
    assert code == 0
    assert "it lacks speeds from 150 to the 200 rad/s" in err
    assert "it lacks torques from 200 to the peak torque, 300 N m" in err
    assert "it lacks torques from 0 to the regeneration torque" in err
    assert "regeneration" not in run(capsys, MAP, "--output", tmp_path / "map.csv", *DEMANDS, "--mirror")[2]


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("", (), "is empty"),
        ("w,t,eta\n1,2\n", ("--layout", "list"), "line 2: has 2 values; allowed: 3: speed, torque, value"),
        ("w,t,eta\n1,x,0.5\n", (), "line 2, torque_nm: 'x' is no number"),
        (
            "Efficiency,Torque,Speed\n0.5,1,2\n",
            (),
            "line 1: 'Efficiency' is not the last column; allowed: speed, torque",
        ),
        (
            "Speed,Eta,Torque\n1,0.5,2\n",
            (),
            "line 1: 'Eta' is not the last column; allowed: speed, torque",
        ),
        ("w,t,eta\n1,2,0.5\n1,2,0.6\n", (), "line 3: repeats speed 1, torque 2"),
        ("w,t,eta\n1,2,300\n", (), "line 2: efficiency 3 is out of range"),
        ("w,t,eta\n1,2,85\n2,3,0.5\n", ("--no-percent",), "line 2: efficiency 85 is out of range; allowed: 0 to 1, or"),
        ("w,t,loss\n1,2,-3\n", ("--quantity", "loss"), "loss -3 W is out of range"),
        ("w,t,eta\n-1,2,0.3\n", (), "speed_rad_s -1 is out of range"),
        ("w,1,2\n1,0.5,0.5,0.5\n", ("--layout", "matrix"), "line 2: has 3 values; allowed: 2, as in line 1"),
        (
            "speed_mps,t,a,b\n1,2,3,4\n",
            (),
            "is no number (taken for a matrix, as it has 4 columns); allowed: for a list three columns: speed, torque",
        ),
        ("w,t,eta\n1,2,nan\n2,3,nan\n", (), "has no efficiency above 0 where speed and torque are not 0"),
        (
            "w,t,eta\n1,2,0.8\n2,-2,4.1\n2,2,0.9\n",
            (),
            "efficiency 4.1 is out of range; allowed: 0 to 1 (braking:",
        ),
        ("w,t,loss W\n1,2,46\n", (), "the header says 'loss W'; allowed: efficiencies, or --quantity loss"),
        ("w,t,loss kW\n1,2,4\n", ("--quantity", "loss"), "'loss kW': losses in another unit; allowed: W"),
        ("rpm,kNm,eta\n1,2,0.4\n", (), "'kNm': torques in another unit; allowed: N m"),
        ("rpm,Power [kW],eta\n1,2,0.4\n", (), "'Power [kW]': powers; allowed: torques in N m, or losses in W"),
        ("km/h,Nm,eta\n1,2,0.4\n", (), "'km/h': speeds in another unit; allowed: rad/s or rpm: --speed-unit"),
        ("1/s,Nm,eta\n1,2,0.4\n", (), "'1/s': speeds in another unit"),
        ("krpm,Nm,eta\n1,2,0.4\n", (), "'krpm': speeds in another unit"),
        ("speed_%,Nm,eta\n1,2,0.4\n", (), "'speed_%': speeds in another unit"),
        ("rpm,Torque [%],eta\n1,2,0.4\n", (), "'Torque [%]': torques in another unit"),
        ("rpm;Nm;eta\n955;2,5;0,4\n1.194;2,5;0,4\n", (), "'1.194' has a point, in a table of decimal commas"),
        ("T,1,2,3\n-5,0.1,0.2,0.3\n", (), "speed -5 is out of range (taken for a matrix"),
        ("T,1,2,3\n-5,0.1,0.2,0.3\n", (), "allowed: >= 0, or --down torque; for a list three columns: speed,"),
        ("T,1,2,3\n-5,0.1,0.2,0.3\n", ("--layout", "matrix"), "allowed: >= 0, or --down torque"),
        ("T,-330,2,3\n5,0.1,0.2,0.3\n", ("--down", "torque"), "line 1: speed -330 is out of range (taken for a matrix"),
        ("torque_knm\\speed_rpm,1,2,3\n5,0.1,0.2,0.3\n", (), "'torque_knm\\\\speed_rpm': torques in another unit"),
        ("PK\x03\x04 no table at all\n", (), "holds no numbers; allowed: a text table"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_nothing_is_written(tmp_path, capsys, text, options, words):
    (tmp_path / "sheet.csv").write_text(text)
    code, out, err = run(capsys, tmp_path / "sheet.csv", "--output", tmp_path / "map.csv", *options)
    assert (code, out) == (2, "")
    assert err.startswith("import_motor: error: ")
    assert err.count("\n") == 1
    assert words in err
    assert not (tmp_path / "map.csv").exists()


def listed(row="{w},{t},{e}", head="speed_rad_s,torque_nm,efficiency\n", nothing=""):
    """The shipped map as a list; NaN as `nothing`."""
    lines = []
    for w, t, e in points():
        known = nothing if math.isnan(e) else f"{e:.9f}"
        lines.append(row.format(w=w, t=t, e=known, rpm=f"{w * RPM:.9f}"))
    return head + "".join(f"{line}\n" for line in lines)


@pytest.mark.parametrize(
    "text",
    [
        listed(),
        listed(head=""),
        listed(head="speed,torque,efficiency\nrad/s,Nm,1\n"),
        listed("{rpm},{t},{e}", "Motor of 2015,,\nspeed,torque,efficiency\nrpm,Nm,-\n"),
        listed("{rpm}\t{t}\t{e}\t", "\ufeffrpm\tNm\teta\t\n"),
        listed(head="w,t,eta\n").replace("\n", "\r\n") + "\r\n,,\r\n",
        listed("{t},{w},{e}", "torque_nm,speed_rad_s,efficiency\n"),
        *(listed(nothing=nothing) for nothing in ("NaN", "#N/A", "-", "n.a.", "#DIV/0!")),
    ],
    ids=["plain", "no head", "units", "title and units", "tabs", "crlf", "torque first", *"abcde"],
)
def test_a_sheet_as_programs_write_them_is_read_as_it_is_meant(tmp_path, capsys, text):
    (tmp_path / "sheet.csv").write_text(text, newline="")
    code, _, err = run(capsys, tmp_path / "sheet.csv", "--output", tmp_path / "map.csv")
    assert (code, err) == (0, "")
    same(tmp_path / "map.csv")


def test_points_on_no_grid_and_a_header_in_percent_are_warned_of(tmp_path, capsys):
    rows = "".join(f"{w + 0.01 * i},{t},{e}\n" for i, (w, t, e) in enumerate(points()))
    (tmp_path / "sheet.csv").write_text("rad/s,Nm,eta [%]\n" + rows)
    code, _, err = run(capsys, tmp_path / "sheet.csv", "--output", tmp_path / "map.csv")
    assert code == 0
    assert "its points hardly lie on a grid" in err
    assert "efficiencies as fractions of 1, although the header says %" in err


def test_a_wrong_digit_and_fractions_among_percents_are_warned_of(tmp_path, capsys):
    rows = list(points())
    inner = next(i for i, (w, t, e) in enumerate(rows) if w > 60.0 and t > 40.0 and e > 0.8)
    table = tmp_path / "sheet.csv"
    for factor, words in ((0.1, f"{rows[inner][2] / 10:.4g} at"), (1.0 / rows[inner][2], "1 at")):
        wrong = [(w, t, e * factor if i == inner else e) for i, (w, t, e) in enumerate(rows)]
        table.write_text("speed_rad_s,torque_nm,efficiency\n" + "".join(f"{w},{t},{e}\n" for w, t, e in wrong))
        code, _, err = run(capsys, table, "--output", tmp_path / "map.csv", "--quiet")
        assert code == 0
        assert err.count("a wrong digit?") == 1
        assert words in err
    mixed = "".join(f"{w},{t},{100 * e if t > 5 else e}\n" for w, t, e in rows)
    table.write_text("speed_rad_s,torque_nm,efficiency\n" + mixed)
    for options in ((), ("--percent",)):
        err = run(capsys, table, "--output", tmp_path / "map.csv", "--quiet", *options)[2]
        assert "are at most 1: fractions of 1 among them?" in err


def test_signs_of_percent_stand_behind_numbers(tmp_path, capsys):
    table = tmp_path / "sheet.csv"
    table.write_text("rad/s,Nm,eta\n" + "".join(f"{w},{t},{100 * e:.8f} %\n" for w, t, e in points()))
    assert run(capsys, table, "--output", tmp_path / "map.csv", "--quiet") == (0, "", "")
    same(tmp_path / "map.csv")


def test_speeds_taken_for_torques_are_warned_of(tmp_path, capsys):
    sheet = ";1000;3000;6000;9000\n10;80;85;86;85\n30;82;87;88;86\n60;80;86;87;85\n"
    (tmp_path / "sheet.csv").write_text(sheet)
    code, _, err = run(capsys, tmp_path / "sheet.csv", "--output", tmp_path / "map.csv")
    assert code == 0
    assert "torques up to 9000 N m at the motor: --down?" in err
    (tmp_path / "sheet.csv").write_text("Nm\\rpm" + sheet)
    code, out, err = run(capsys, tmp_path / "sheet.csv", "--output", tmp_path / "again.csv")
    assert (code, err) == (0, "")
    assert "torques down: the corner says 'Nm\\rpm'" in out


def test_speeds_of_no_unit_that_are_high_for_rad_s_are_warned_of(tmp_path, capsys):
    sheet = "speed,torque,efficiency\n" + "".join(f"{s},{t},0.8{t}\n" for s in (0, 100, {}) for t in (1, 5))
    geared = "--gear", "9"
    for fastest, options, warned in (
        (3000, (), True),
        (300, (), False),
        (3000, ("--speed-unit", "rad/s"), False),
        (3000, geared, True),
        (1500, geared, False),
    ):
        (tmp_path / "sheet.csv").write_text(sheet.replace("{}", str(fastest)))
        code, _, err = run(capsys, tmp_path / "sheet.csv", *options, "--output", tmp_path / "map.csv")
        assert code == 0
        assert ("speeds up to 3000 of no unit are taken for rad/s: rpm? --speed-unit says it" in err) is warned


def test_a_unit_that_contradicts_the_header_is_warned_of(tmp_path, capsys):
    table = tmp_path / "sheet.csv"
    rows = "".join(f"{w * RPM:.8f},{t},{e:.8f}\n" for w, t, e in points())
    for header, unit in (("n/rpm", "rad/s"), ("speed_rad_s", "rpm")):
        table.write_text(f"{header},T/Nm,eta\n{rows}")
        err = run(capsys, table, "--output", tmp_path / "map.csv", "--speed-unit", unit, "--quiet")[2]
        assert f"speeds in {unit}, as --speed-unit says, although the header says" in err
    assert run(capsys, table, "--output", tmp_path / "again.csv", "--quiet")[2] == ""


@pytest.mark.parametrize(("options", "words"), [((), "outermost points of the table: peak"), (DEMANDS, "of the motor")])
def test_the_picture_says_whose_limits_it_draws(tmp_path, capsys, options, words):
    code, _, _ = run(capsys, MAP, "--output", tmp_path / "map.csv", "--plot", tmp_path / "map.svg", *options)
    assert code == 0
    assert words in (tmp_path / "map.svg").read_text()


def test_a_file_that_is_not_there_is_answered_with_the_names_near_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "supplier_sheet.csv").write_text("speed,torque,efficiency\n")
    assert main(["suplier_sheet.csv", "--output", "map.csv"]) == 2
    assert "did you mean supplier_sheet.csv?" in capsys.readouterr().err
