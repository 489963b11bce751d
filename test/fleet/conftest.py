# SPDX-License-Identifier: Apache-2.0
"""A small fleet on a short cycle, and two worker processes that all tests of this folder share."""

from collections.abc import Iterator

import pytest
from distributed import Client

from iwm_sim.cluster import connected
from iwm_sim.fleet.plan import Plan, plan_of
from iwm_sim.fleet.run import runner
from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Drive
from study_fixtures import hill, small_grid

__all__ = ["hill", "small_grid"]


@pytest.fixture(scope="session")
def fleet(hill) -> Plan:
    """Two masses of a car on five roads."""
    cars = [{"vehicle": "jalalmaab_2015", "idle_drive": "none", "change": {"chassis.mass_kg": [700, 900]}}]
    content = {"format": 1, "cars": cars, "cycles": [str(hill)], "friction": [0.9, 0.7, 0.5, 0.3, 0.2]}
    return plan_of("fleet.yaml", content | {"strategies": ["instantaneous"], "dt_s": 0.02})


@pytest.fixture(scope="session")
def serial(fleet, tmp_path_factory) -> Store:
    """The fleet, driven in this process."""
    store = Store(tmp_path_factory.mktemp("serial") / "study")
    with runner(store, fleet.files, None, 1, 0.0) as running:
        running.run(Drive, fleet.drives)
    return store


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """Two worker processes."""
    with connected(None, 2) as made:
        yield made
