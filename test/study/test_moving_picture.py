# SPDX-License-Identifier: Apache-2.0
"""A drive as a moving picture."""

import numpy as np
import pytest
from PIL import Image

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.closed_loop import COLUMNS, Run
from iwm_sim.plant import initial_plant
from iwm_sim.study.moving_picture import FRAMES_PER_S, TIMES_FASTER, animate


@pytest.fixture(scope="module")
def run():
    """Six seconds: front alone, then both axles, then braking."""
    series = np.zeros((600, len(COLUMNS)))
    drive = Run(0.01, series, initial_plant(load_vehicle(resolve("config/vehicles/jalalmaab_2015.yaml")).params, 0.8))
    drive["time_s"][:] = np.arange(600) * 0.01
    drive["speed_mps"][:] = 10.0
    drive["distance_m"][:] = 0.1 * np.arange(600)
    drive["front_share"][:] = np.repeat([1.0, 0.5, 0.5], 200)
    drive["front_motor_nm"][:] = np.repeat([80.0, 40.0, -30.0], 200)
    drive["rear_motor_nm"][:] = np.repeat([0.0, 40.0, -30.0], 200)
    return drive


def test_it_moves_as_fast_as_it_says_and_shows_what_each_wheel_does(run, tmp_path):
    animate(run, tmp_path / "drive.gif", "three parts")
    with Image.open(tmp_path / "drive.gif") as made:
        shown_s = made.n_frames * made.info["duration"] / 1000.0
        colours = [set(), set()]
        for seen, frame in zip(colours, (0, made.n_frames - 1), strict=True):
            made.seek(frame)
            seen.update(colour for _, colour in made.convert("RGB").crop((0, 60, 250, 280)).getcolors(1 << 20))
    assert shown_s == pytest.approx(6.0 / TIMES_FASTER, abs=2.0 / FRAMES_PER_S)
    assert len(colours[1] - colours[0]) > 0, "braking has a colour of its own"
    assert (tmp_path / "drive.gif").stat().st_size < 1_000_000


def test_another_kind_of_file_is_refused(run, tmp_path):
    with pytest.raises(ConfigError, match=r"cannot hold a moving picture"):
        animate(run, tmp_path / "drive.mp4", "")
