# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a command line is one line."""

import argparse
import os
from argparse import BooleanOptionalAction

import pytest

from iwm_power_manager.command_line import CommandParser, refuse_without_effect
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.tools.command import output_file, picture


@pytest.fixture
def parser():
    made = CommandParser("draw", description="Draws.\n\n  as typed")
    made.add_argument("--plot", type=picture)
    made.add_argument("--record", action=BooleanOptionalAction)
    made.add_argument("--no-page", action="store_true")
    made.add_argument("--strategy", choices=["sdp", "sdp_lookahead", "equal"])
    made.meanings = {"sdp": "its table", "equal": "the paper's ED"}
    made.add_subparsers(dest="what").add_parser("all").add_argument("--many", type=int)
    return made


@pytest.mark.parametrize(
    ("arguments", "words", "program"),
    [
        (["--no-such"], "unrecognized arguments: --no-such", "draw"),
        (["--plot", "a.txt"], "a.txt is no picture's name; allowed: ending in .pdf, .png, .svg", "draw"),
        (["--plt", "all"], "unrecognized arguments: --plt; did you mean --plot?", "draw"),
        (["--plo=a.png"], "unrecognized arguments: --plo=a.png; did you mean --plot?", "draw"),
        (["all", "--mny", "3"], "unrecognized arguments: --mny 3; did you mean --many?", "draw all"),
        (["--strategy", "sdp_lookahed"], "'sdp_lookahead', 'equal'); did you mean sdp_lookahead?", "draw"),
        (["--strategy", "SDP"], "; did you mean sdp (its table) or sdp_lookahead?", "draw"),
        (["--strategy", "lookahead"], "; did you mean sdp_lookahead?", "draw"),
        (["--strategy", "ED"], "; did you mean equal (the paper's ED)?", "draw"),
        (["--strategy", "magic"], "'magic' (choose from 'sdp', 'sdp_lookahead', 'equal') (see", "draw"),
        (["al"], "did you mean all?", "draw"),
        (["all", "--many", "x"], "invalid int value: 'x'", "draw all"),
    ],
)
def test_a_mistake_is_one_line_that_says_where_help_is(parser, arguments, words, program, capsys):
    with pytest.raises(SystemExit) as ended:
        parser.parse_args(arguments)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert line.startswith(f"{program}: error: ")
    assert line.endswith(f"(see {program} --help)")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["--cycle", "a.svg", "b.csv", "--plot", "./b.svg", "--json", "b.csv"],
            "--json: b.csv would be written over what --cycle",
        ),
        (["--plot", "a.svg", "--json", "{here}/a.svg"], "--plot: a.svg would be written over what --json names"),
        (["b.csv", "--json", "b.csv"], "--json: b.csv would be written over what log names"),
        (["--json", "."], "--json: . cannot be written: it is a folder"),
        (["--json", ""], "--json: an empty name cannot be written"),
        (["--cycle", "-", "--json", "-"], ""),
        (["equal", "--json", "equal"], ""),  # a word, and no file
        (["--cycle", "a.csv", "a.csv", "--json", "b.csv"], ""),
    ],
)
def test_nothing_is_written_over_what_is_read_or_written_by_another_option(
    arguments, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b.csv").touch()
    made = CommandParser("draw")
    made.add_argument("log", nargs="?")
    made.add_argument("--cycle", nargs="+")
    made.add_argument("--plot", type=picture)
    made.add_argument("--json", type=output_file)
    arguments = [word.replace("{here}", str(tmp_path)) for word in arguments]
    if words:
        with pytest.raises(SystemExit) as stop:
            made.parse_args(arguments)
        assert stop.value.code == 2
        assert words in capsys.readouterr().err
    else:
        made.parse_args(arguments)


def test_help_stands_as_typed(parser, capsys):
    with pytest.raises(SystemExit):
        parser.parse_args(["--help"])
    assert "Draws.\n\n  as typed" in capsys.readouterr().out


def test_the_options_that_were_given_are_known_by_name(parser):
    given = parser.parse_args(["--plot=a.png", "--no-record", "--no-page", "all", "--many", "3"]).given
    assert given == {"--plot", "--record", "--no-page", "--many"}


def test_an_option_without_effect_is_refused_only_where_it_was_given(parser, capsys):
    useful = {"--record": (False, "nothing runs"), "--plot": (True, "it draws")}
    refuse_without_effect(parser.parse_args(["--plot", "a.png"]), useful)
    with pytest.raises(ConfigError, match="arguments: --record: has no effect: nothing runs"):
        refuse_without_effect(parser.parse_args(["--no-record"]), useful)
    with pytest.raises(SystemExit):
        parser.check(parser.parse_args(["--record"]), useful)
    assert "draw: error: arguments: --record: has no effect: nothing runs (see draw --help)" in capsys.readouterr().err


def test_a_folder_that_may_not_be_written_to_is_said_before_anything_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) != str(tmp_path))
    for kind, name in ((output_file, "a.json"), (picture, "a.svg")):
        with pytest.raises(argparse.ArgumentTypeError, match="cannot be written: its folder may not be written to"):
            kind(str(tmp_path / name))
    assert output_file("/dev/null") and output_file("-")
