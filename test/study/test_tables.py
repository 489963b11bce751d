# SPDX-License-Identifier: Apache-2.0
"""Rows as text and Markdown."""

from dataclasses import replace

from iwm_sim.metrics import Metrics
from iwm_sim.study.report import Column
from iwm_sim.study.rows import Place, Row
from iwm_sim.study.tables import markdown_table, plain_table, text_table

METRICS = Metrics(**dict.fromkeys(Metrics._fields, 0.0))._replace(wh_per_km=104.456, trace_held=True)
MADE = {"dt_s": 0.01, "settings": {"decision_period_s": 0.02}}
ROW = Row(Place("nycc", 0.9, "none"), "sdp", "sdp", METRICS, -1.456, None, True, MADE)


def test_each_group_has_its_heading_once():
    rows = [ROW, replace(ROW, label="equal"), replace(ROW, place=Place("nycc", 0.2, "none"))]
    text = text_table(rows)
    assert text.count("nycc, friction 0.9, idle drive none, control at 100 Hz") == 1
    assert text.count("nycc, friction 0.2, idle drive none") == 1
    assert "104.46" in text
    assert "−1.46" in text


def test_numbers_stand_below_each_other():
    lines = text_table([ROW, replace(ROW, metrics=METRICS._replace(wh_per_km=9.5))]).splitlines()[2:]
    assert lines[0].index("104.46") + len("104.46") == lines[1].index("9.50") + len("9.50")


def test_a_lost_trace_and_another_distance_are_marked():
    lost = METRICS._replace(trace_held=False, trace_excess_mps=1.25)
    text = text_table([replace(ROW, metrics=lost, same_distance_as_equal=False)])
    assert "lost by 1.25" in text
    assert "distance" in text
    assert "−1.46" not in text


def test_a_table_wider_than_the_screen_goes_on_below_with_its_first_columns():
    columns = [
        Column("Cycle", lambda row: row[0]),
        *(
            Column(label, lambda row: row[1], "%", 1, group=group)
            for group in ("slip", "jerk", "locked")
            for label in ("without", "with")
        ),
    ]
    text = plain_table([("nycc", 1.0)], columns, 40)
    assert max(map(len, text.splitlines())) <= 40
    assert [part.split()[:1] + part.split()[-1:] for part in text.split("\n\n")] == [["slip", "1.0"], ["locked", "1.0"]]
    assert text.count("nycc") == 2
    assert plain_table([("nycc", 1.0)], columns, 200) == plain_table([("nycc", 1.0)], columns)


def test_markdown_escapes_what_would_break_a_table():
    columns = [Column("Name", lambda row: row[0]), Column("here", lambda row: row[1], "W", 1, group="Value")]
    text = markdown_table([("a|b", 1.0)], columns)
    assert text.splitlines() == ["| Name | Value here, W |", "| --- | ---: |", "| a\\|b | 1.0 |"]


def test_a_group_stands_once_over_its_columns():
    columns = [
        Column("name", lambda row: row[0]),
        *(Column(label, lambda row: row[1], "%", 1, group="saved here") for label in ("a", "b", "c")),
        Column("d", lambda row: row[1], "%", 1, group="as printed there"),
    ]
    assert plain_table([("x", 1.0)], columns).splitlines() == [
        "        saved here   as printed there",
        "name    a    b    c                 d",
        "        %    %    %                 %",
        "x     1.0  1.0  1.0               1.0",
    ]
