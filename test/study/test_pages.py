"""The study's pages: from the stored numbers alone, and what docs/study.md shows is what they say."""

import json
from pathlib import Path

import numpy as np
import pytest

from iwm_power_manager.errors import ConfigError
from iwm_sim.study import battery_fit, criteria, pages, paper
from iwm_sim.study.cases import Rule, vehicle_of
from iwm_sim.study.report import render
from iwm_sim.study.reproduce import Material

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def content():
    return json.loads((DOCS / "study.json").read_text())


@pytest.fixture(scope="module")
def material():
    time = np.arange(0.0, 30.0, 0.1)
    wave = np.sin(time)
    window = {
        label: {"time_s": time, "front_power_w": wave, "rear_power_w": wave, "front_slip": wave, "rear_slip": wave}
        for label in (criteria.ED, criteria.OURS, pages.GATE_OFF, pages.GATE_TABLE_2)
    }
    estimate = battery_fit.Estimate(0.05, 240.0, 1e-5, {"hill": 1e-5})
    comparison = battery_fit.Comparison(time, wave, wave, 0.8 - time / 1e4, 0.8 - time / 1e4)
    return Material(
        battery=battery_fit.Fit(estimate, estimate, estimate, estimate, comparison),
        rule=Rule((0.0, 0.6, 0.0, 0.4), 1e3 * wave, np.abs(wave)),
        convergence=(np.array([10.0, 1.0, 0.0]), np.array([1.0, 0.1, 0.01])),
        window=window,
        chain=(np.array([[0.9, 0.1], [0.5, 0.5]]), np.array([0.0, 1e3])),
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
    slew = content["settings"]["slew_down_nmps"]
    again = criteria.check(content["cells"], content["stops"], slew)
    assert [(made.text, made.met) for made in again] == [(row["text"], row["met"]) for row in content["criteria"]]


def test_every_cell_of_the_paper_stands_beside_ours(content):
    tables = [table for table in pages.tables(content) if table.section.startswith("Tables 3 to 5")]
    assert len(tables) == 6
    for table in tables:
        assert [row["cycle"] for row in table.rows] == list(paper.CYCLES)
        assert all({"paper_ED", "paper_SDP", "ED", "SDP", "ours_saving"} <= set(row) for row in table.rows)


def test_all_strategies_were_driven_in_all_24_cells(content):
    by_cell = criteria.cells(content["cells"])
    assert len(by_cell) == 24
    labels = {criteria.ED, criteria.GRDP, criteria.INSTANTANEOUS, criteria.OURS, criteria.BOUND, pages.PAPER_SDP}
    assert all(labels <= set(by) for by in by_cell.values())


def test_a_printed_saving_beyond_the_possible_one_is_called_so():
    def cell(reached, possible):
        return {
            pages.PAPER_SDP: {"saving_percent": reached},
            pages.FREE_BOUND: {"saving_percent": possible},
        }

    assert "more than any split" in pages._verdict(3.0, cell(1.0, 2.0), cell(0.1, 0.5))
    assert "only if an idle axle costs nothing" in pages._verdict(1.0, cell(1.5, 2.0), cell(0.1, 0.5))
    assert "reaches it" in pages._verdict(1.0, cell(1.5, 2.0), cell(0.1, 0.5))
    assert "saves nothing" in pages._verdict(0.3, cell(-0.5, 2.0), cell(0.1, 0.5))
    assert "cannot be compared" in pages._verdict(0.3, cell(None, 2.0), cell(0.1, 0.5))


def test_page_markdown_and_pictures_are_written(content, material, tmp_path):
    (tmp_path / "figures").mkdir()
    pictures = pages.drawn(content, material, vehicle_of("jalalmaab_2015", "none").params)
    pages.write(tmp_path, content, pictures)
    files = [path.name for path in (tmp_path / "figures").iterdir()]
    for number in ("07", "08", "09", "10", "12", "13", "14", "15"):
        assert any(name.startswith(f"figure_{number}_") for name in files)
    page = (tmp_path / "study.html").read_text()
    assert all(picture.title in page for picture in pictures)
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert (tmp_path / "study.md").read_text().startswith(f"# {pages.TITLE}")


def test_the_page_needs_nothing_but_the_numbers(content):
    assert "criteria" in render(pages.page(content, []))
