# SPDX-License-Identifier: Apache-2.0
"""The page: what it holds, what it must never hold, and that a browser shows it without a complaint."""

import html.parser
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.errors import ConfigError
from iwm_sim.study import figures
from iwm_sim.study.palette import COLOURS, INK
from iwm_sim.study.report import (
    CHART_POINTS,
    Chart,
    Column,
    Page,
    Panel,
    Picture,
    Pictures,
    Series,
    Settings,
    Table,
    Text,
    Tile,
    Tiles,
    Verdict,
    format_value,
    render,
    svg_of,
    thin,
    write_page,
)

TIME = np.arange(0.0, 600.0, 0.01)
ROWS = [
    {"strategy": "sdp", "wh_per_km": 83.125, "trace_held": True},
    {"strategy": "equal", "wh_per_km": 84.5, "trace_held": True},
    {"strategy": "coasting", "wh_per_km": 20.0, "trace_held": False},
]
TABLE = Table(
    "Result",
    [
        Column("Strategy", lambda row: row["strategy"]),
        Column("Energy", lambda row: row["wh_per_km"], "Wh/km", 2, best="low"),
        Column("Trace", lambda row: Verdict(row["trace_held"], "held" if row["trace_held"] else "lost")),
    ],
    ROWS,
    valid=lambda row: row["trace_held"],
)


def html_of(block):
    """A page with nothing but a block."""
    return render(Page("", "", [block]))


def full_page():
    curve = figures.Curve("5 m/s", np.linspace(0.0, 10e3, 11), np.linspace(0.0, 1e-3, 11))
    return Page(
        "A drive <over> DDS",
        "The policy saved 1.2 % & more.",
        [
            Tiles([Tile("Energy", "83.1", "Wh/km", "equal: 84.5")]),
            TABLE,
            Text("A paragraph.", "Heading"),
            Chart(
                "The drive",
                TIME,
                [
                    Panel("Speed", "m/s", [Series("car", np.sin(TIME)), Series("cycle", np.cos(TIME), 7, dashed=True)]),
                    Panel(
                        "Gate",
                        "",
                        [Series("</script>", np.zeros(len(TIME)), step=True)],
                        ticks=[(0, "none"), (1, "front")],
                    ),
                ],
            ),
            Pictures(
                "Figures",
                [
                    Picture("Fig. 8.", figures.depletion_over_split([curve])),
                    Picture("Fig. 9.", figures.depletion_over_split([curve])),
                ],
            ),
            Settings("Settings", {"friction": 0.9, "lock-step": True, "policy": "a.npz"}),
        ],
        valid=True,
        verdict="the trace was held",
    )


class Outline(html.parser.HTMLParser):
    """Collects what a page refers to and checks that its elements close."""

    VOID = frozenset({"meta", "link", "br"})

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.references, self.data = [], [], [], []

    def handle_starttag(self, tag, attributes):
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "action", "srcset"):
                self.references.append(value)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script" and data.lstrip().startswith("{"):
            self.data.append(json.loads(data))


@pytest.fixture(scope="module")
def page():
    return render(full_page())


@pytest.fixture(scope="module")
def outline(page):
    parser = Outline()
    parser.feed(page)
    parser.close()
    return parser


def test_every_element_closes_and_every_id_is_unique(outline):
    assert outline.open == []
    assert len(outline.ids) == len(set(outline.ids))


def test_the_page_refers_to_nothing_outside_itself(page, outline):
    assert all(reference.startswith(("#", "data:")) for reference in outline.references)
    namespaces = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert set(re.findall(r"https?://[^\s\"'<>)]+", page)) <= namespaces
    assert "default-src 'none'" in page


def test_text_is_escaped_also_inside_the_charts_data(page, outline):
    assert "A drive &lt;over&gt; DDS" in page
    assert outline.data[0]["panels"][1]["series"][0]["name"] == "</script>"


def test_a_valid_page_says_so_and_why(page):
    assert "✓ valid" in page
    assert "the trace was held" in page


def test_a_run_that_lost_the_trace_is_marked_and_never_the_best():
    shown = html_of(TABLE)
    rows = re.findall(r"<tr.*?</tr>", shown)[1:]
    assert ['class="invalid"' in row for row in rows] == [False, False, True]
    assert ["✗ lost" in row for row in rows] == [False, False, True]
    assert ['class="best"' in row for row in rows] == [True, False, False]


def test_an_equal_result_has_no_best():
    rows = [{"strategy": name, "wh_per_km": 80.0, "trace_held": True} for name in "ab"]
    assert 'class="best"' not in html_of(Table("", TABLE.columns, rows))


def test_columns_of_a_group_stand_below_its_heading():
    columns = [
        Column("Cycle", str),
        *(Column(name, len, "%", 1, group="saving") for name in ("theirs", "ours")),
        Column("trace", str),
    ]
    table = Table("", columns, ["nycc"])
    assert table.groups == [("", 1), ("saving", 2), ("", 1)]
    assert '<th colspan="2" class="group">saving</th>' in html_of(table)
    assert Table("", columns[:1], []).groups == []


@pytest.mark.parametrize(
    ("value", "decimals", "shown"),
    [
        (None, 2, "–"),
        (float("nan"), 2, "–"),
        (-1.005, 1, "−1.0"),
        (-0.0001, 2, "0.00"),
        (3, 2, "3.00"),
        (3, None, "3"),
        (0.9, None, "0.9"),
        (True, None, "yes"),
        (np.False_, 2, "no"),
        ("sdp", None, "sdp"),
    ],
)
def test_values_read_as_an_engineer_writes_them(value, decimals, shown):
    assert format_value(value, decimals) == shown


def test_a_chart_stays_small_and_keeps_a_spike_of_one_sample():
    speed = np.sin(TIME)
    speed[12_345] = 50.0
    shown = Chart("", TIME, [Panel("Speed", "m/s", [Series("car", speed)])]).data()
    data = json.loads(shown)
    values = data["panels"][0]["series"][0]["values"]
    assert len(values) == len(data["time"]) <= CHART_POINTS
    assert max(values) == 50
    assert len(shown) < 150_000


def test_a_chart_without_a_line_or_with_a_line_of_another_length_is_refused():
    with pytest.raises(ValueError, match="no series"):
        Chart("Empty", TIME, []).data()
    with pytest.raises(ValueError, match="2 values for 60000 times"):
        Chart("Short", TIME, [Panel("Speed", "m/s", [Series("car", [1.0, 2.0])])]).data()


samples = st.lists(st.one_of(st.floats(-1e6, 1e6), st.just(float("nan"))), min_size=1, max_size=300)


@given(values=samples, points=st.integers(2, 400))
def test_thinning_keeps_the_extremes_and_the_order_of_time(values, points):
    values = np.array(values)
    time = np.arange(len(values)) * 0.1
    thin_time, thin_values = thin(time, values, points)
    assert len(thin_time) == len(thin_values) <= max(points, 2)
    assert np.all(np.diff(thin_time) >= 0.0)
    assert np.isin(thin_values[~np.isnan(thin_values)], values).all()
    if np.isnan(values).all():
        assert np.isnan(thin_values).all()
    else:
        assert np.nanmin(thin_values) == np.nanmin(values)
        assert np.nanmax(thin_values) == np.nanmax(values)


def test_a_figure_takes_the_pages_colours_and_fonts_and_its_own_ids():
    curve = figures.Curve("a", [0.0, 1.0], [0.0, 1.0])
    drawn = svg_of(figures.depletion_over_split([curve]), "f1", "A & B")
    assert drawn.startswith('<svg role="img" aria-label="A &amp; B"')
    assert COLOURS[0] not in drawn
    assert INK not in drawn
    assert "var(--c0)" in drawn
    assert all(name.startswith("f1-") for name in re.findall(r'\sid="([^"]+)"', drawn))
    assert all(name.startswith("f1-") for name in re.findall(r"url\(#([^)]+)\)", drawn))
    assert not re.search(r"<svg[^>]*\s(width|height)=", drawn)


def test_the_same_figure_gives_the_same_bytes():
    curve = figures.Curve("a", [0.0, 1.0], [0.0, 1.0])
    first, second = (svg_of(figures.depletion_over_split([curve]), "f", "") for _ in range(2))
    assert first == second


def test_a_page_is_written_whole_or_the_folder_is_named(tmp_path):
    write_page(tmp_path / "page.html", full_page())
    assert (tmp_path / "page.html").read_text().endswith("</html>\n")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    with pytest.raises(ConfigError, match="missing"):
        write_page(tmp_path / "missing" / "page.html", full_page())


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_browser_draws_the_page_without_a_word_on_its_console(tmp_path, page):
    (tmp_path / "page.html").write_text(page)
    run = subprocess.run(
        [
            CHROMIUM,
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--virtual-time-budget=4000",
            "--dump-dom",
            (tmp_path / "page.html").as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert "CONSOLE" not in run.stderr
    # What the script drew: a line for each series, and the names of a choice on its axis.
    assert run.stdout.count('class="series"') == 3
    assert re.search(r'class="tick"[^>]*>front</text>', run.stdout)
