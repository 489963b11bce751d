# SPDX-License-Identifier: Apache-2.0
"""Cell search and multilinear interpolation against NumPy and SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from iwm_power_manager import grid

INTERPOLATE = {
    1: grid.interpolate1,
    2: grid.interpolate2,
    3: grid.interpolate3,
    4: grid.interpolate4,
    5: grid.interpolate5,
}


@st.composite
def axes(draw, least=1, most=6):
    steps = draw(st.lists(st.floats(0.01, 10.0), min_size=least - 1, max_size=most - 1))
    return draw(st.floats(-5.0, 5.0)) + np.concatenate([[0.0], np.cumsum(steps)])


@given(axes(), st.floats(-100.0, 100.0))
def test_locate_clamps_and_finds_the_cell(axis, x):
    i, fraction = grid.locate(axis, x)
    assert 0 <= i <= max(axis.size - 2, 0)
    assert 0.0 <= fraction <= 1.0
    right = axis[min(i + 1, axis.size - 1)]
    assert axis[i] + fraction * (right - axis[i]) == pytest.approx(np.clip(x, axis[0], axis[-1]), abs=1e-9)


@given(axes())
def test_locate_is_exact_at_every_grid_point(axis):
    for k, x in enumerate(axis):
        i, fraction = grid.locate(axis, x)
        assert (i + fraction) == k
        assert grid.nearest(axis, x) == k


@given(axes(), st.floats(-20.0, 80.0))
def test_nearest_is_the_point_at_the_least_distance(axis, x):
    assert abs(axis[grid.nearest(axis, x)] - x) == pytest.approx(np.min(np.abs(axis - x)), abs=1e-9)


def test_a_coordinate_that_is_nan_gives_nan():
    i, fraction = grid.locate(np.array([0.0, 1.0]), math.nan)
    assert i == 0
    assert math.isnan(fraction)
    assert math.isnan(grid.interpolate1(np.array([1.0, 2.0]), i, fraction))


@pytest.mark.parametrize("dimensions", [2, 3, 4, 5])
@settings(max_examples=20)
@given(data=st.data())
def test_interpolation_agrees_with_scipy_inside_and_holds_the_edge_outside(dimensions, data):
    points = [data.draw(axes(least=2, most=4)) for _ in range(dimensions)]
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    table = rng.normal(size=[axis.size for axis in points])
    reference = RegularGridInterpolator(points, table)
    for _ in range(5):
        x = [rng.uniform(axis[0] - 1.0, axis[-1] + 1.0) for axis in points]
        cells = [number for axis, value in zip(points, x, strict=True) for number in grid.locate(axis, value)]
        inside = [np.clip(value, axis[0], axis[-1]) for axis, value in zip(points, x, strict=True)]
        assert INTERPOLATE[dimensions](table, *cells) == pytest.approx(reference(inside)[0], abs=1e-9)


@given(data=st.data())
def test_interpolation_without_slices_has_the_same_bits(data):
    points = [data.draw(axes(most=4)) for _ in range(5)]
    shape = [axis.size for axis in points]
    table = np.random.default_rng(data.draw(st.integers(0, 1000))).normal(size=shape)
    c, d = (data.draw(st.integers(0, size - 1)) for size in shape[2:4])
    x = {}
    for axis in (0, 1, 4):
        edges = st.sampled_from([*points[axis], math.nan])
        x[axis] = data.draw(edges | st.floats(points[axis][0] - 1.0, points[axis][-1] + 1.0))
    a, b, e = (grid.ends(points[axis], value) for axis, value in x.items())
    cells = [grid.locate(points[axis], x.get(axis, points[axis][k])) for axis, k in enumerate((0, 0, c, d, 0))]
    expected = grid.interpolate5(table, *[number for cell in cells for number in cell])
    assert np.float64(grid.interpolate3_of_5(table, a, b, c, d, e)).tobytes() == np.float64(expected).tobytes()


def test_axes_of_one_point_do_not_matter():
    table = np.arange(3.0).reshape(1, 3, 1, 1, 1)
    single = np.zeros(1)
    place = grid.locate(np.array([0.0, 1.0, 2.0]), 1.25)
    other = grid.locate(single, 7.0)
    assert grid.interpolate5(table, *other, *place, *other, *other, *other) == pytest.approx(1.25)


def test_an_infinite_neighbour_does_not_reach_a_grid_point():
    table = np.array([1.0, math.inf])
    assert grid.interpolate1(table, 0, 0.0) == 1.0
    assert grid.interpolate1(table[::-1].copy(), 0, 1.0) == 1.0
