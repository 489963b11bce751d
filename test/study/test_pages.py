# SPDX-License-Identifier: Apache-2.0
"""The study's pages: from the stored numbers alone, and what docs/study.md shows is what they say."""

import html
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from iwm_power_manager.errors import ConfigError
from iwm_sim.metrics import Metrics
from iwm_sim.study import answers, battery_fit, criteria, labels, pages, paper, study_tables
from iwm_sim.study.cases import Rule, vehicle_of
from iwm_sim.study.content import Study
from iwm_sim.study.names import FIGURES
from iwm_sim.study.report import anchor, render
from iwm_sim.study.rows import Place, Row, by_place
from iwm_sim.study.study_figures import Material, drawn
from study_fixtures import CHAIN

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def content():
    return Study.load(DOCS / "study.json")


@pytest.fixture(scope="module")
def material():
    time = np.arange(0.0, 30.0, 0.1)
    wave = np.sin(time)
    window = {
        label: {"time_s": time, "front_power_w": wave, "rear_power_w": wave, "front_slip": wave, "rear_slip": wave}
        for label in (labels.ED, labels.OURS, labels.GATE_OFF, labels.GATE_TABLE_2)
    }
    estimate = battery_fit.Estimate(0.05, 240.0, 1e-5, {"hill": 1e-5})
    comparison = battery_fit.Comparison(time, wave, wave, 0.8 - time / 1e4, 0.8 - time / 1e4)
    return Material(
        battery=battery_fit.Fit(dict.fromkeys(battery_fit.CIRCUITS, estimate), comparison, "none"),
        rule=Rule((0.0, 0.6, 0.0, 0.4), 1e3 * wave, np.abs(wave)),
        convergence=(np.array([10.0, 1.0, 0.0]), np.array([1.0, 0.1, 0.01])),
        window=window,
        chain=CHAIN,
    )


def test_the_document_shows_what_the_stored_study_says(content, tmp_path):
    copy = tmp_path / "study.md"
    copy.write_text((DOCS / "study.md").read_text())
    pages.update_document(copy, content)
    assert copy.read_text() == (DOCS / "study.md").read_text(), (
        "run: evaluate --study runs/study --update-doc docs/study.md"
    )


def test_a_document_without_a_place_for_the_tables_is_refused(content, tmp_path):
    path = tmp_path / "plain.md"
    path.write_text("# Nothing here\n")
    with pytest.raises(ConfigError, match="no place for generated tables"):
        pages.update_document(path, content)
    assert path.read_text() == "# Nothing here\n"


def test_the_stored_criteria_follow_from_the_stored_rows(content):
    slew = content.settings["slew_down_nmps"]
    again = criteria.check(content.cells, content.stops, slew)
    assert [(made.text, made.met) for made in again] == [(row.text, row.met) for row in content.criteria]


def test_a_study_survives_its_file(content):
    assert Study.from_json(content.to_json()) == content


def test_every_cell_of_the_paper_stands_beside_ours(content):
    made = list(study_tables.paper_tables(content.cells, study_tables.in_order(content)))
    assert len(made) == 6
    for table in made:
        assert [table.columns[0].value(row) for row in table.rows] == list(paper.CYCLES)
        assert all(column.shown(row) != "–" for row in table.rows for column in table.columns)


def test_all_strategies_were_driven_in_all_24_cells(content):
    by_cell = by_place(content.cells)
    assert len(by_cell) == 24
    wanted = {labels.ED, labels.GRDP, labels.INSTANTANEOUS, labels.OURS, labels.BOUND, labels.PAPER_SDP}
    assert all(wanted <= set(by) for by in by_cell.values())


def test_a_printed_saving_that_no_strategy_reaches_is_called_so():
    def row(label, saving):
        metrics = Metrics(**dict.fromkeys(Metrics._fields, 0.0))
        return Row(Place("udds", 0.9, "none"), label, "sdp", metrics, saving, None, True)

    def verdict(printed, reached, most, most_drag=0.5):
        none = {label: row(label, saving) for label, saving in zip(names, (reached, most), strict=True)}
        drag = {names[0]: row(names[0], -1.0), names[1]: row(names[1], most_drag)}
        return study_tables.verdict(printed, none, drag)

    names = (labels.PAPER_SDP, labels.FREE_BOUND)
    assert "more than any strategy" in verdict(3.0, 1.0, 2.0)
    assert "only if an idle axle costs nothing" in verdict(1.0, 1.5, 2.0)
    assert "reaches it" in verdict(1.0, 1.5, 2.0)
    assert "saves nothing" in verdict(0.3, -0.5, 2.0)
    assert "cannot be compared" in verdict(0.3, None, 2.0)


def test_page_markdown_and_pictures_are_written(content, material, tmp_path):
    (tmp_path / "figures").mkdir()
    pictures = drawn(content.frontier, material, vehicle_of("jalalmaab_2015", "none").params)
    pages.write(tmp_path, content, pictures)
    files = [path.name for path in (tmp_path / "figures").iterdir()]
    for number in ("07", "08", "09", "10", "12", "13", "14", "15"):
        assert any(name.startswith(f"figure_{number}_") for name in files)
    page = (tmp_path / "study.html").read_text()
    assert all(picture.title in page for picture in pictures)
    assert page.index(answers.answers(content)[-1].answer[:20]) < page.index("<nav") < page.index("<table")
    assert "http://" not in page.replace("http://www.w3.org", "")
    text = (tmp_path / "study.md").read_text()
    assert text.startswith(f"# {pages.TITLE}")
    assert text.count("\nMade by `") == len(study_tables.tables(content)) == page.count("Made by ") - len(pictures)


def test_every_figure_names_the_command_that_draws_it(content, material):
    pictures = drawn(content.frontier, material, vehicle_of("jalalmaab_2015", "none").params)
    assert sorted(picture.command.split()[2] for picture in pictures) == sorted(FIGURES)


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("width_px", [1280, 390], ids=["screen", "phone"])
def test_nothing_of_the_page_is_cut(content, material, tmp_path, width_px):
    (tmp_path / "figures").mkdir()
    pages.write(tmp_path, content, drawn(content.frontier, material, vehicle_of("jalalmaab_2015", "none").params))
    # A frame can be narrower than any window; the text of what stands beyond its edge is said.
    look = """
    const frame = document.getElementById("frame");
    frame.onload = () => {
      const page = frame.contentDocument, edge = page.documentElement.clientWidth;
      const cut = [...page.querySelectorAll("h1, h2, p, li, td, th, figure, img, svg")]
        .filter(part => part.getBoundingClientRect().right > edge + 1 && part.checkVisibility())
        .map(part => part.tagName + " " + part.textContent.trim().slice(0, 40));
      document.title = JSON.stringify({wide: page.documentElement.scrollWidth - edge, cut: cut.slice(0, 5)});
    };
    frame.srcdoc = PAGE;
    """
    source = json.dumps((tmp_path / "study.html").read_text()).replace("</", "<\\/")
    (tmp_path / "frame.html").write_text(
        f'<title>-</title><iframe id="frame" style="width:{width_px}px;height:900px;border:0"></iframe>'
        f"<script>{look.replace('PAGE', source)}</script>"
    )
    run = subprocess.run(
        [
            CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=1400,1000", "--virtual-time-budget=5000", "--dump-dom",
            (tmp_path / "frame.html").as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    seen = json.loads(html.unescape(run.stdout.split("<title>")[1].split("</title>")[0]))
    assert seen == {"wide": 0, "cut": []}


def test_the_page_needs_nothing_but_the_numbers(content):
    page = render(pages.page(content, []))
    assert "criteria" in page
    for section, _ in pages.sections(content):
        assert f'<a href="#{anchor(section)}">' in page
        assert f'<h2 id="{anchor(section)}">' in page


def test_answers_follow_from_the_numbers(content):
    holds, program, better, nothing = (made.answer for made in answers.answers(content))
    best = max(answers.savings(content, labels.OURS, "none").values())
    assert f"to {best:.2f} %" in better
    assert "hwfet at friction 0.9" in nothing
    assert "in 0 of 24 cells" in program
    assert f"{content.paper.mean_saving_percent:.2f} %" in holds


def test_the_papers_number_with_three_digits_keeps_them(content):
    first = next(study_tables.paper_tables(content.cells, study_tables.in_order(content)))
    (nycc,) = (row for row in first.rows if first.columns[0].value(row) == "nycc")
    assert first.columns[1].shown(nycc) == "1.585"
    assert first.columns[2].shown(nycc) == "1.58"
