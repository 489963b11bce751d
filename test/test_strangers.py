# SPDX-License-Identifier: Apache-2.0
"""Whatever a file holds, a loader takes it or refuses it in one printable line: made, mutated and cut files."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.cycle_import import read_log, to_cycle
from iwm_power_manager.errors import MAX_MESSAGE, IwmError
from iwm_power_manager.files import read_yaml
from iwm_power_manager.mdp.demand_counts import load_transitions
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.motor_import import read_points
from iwm_power_manager.motor_map import map_of, read_map
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.vehicle import load_vehicle

CAR = share_path("config/vehicles/jalalmaab_2015.yaml")
TWO = share_path("config/vehicles/compact_two_motors.yaml")
GRID = share_path("config/grids/coupled.yaml")
MAPPING = share_path("config/signals/odometry_and_pedals.yaml")
CYCLE = share_path("config/cycles/nycc.csv")
MAP = share_path("config/motors/siemens_pm_7500w.csv")
POLICY = share_path("policies/jalalmaab_2015_drag_coupled_mu090.npz")


def _log(path):
    to_cycle(read_log(path), "bridge", 3.0, 0.5, 10.0)


def _motor(path):
    map_of(path, read_points(path).efficiency)


YAML_LOADERS = [(load_vehicle, CAR), (load_vehicle, TWO), (load_problem, GRID), (load_mapping, MAPPING)]
TABLE_LOADERS = [(load_cycle, CYCLE), (read_map, MAP), (_log, CYCLE), (_motor, MAP)]

#: Values that have broken a loader somewhere.
# fmt: off
NASTY = st.sampled_from([
    "1_0", "017", "9" * 400, "1" + "0" * 5000, "-1e400", ".nan", "-.inf", "nan", "", "!!bool maybe", "!!int x", "*a",
    "&a [*a]", "[" * 200, "{a: " * 200, "\u0661", "\u2212", "1e-999", "~", "\x1b[31m", "\u202e", "5e-324", "!!binary x",
    "2020-13-45", "<<: 1", "1:30", "'", '"', "\t", "- 1", "? [a]", "!!python/object/apply:os.system [ls]", "x" * 9000,
])
# fmt: on
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.integers(10**300, 10**310) | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


def survives(load, path: Path):
    """The loader takes the file, or refuses it in one printable line of bounded length."""
    try:
        load(path)
    except IwmError as error:
        text = str(error)
        assert text.isprintable()
        assert len(text) <= MAX_MESSAGE + 3


def mutated(data, text: str) -> str:
    """A text with some of its words replaced, dropped, doubled or cut."""
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(text)))
        stop = min(start + data.draw(st.integers(0, 12)), len(text))
        text = text[:start] + data.draw(NASTY | st.text(max_size=6) | st.just(text[start:stop] * 2)) + text[stop:]
    return text[: data.draw(st.integers(0, len(text)))] if data.draw(st.booleans()) else text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("strangers")


@pytest.mark.parametrize(("load", "source"), YAML_LOADERS, ids=["vehicle", "two axles", "grid", "mapping"])
@given(data=st.data())
def test_a_mutated_yaml_is_read_or_refused(load, source, folder, data):
    path = folder / "mutated.yaml"
    path.write_bytes(mutated(data, source.read_text()).encode("utf-8", "surrogatepass"))
    survives(load, path)


def _places(content, path=()):
    yield path
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _places(value, (*path, key))


@pytest.mark.parametrize(("load", "source"), YAML_LOADERS, ids=["vehicle", "two axles", "grid", "mapping"])
@given(data=st.data())
def test_a_yaml_with_any_value_anywhere_is_read_or_refused(load, source, folder, data):
    content = read_yaml(source)
    place = data.draw(st.sampled_from([p for p in _places(content) if p]))
    parent = content
    for key in place[:-1]:
        parent = parent[key]
    parent[place[-1]] = data.draw(VALUES)
    path = folder / "made.yaml"
    path.write_text(yaml.safe_dump(content))
    survives(load, path)


@pytest.mark.parametrize(("load", "source"), TABLE_LOADERS, ids=["cycle", "map", "log", "motor table"])
@given(data=st.data())
def test_a_mutated_table_is_read_or_refused(load, source, folder, data):
    path = folder / "mutated.csv"
    lines = source.read_text().splitlines()
    few = "\n".join(lines[: data.draw(st.integers(1, 40))])
    path.write_bytes(mutated(data, few).encode("utf-8", "surrogatepass"))
    survives(load, path)


@pytest.mark.parametrize(("load", "source"), TABLE_LOADERS, ids=["cycle", "map", "log", "motor table"])
@given(
    rows=st.lists(st.lists(st.floats() | st.integers() | NASTY, min_size=1, max_size=4), max_size=8),
    separator=st.sampled_from([",", ";", "\t", " "]),
)
@example(rows=[[0.0, 0.0], [5e-324, 70.0]], separator=",")
def test_a_made_table_is_read_or_refused(load, source, folder, rows, separator):
    path = folder / "made.csv"
    header = source.read_text().splitlines()[0].replace(",", separator)
    text = "\n".join([header, *(separator.join(map(str, row)) for row in rows)])
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    survives(load, path)


@pytest.mark.parametrize("load", [load_policy, load_transitions], ids=["policy", "transitions"])
@given(data=st.data())
def test_a_mutated_archive_is_read_or_refused(load, folder, data):
    content = bytearray(POLICY.read_bytes()[-4000:] if data.draw(st.booleans()) else POLICY.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 6))] = data.draw(st.binary(max_size=6))
    path = folder / "mutated.npz"
    path.write_bytes(content)
    survives(load, path)


@pytest.mark.parametrize(
    "load", [load for load, _ in (*YAML_LOADERS[1:], *TABLE_LOADERS)] + [load_policy, load_transitions]
)
@pytest.mark.parametrize("name", ["/dev/zero", "/dev/stdin", ".", "/proc/self/mem", "nowhere\nelse"])
def test_what_is_no_file_is_refused_by_every_loader(load, name):
    with pytest.raises(IwmError) as caught:
        load(Path(name))
    assert str(caught.value).isprintable()
