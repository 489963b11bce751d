# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a command line is one line."""

import pytest

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.tools.command import picture


@pytest.fixture
def parser():
    made = CommandParser("draw", description="Draws.\n\n  as typed")
    made.add_argument("--plot", type=picture)
    made.add_argument("--strategy", choices=["sdp", "sdp_lookahead", "equal"])
    made.add_subparsers(dest="what").add_parser("all").add_argument("--many", type=int)
    return made


@pytest.mark.parametrize(
    ("arguments", "words", "program"),
    [
        (["--no-such"], "unrecognized arguments: --no-such", "draw"),
        (["--plot", "a.txt"], "a.txt is no picture's name; allowed: ending in .pdf, .png, .svg", "draw"),
        (["--strategy", "sdp_lookahed"], "'sdp_lookahead', 'equal'); did you mean sdp_lookahead?", "draw"),
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


def test_help_stands_as_typed(parser, capsys):
    with pytest.raises(SystemExit):
        parser.parse_args(["--help"])
    assert "Draws.\n\n  as typed" in capsys.readouterr().out
