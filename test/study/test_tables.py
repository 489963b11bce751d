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


def of(label, **changes):
    made = MADE | changes.pop("made", {})
    return replace(ROW, label=label, strategy=label.partition(",")[0], made_with=made, **changes)


def test_each_place_has_its_heading_once():
    rows = [of("sdp"), of("equal"), of("sdp", place=Place("nycc", 0.2, "none"))]
    text = text_table(rows, 100)
    assert text.count("nycc, friction 0.9, idle drive none, control at 100 Hz") == 1
    assert text.count("nycc, friction 0.2, idle drive none") == 1
    assert "104.46" in text
    assert "−1.46" in text


def test_what_all_rows_share_stands_above_them_and_what_differs_in_columns():
    coupled = {"policy_grid": "coupled", "policy_checksum": "f850ca447570"}
    lookahead = of("sdp_lookahead", made=coupled)
    shared = text_table([of("equal"), lookahead], 100)
    assert "split decided every 0.02 s,\npolicy coupled f850ca44\n" in shared
    assert "every row: locked 0.00 s, trace held" in shared
    assert not {"decides", "policy", "trace", "locked"} & set(shared.splitlines()[4].split())
    printed = {"policy_grid": "paper", "policy_checksum": "cf1c7eae0000", "settings": {"decision_period_s": 0.1}}
    lost = METRICS._replace(trace_held=False, trace_excess_mps=1.25, locked_s=2.5)
    apart = text_table([of("equal"), lookahead, of("paper_sdp", made=printed, metrics=lost)], 1000)
    assert "every" not in apart.splitlines()[0]
    *_, equal, ours, papers = map(str.split, apart.splitlines())
    assert equal[-3:] == ["0.00", "held", "–"]
    assert ours[-5:] == ["0.00", "held", "0.02", "coupled", "f850ca44"]
    assert papers[-6:] == ["2.50", "lost", "1.25", "0.1", "paper", "cf1c7eae"]


def test_how_a_single_strategy_was_driven_stands_above_the_table():
    text = text_table([of("equal"), of("preview, at most 7 changes a minute, or none")], 100)
    assert "\npreview: at most 7 changes a minute, or none\n" in text
    assert text.splitlines()[-1].split()[:2] == ["preview", "104.46"]


def test_no_line_is_wider_than_the_screen():
    rows = [
        of("instantaneous_slip", made={"policy_grid": "coupled", "policy_checksum": f"{k:012}"}, metrics=metrics)
        for k, metrics in enumerate([METRICS, METRICS._replace(trace_held=False, trace_excess_mps=12.3, min_slip=-0.1)])
    ]
    for width in (60, 80, 100):
        assert max(map(len, text_table(rows, width).splitlines())) <= width
        assert "lost 12.30" in text_table(rows, width)


def test_numbers_stand_below_each_other():
    lines = text_table([ROW, replace(ROW, metrics=METRICS._replace(wh_per_km=9.5))], 100).splitlines()[-2:]
    assert lines[0].index("104.46") + len("104.46") == lines[1].index("9.50") + len("9.50")


def test_a_lost_trace_and_another_distance_are_marked():
    lost = METRICS._replace(trace_held=False, trace_excess_mps=1.25)
    text = text_table([replace(ROW, metrics=lost, same_distance_as_equal=False)], 100)
    assert "trace lost 1.25" in text
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
