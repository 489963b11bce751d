# SPDX-License-Identifier: Apache-2.0
"""The policy file: what is written comes back, the same bytes every time, and no damage gets through."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager import archive
from iwm_power_manager import policy as policy_module
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.errors import PolicyError
from iwm_power_manager.mdp.budget import Trial
from iwm_power_manager.mdp.demand import Source, demand_chain
from iwm_power_manager.mdp.policy_iteration import solve
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.mdp.sweep import expect_over_demand
from iwm_power_manager.mdp.transitions import build_model
from iwm_power_manager.policy import (
    choose,
    cost_quantum_j,
    load_policy,
    load_policy_bank,
    make_policy,
    policy_bytes,
    save_policy,
)
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"))
AXES = {
    "power_w": np.array([-6000.0, 0.0, 6000.0]),
    "speed_mps": np.array([0.0, 5.0, 20.0]),
    "slip_front": np.array([-0.35, 0.0, 0.1]),
    "slip_rear": np.array([-0.35, 0.0]),
    "share": np.array([0.0, 0.5, 1.0]),
}


def _solved(friction=0.5, previous_share=True):
    fine = load_problem(share_path("config/grids/fine.yaml"))
    problem = dataclasses.replace(fine, name="tiny", **AXES, previous_share=previous_share, discount=0.9)
    if not previous_share:
        problem = dataclasses.replace(problem, switching_cost_j=0.0)
    source = Source("drive", "ab" * 32, 1.5, (np.array([0.0, 6000.0, 0.0, -6000.0, 0.0, 0.0]),))
    chain = demand_chain(problem.power_w, [source])
    solution = solve(build_model(problem, CAR.params, friction, chain.matrix), problem.share, 0.009)
    return make_policy(problem, CAR, friction, chain, [source], solution), solution


@pytest.fixture(scope="module")
def solved():
    return _solved()


@pytest.fixture(scope="module")
def policy(solved):
    return solved[0]


@pytest.fixture(scope="module")
def content(policy):
    return policy_bytes(policy)


def test_a_policy_comes_back_as_it_was_written(policy, tmp_path):
    save_policy(policy, tmp_path / "p.npz")
    again = load_policy(tmp_path / "p.npz")
    for field in dataclasses.fields(policy):
        ours, theirs = getattr(policy, field.name), getattr(again, field.name)
        if field.name == "problem":
            assert ours.settings() == theirs.settings()
        elif field.name == "chain":
            assert np.array_equal(ours.probability, theirs.probability)
            assert np.array_equal(ours.row_steps, theirs.row_steps)
        elif isinstance(ours, np.ndarray):
            assert np.array_equal(ours, theirs)
        else:
            assert ours == theirs


def test_the_same_policy_gives_the_same_bytes(policy, content, tmp_path):
    assert policy_bytes(policy) == content
    save_policy(policy, tmp_path / "p.npz")
    assert policy_bytes(load_policy(tmp_path / "p.npz")) == content
    assert policy_bytes(_solved()[0]) == content


def test_the_file_opens_without_pickles_and_holds_what_the_documentation_says(content):
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        assert set(archive.files) == {
            "front_share", "cost_j", "dearer_cost_j", "demand_probability", "demand_by_speed", "demand_steps",
            "metadata", "checksum",
        }  # fmt: skip
        metadata = json.loads(archive["metadata"].tobytes())
    assert metadata["format_version"] == 2
    assert metadata["vehicle"] == {"name": CAR.name, "hash": CAR.hash, "idle_drive": CAR.idle_drive}
    assert metadata["friction"] == 0.5
    assert metadata["problem"]["discount"] == 0.9
    assert metadata["demand"]["sources"] == [{"name": "drive", "sha256": "ab" * 32, "weight": 1.5, "steps": 5}]
    assert metadata["solver"]["iterations"]
    assert metadata["package_version"]


def test_the_table_holds_the_chosen_share_of_every_state(solved):
    policy, solution = solved
    table = policy.table()
    assert table.front_share.shape == policy.problem.shape == (3, 3, 3, 2, 3)
    for p, v, f, r, s in itertools.product(*map(range, policy.problem.shape)):
        chosen = solution.policy[p, s, (v * 3 + f) * 2 + r]
        # Where skid avoidance decides, the remembered share stays.
        expected = policy.problem.share[s if chosen < 0 else chosen]
        assert table.front_share[p, v, f, r, s] == expected


def test_the_expected_cost_is_the_mean_over_the_next_demand(solved):
    policy, _ = solved
    expected = np.tensordot(policy.chain.probability, policy.cost_j, axes=1)
    assert policy.table().expected_cost_j == pytest.approx(expected, rel=1e-12)


def test_the_expected_cost_has_the_bits_of_the_solver(solved):
    shipped = load_policy(share_path("policies/jalalmaab_2015_drag_coupled_mu050.npz"))
    for policy in (solved[0], shipped):  # with one matrix for all speeds, and with one for each
        cost = policy.cost_j.reshape(policy.cost_j.shape[0], -1)
        ahead, columns = np.empty_like(cost), cost.shape[1]
        plane = columns // policy.problem.speed_mps.size
        expect_over_demand(policy.chain.matrix, cost, columns, plane, 0, columns, ahead)
        assert policy.table().expected_cost_j.tobytes() == ahead.tobytes()


def test_without_a_previous_share_a_gated_axle_has_no_share():
    policy, _ = _solved(previous_share=False)
    braking = policy.front_share[0, :, :, :, 0]
    assert policy.front_share.shape[-1] == 1
    assert np.all(braking[:, 0, 1] == 0.0)
    assert np.all(braking[:, 1:, 0] == 1.0)
    assert np.all(braking[:, 0, 0] == 0.5)


def test_the_stored_cost_is_rounded_within_the_stated_bound(solved):
    policy, solution = solved
    quantum = cost_quantum_j(policy.problem.tolerance_j)
    assert quantum <= policy.problem.tolerance_j / 8.0 < 2.0 * quantum
    stored = policy.cost_j.reshape(3, 18, 3).transpose(0, 2, 1)
    assert np.max(np.abs(stored - solution.cost_j)) <= quantum / 2.0
    assert policy.bound_j == solution.bound_j + quantum / 2.0
    assert policy.converged


def test_a_policy_belongs_to_one_car(policy):
    policy.check_vehicle(CAR)
    other = load_vehicle(CAR.path, "enabled")
    with pytest.raises(PolicyError, match=r"p\.npz: was solved for '.*idle_drive enabled\); solve one"):
        policy.check_vehicle(other, "p.npz")


def test_rule_and_schedule_travel_in_the_table(policy):
    table = policy.table(rule=[1.0, 0.2, 3.0, 0.4], schedule=[0.1, 0.9])
    assert table.rule.tolist() == [1.0, 0.2, 3.0, 0.4]
    assert table.schedule.tolist() == [0.1, 0.9]
    assert policy.table().rule.tolist() == [0.0, 0.5, 0.0, 0.5]


def test_how_much_a_dearer_change_is_shunned_is_what_the_search_for_the_price_found(policy):
    budgeted = dataclasses.replace(policy.problem, changes_per_min=8.0, switching_cost_j=20.0)
    searched = dataclasses.replace(
        policy, problem=budgeted, trials=(Trial(20.0, 8.0), Trial(60.0, 8.0 - 1.6 * np.log(3.0)))
    )
    assert searched.table().elasticity == pytest.approx(0.2)
    assert dataclasses.replace(searched, trials=()).table().elasticity == empty_table().elasticity


def test_strategies_without_a_policy_get_a_table_of_the_same_type(policy):
    table = empty_table()
    assert np.all(table.front_share == 0.5)
    assert table.share.size == 21
    assert empty_table(share=[0, 1]).share.tolist() == [0.0, 1.0]
    for ours, theirs in zip(table, policy.table(), strict=True):
        assert type(ours) is type(theirs)
        if isinstance(ours, np.ndarray):
            assert (ours.dtype, ours.ndim, ours.flags.c_contiguous) == (theirs.dtype, theirs.ndim, True)
    for ours, theirs in zip(table.problem, policy.table().problem, strict=True):
        assert type(ours) is type(theirs)


def _load(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    path.write_bytes(data)
    with pytest.raises(PolicyError) as caught:
        load_policy(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


@settings(max_examples=60)
@given(data=st.data())
def test_a_truncated_file_is_refused(content, tmp_path_factory, data):
    _load(tmp_path_factory, content[: data.draw(st.integers(0, len(content) - 1))])


@settings(max_examples=150)
@given(data=st.data())
def test_a_changed_byte_is_refused_or_changes_nothing(content, tmp_path_factory, data):
    position = data.draw(st.integers(0, len(content) - 1))
    changed = bytearray(content)
    changed[position] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.getbasetemp() / "changed.npz"
    path.write_bytes(changed)
    try:
        again = load_policy(path)
    except PolicyError:
        return
    # Zip's own bookkeeping, such as a date, is no content.
    assert policy_bytes(again) == content


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"PNG or whatever", "is no policy file"),
        (b"PK\x03\x04 but not a zip", "is damaged or truncated"),
    ],
)
def test_a_foreign_file_is_refused(tmp_path_factory, data, words):
    assert words in _load(tmp_path_factory, data)


def test_a_missing_file_is_a_clear_error(tmp_path):
    with pytest.raises(PolicyError, match=r"none\.npz: cannot be read: No such file"):
        load_policy(tmp_path / "none.npz")


def _rebuilt(content, change=lambda metadata: None, arrays=None, drop=(), sign=True):
    """The same file with other metadata or arrays, with a checksum that is right for them."""
    with np.load(io.BytesIO(content)) as archive:
        members = {name: archive[name] for name in archive.files}
    metadata = json.loads(members["metadata"].tobytes())
    replaced = change(metadata)
    metadata = replaced if isinstance(replaced, list) else metadata
    members |= arrays or {}
    raw = json.dumps(metadata).encode()
    members["metadata"] = np.frombuffer(raw, np.uint8)
    if sign:
        checksum = policy_module.checksum_of(members, raw)
        members["checksum"] = np.frombuffer(checksum.encode(), np.uint8)
    output = io.BytesIO()
    np.savez(output, **{name: value for name, value in members.items() if name not in drop})
    return output.getvalue()


def test_another_project_s_npz_is_refused(tmp_path_factory):
    output = io.BytesIO()
    np.savez(output, weights=np.zeros(3))
    assert "holds no metadata" in _load(tmp_path_factory, output.getvalue())


def test_an_object_array_is_not_unpickled(content, tmp_path_factory):
    objects = {"cost_j": np.array([{}], dtype=object)}
    assert "cost_j.npy holds objects" in _load(tmp_path_factory, _rebuilt(content, arrays=objects, sign=False))


def test_an_older_format_says_to_solve_again(content, tmp_path_factory):
    message = _load(tmp_path_factory, _rebuilt(content, lambda m: m.update(format_version=1)))
    assert "has format version 1, this package reads 2: solve it again with solve_policy --vehicle" in message
    assert "--friction 0.5" in message


def test_a_newer_format_says_to_update(content, tmp_path_factory):
    assert "update the package" in _load(tmp_path_factory, _rebuilt(content, lambda m: m.update(format_version=3)))


def test_an_edit_without_a_new_checksum_is_refused(content, tmp_path_factory):
    message = _load(tmp_path_factory, _rebuilt(content, lambda m: m.update(friction=0.9), sign=False))
    assert "does not match its checksum" in message
    shares = {"front_share": np.ones((3, 3, 3, 2, 3))}
    assert "does not match its checksum" in _load(tmp_path_factory, _rebuilt(content, arrays=shares, sign=False))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(format="spreadsheet"), "its format is 'spreadsheet'"),
        (lambda m: m.pop("format"), "metadata cannot be read"),
        (lambda m: [1], "metadata cannot be read"),
        (lambda m: m.pop("vehicle"), "metadata is incomplete: KeyError('vehicle')"),
        (lambda m: m["problem"].update(discount=2), "discount: 2 is out of range"),
        (
            lambda m: m["problem"].update(share=[0, 1]),
            "front_share has shape (3, 3, 3, 2, 3), its axes say (3, 3, 3, 2, 2)",
        ),
        (lambda m: m["solver"].update(iterations=[[1]]), "metadata is incomplete"),
        (lambda m: m["problem"].update(name="\x1b[2J"), r"problem.name: '\x1b[2J' is no name; allowed: a printable"),
        (lambda m: m["vehicle"].update(name="two\nlines"), r"vehicle.name: 'two\nlines' is no name"),
    ],
)
def test_metadata_that_cannot_be_right_is_refused_even_with_a_right_checksum(content, tmp_path_factory, change, words):
    assert words in _load(tmp_path_factory, _rebuilt(content, change))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("cost_j", np.full((3, 3, 3, 2, 3), np.nan), "cost_j holds a value that is not finite"),
        ("front_share", np.full((3, 3, 3, 2, 3), 1.5), "front_share holds a value outside 0 to 1"),
        ("cost_j", np.full((3, 3, 3, 2, 3), 1e308), "cost_j holds a value outside -1e+15 to 1e+15"),
        ("demand_steps", np.full(3, -1.0), "demand_steps holds a value outside 0 to 1e+15"),
        ("demand_probability", np.eye(3) * 0.9, "a row of demand_probability is no distribution"),
        ("demand_steps", np.zeros(2), "demand_steps has shape (2,)"),
        ("cost_j", np.zeros((3, 3, 3, 2, 3), np.float32), "cost_j holds float32, not float64"),
    ],
)
def test_arrays_that_cannot_be_right_are_refused_even_with_a_right_checksum(
    content, tmp_path_factory, name, value, words
):
    assert words in _load(tmp_path_factory, _rebuilt(content, arrays={name: value}))


def test_a_file_that_would_unpack_to_gigabytes_is_refused(content, tmp_path_factory, monkeypatch):
    monkeypatch.setattr(archive, "MAX_ARRAY_BYTES", 1000)
    assert "bytes, more than 1,000" in _load(tmp_path_factory, content)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(friction=float("nan")), "its metadata cannot be read"),
        (lambda m: m.update(friction=1e9), "friction: 1000000000.0 is out of range"),
        (lambda m: m.update(friction="0.5"), "friction: '0.5' is no number"),
        (lambda m: m.update(friction=10**400), "friction: inf is not finite"),
        (lambda m: m["solver"].update(bound_j=-1.0), "bound_j: -1.0 is out of range"),
        (lambda m: m["demand"].update(clipped=2.0), "clipped: 2.0 is out of range"),
    ],
)
def test_numbers_of_the_metadata_are_checked(content, tmp_path_factory, change, words):
    assert words in _load(tmp_path_factory, _rebuilt(content, change))


def test_a_bank_is_sorted_by_friction_and_chosen_by_ratio(tmp_path):
    for friction in (0.9, 0.2, 0.5):
        save_policy(_solved(friction)[0], tmp_path / f"{friction}.npz")
    bank = load_policy_bank(tmp_path)
    assert [policy.friction for policy in bank] == [0.2, 0.5, 0.9]
    chosen = {mu: choose(bank, mu).friction for mu in (0.01, 0.2, 0.31, 0.32, 0.5, 0.66, 0.68, 1.5)}
    assert chosen == {0.01: 0.2, 0.2: 0.2, 0.31: 0.2, 0.32: 0.5, 0.5: 0.5, 0.66: 0.5, 0.68: 0.9, 1.5: 0.9}
    assert [policy.friction for policy in load_policy_bank(tmp_path / "0.5.npz")] == [0.5]
    save_policy(_solved(0.5)[0], tmp_path / "again.npz")
    with pytest.raises(PolicyError, match=r"again\.npz: is for friction 0\.5, as is 0\.5\.npz"):
        load_policy_bank(tmp_path)


def test_a_bank_is_for_one_car(policy, tmp_path):
    save_policy(policy, tmp_path / "a.npz")
    other = dataclasses.replace(policy, friction=0.7, vehicle_hash="0" * 16, checksum="")
    save_policy(other, tmp_path / "b.npz")
    with pytest.raises(PolicyError, match="a bank holds one car's policies"):
        load_policy_bank(tmp_path)


def test_of_a_folder_for_several_cars_a_car_gets_its_own(policy, tmp_path):
    save_policy(policy, tmp_path / "a.npz")
    other = dataclasses.replace(policy, vehicle_hash="0" * 16, checksum="")
    save_policy(other, tmp_path / "b.npz")
    car = SimpleNamespace(name="car", hash=policy.vehicle_hash, idle_drive="drag")
    assert [found.vehicle_hash for found in load_policy_bank(tmp_path, car)] == [policy.vehicle_hash]
    with pytest.raises(PolicyError, match=r"b\.npz: was solved for"):
        load_policy_bank(tmp_path / "b.npz", car)
    car.hash = "1" * 16
    words = r"holds no policy for 'car' \(1{16}, idle_drive drag\), only for '.+' \(0{16}, .+\), '.+' \([0-9a-f]{16}, "
    with pytest.raises(PolicyError, match=words):
        load_policy_bank(tmp_path, car)


def test_an_empty_bank_and_an_impossible_friction_are_refused(policy, tmp_path):
    with pytest.raises(PolicyError, match="holds no policy file"):
        load_policy_bank(tmp_path)
    with pytest.raises(PolicyError, match="no policy to choose from"):
        choose([], 0.5)
    with pytest.raises(PolicyError, match="friction nan is out of range"):
        choose([policy], float("nan"))
