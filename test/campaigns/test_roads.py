# SPDX-License-Identifier: Apache-2.0
"""The command `roads`: its lines, its page, its JSON and its exit codes."""

from __future__ import annotations

import json

import yaml

from campaigns.roads import main

SHORT = {
    "format": 1,
    "about": "A short stop.",
    "start": {"speed_mps": 5.0},
    "demand": [{"from_s": 0.1, "brake": 0.5}],
    "road": {"friction": 0.9},
    "until": {"time_s": 4.0, "standstill": True},
    "require": {"stopping_distance_m": {"at_most": 20.0}},
}


def write(tmp_path, name, **changes):
    path = tmp_path / f"{name}.yaml"
    path.write_text(yaml.safe_dump(SHORT | changes))
    return str(path)


def test_it_drives_what_it_is_given_and_says_what_came_out(tmp_path, capsys):
    page, values = tmp_path / "roads.md", tmp_path / "roads.json"
    options = ["--strategy", "equal", "--page", str(page), "--json", str(values)]
    assert main([write(tmp_path, "short_stop"), *options]) == 0
    out = capsys.readouterr().out
    assert "pass  short_stop: A short stop." in out
    assert "1 of 1 scenarios" in out
    assert "`short_stop`" in page.read_text()
    assert 0.0 < json.loads(values.read_text())["short_stop"]["stopping_distance_m"] < 20.0


def test_a_requirement_that_is_not_met_is_exit_code_1(tmp_path):
    path = write(tmp_path, "short_stop", require={"stopping_distance_m": {"at_most": 0.1}})
    assert main([path, "--strategy", "equal"]) == 1


def test_a_bad_file_is_one_line_and_exit_code_2(tmp_path, capsys):
    assert main([write(tmp_path, "bad", road={"friction": 9.0}), "--strategy", "equal"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
