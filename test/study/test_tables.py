"""Rows as text and Markdown."""

from iwm_sim.study.report import Column
from iwm_sim.study.tables import COLUMNS, markdown_table, text_table

ROW = {
    "cycle": "nycc",
    "friction": 0.9,
    "idle_drive": "none",
    "label": "sdp",
    "wh_per_km": 104.456,
    "delta_soc_percent": 0.4123,
    "saving_percent": -1.456,
    "share_of_possible": None,
    "share_changes_per_min": 8.93,
    "rms_speed_error_mps": 0.087,
    "max_speed_error_mps": 0.64,
    "min_slip": -0.023,
    "max_slip": 0.018,
    "locked_s": 0.0,
    "trace_held": True,
    "trace_excess_mps": 0.0,
    "same_distance_as_equal": True,
}


def test_each_group_has_its_heading_once():
    rows = [ROW, ROW | {"label": "equal"}, ROW | {"friction": 0.2}]
    text = text_table(rows, COLUMNS)
    assert text.count("nycc, friction 0.9, idle drive none") == 1
    assert text.count("nycc, friction 0.2, idle drive none") == 1
    assert "104.46" in text
    assert "−1.46" in text


def test_numbers_stand_below_each_other():
    lines = text_table([ROW, ROW | {"wh_per_km": 9.5}], COLUMNS).splitlines()[2:]
    assert lines[0].index("104.46") + len("104.46") == lines[1].index("9.50") + len("9.50")


def test_a_lost_trace_and_another_distance_are_marked():
    text = text_table([ROW | {"trace_held": False, "trace_excess_mps": 1.25, "same_distance_as_equal": False}], COLUMNS)
    assert "lost by 1.25" in text
    assert "distance" in text
    assert "−1.46" not in text


def test_markdown_escapes_what_would_break_a_table():
    text = markdown_table([{"name": "a|b", "value": 1.0}], [Column("name", "Name"), Column("value", "Value", "W", 1)])
    assert text.splitlines() == ["| Name | Value, W |", "| --- | ---: |", "| a\\|b | 1.0 |"]
