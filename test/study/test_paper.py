# SPDX-License-Identifier: Apache-2.0
"""What the paper prints, and what follows from it alone (docs/model.md, errors in the paper)."""

import pytest

from iwm_power_manager.vehicle import pack_energy_wh
from iwm_sim.study import paper
from iwm_sim.study.cases import cycle_of, vehicle_of


@pytest.fixture(scope="module")
def implied():
    cycles = {name: cycle_of(name) for name in paper.CYCLES}
    pack = pack_energy_wh(vehicle_of("jalalmaab_2015", "none").params.battery)
    distance = {name: cycle.distance_m for name, cycle in cycles.items()}
    return paper.consequences(pack, distance, {n: distance[n] / cycle.duration_s for n, cycle in cycles.items()})


def test_printed_depletion_means_an_energy_no_such_car_needs(implied):
    assert min(implied.wh_per_km.values()) == pytest.approx(348.0, abs=1.0)
    assert max(implied.wh_per_km.values()) == pytest.approx(428.0, abs=1.0)
    assert implied.mean_power_w["hwfet"] > 4 * 7500.0  # more than all four motors give


def test_three_percent_on_average_hang_on_one_cell(implied):
    assert implied.mean_saving_percent == pytest.approx(3.08, abs=0.005)
    assert implied.mean_saving_without_nycc_on_ice_percent == pytest.approx(1.31, abs=0.005)
    assert implied.median_saving_percent == pytest.approx(1.02, abs=0.005)


def test_printed_savings_are_those_of_the_printed_depletions(implied):
    assert implied.largest_misprint_percent <= 0.0051


def test_grdp_beats_ed_in_eleven_of_twelve_cells(implied):
    assert (implied.grdp_beats_ed, implied.cells) == (11, 12)


def test_second_column_of_table_6_repeats_the_savings_of_table_3(implied):
    assert implied.table_6_repeats_table_3 is True
