# SPDX-License-Identifier: Apache-2.0
"""The policy file: write it, verify it, and hand its tables to the control law.

A policy is one `.npz` without pickles. Its members:

=====================  ==========================================================================================
front_share            float64[P, V, F, R, S], the control of every state: P_front / P_demand
cost_j                 float64[P, V, F, R, S], cost-to-go, J, rounded to a power of two below the tolerance
dearer_cost_j          float64[D, P, V, F, R, S], the same where a change costs `control.budget.DEARER` times as much;
                       D = 0 without a budget of changes
demand_probability     float64[P, P], transition matrix of the power demand
demand_by_speed        float64[V, P, P], the same for each speed; float64[0, P, P] if it does not depend on the speed
demand_steps           float64[P], (weighted) steps counted in each of its rows
metadata               JSON text as bytes: format, versions, vehicle with its hash, cycles with theirs, friction, every
                       setting of the problem (with the axes), and the solver's iterations and bound
checksum               SHA-256 over all of the above
=====================  ==========================================================================================

The axes are power demand, speed, slip front, slip rear and previous front share. The same policy always gives the same
bytes: no time, path or thread count is in the file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager import __version__
from iwm_power_manager.archive import read_npz
from iwm_power_manager.control.budget import DEARER
from iwm_power_manager.control.strategies import STRATEGIES, name_of
from iwm_power_manager.control.table import PolicyTable, as_vector, empty_table
from iwm_power_manager.errors import ConfigError, PolicyError
from iwm_power_manager.files import atomic_write, check_name, check_number, content_sha256
from iwm_power_manager.mdp.budget import Trial, elasticity_of
from iwm_power_manager.mdp.demand import DemandChain, Source
from iwm_power_manager.mdp.policy_iteration import Iteration, Solution
from iwm_power_manager.mdp.problem import FORMAT as PROBLEM_FORMAT
from iwm_power_manager.mdp.problem import Problem, problem_from
from iwm_power_manager.mdp.sweep import GATED
from iwm_power_manager.model.decision import (
    axles_gated,
)
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import Vehicle

FORMAT_NAME = "iwm_power_manager policy"
FORMAT_VERSION = 2

_ARRAYS = ("front_share", "cost_j", "dearer_cost_j", "demand_probability", "demand_by_speed", "demand_steps")
_MEMBERS = (*_ARRAYS, "metadata", "checksum")
#: Peak friction coefficients a policy may be for.
FRICTION_RANGE = (0.01, 2.0)
#: Zip's earliest date: a file's bytes must not depend on when it was written.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, eq=False)
class Policy:
    """A solved policy with all it was made from.

    Attributes
    ----------
    problem : grids and settings
    friction : peak friction coefficient it was solved for
    front_share, cost_j : float64[P, V, F, R, S]
    dearer_cost_j : float64[D, P, V, F, R, S], cost-to-go at `control.budget.DEARER` times the price of a change
    trials : prices tried for the budget of changes, with the changes a minute of each; empty if none was searched
    chain : the demand's Markov chain
    vehicle_name, vehicle_hash, idle_drive : the car it was solved for
    sources : of the demand: name, sha256, weight, steps
    iterations : of the solver (the paper's Fig. 12)
    bound_j : certified max-norm distance of `cost_j` from the optimal cost-to-go
    converged : whether bound_j is within the problem's tolerance
    package_version : that solved it
    residual_j : max norm of the Bellman residual of `cost_j`, J, where it was computed after solving; else None
    checksum : SHA-256 of the content, 64 hex digits: the policy's identity
    """

    problem: Problem
    friction: float
    front_share: NDArray[np.float64]
    cost_j: NDArray[np.float64]
    dearer_cost_j: NDArray[np.float64]
    trials: tuple[Trial, ...]
    chain: DemandChain
    vehicle_name: str
    vehicle_hash: str
    idle_drive: str
    sources: tuple[Mapping[str, Any], ...]
    iterations: tuple[Iteration, ...]
    bound_j: float
    converged: bool
    package_version: str
    checksum: str
    residual_j: float | None = None

    def __repr__(self) -> str:
        return (
            f"Policy({self.vehicle_name}, idle drive {self.idle_drive}, friction {self.friction:g}, "
            f"grid {self.problem.name}, {' x '.join(map(str, self.problem.shape))} states, {self.checksum[:12]})"
        )

    @property
    def identity(self) -> str:
        """Grid and checksum, as results name their policy."""
        return f"{self.problem.name} {self.checksum[:8]}"

    @property
    def proven_j(self) -> float | None:
        """What the residual proves: distance of `cost_j` from the optimal cost-to-go at most, J."""
        return None if self.residual_j is None else self.residual_j / (1.0 - self.problem.discount)

    def cost_by_state_j(self) -> NDArray[np.float64]:
        """`cost_j` as the solver has it: float64[P, S, C]."""
        powers, _, _, _, shares = self.problem.shape
        return np.ascontiguousarray(self.cost_j.reshape(powers, -1, shares).transpose(0, 2, 1))

    def check_vehicle(self, vehicle: Vehicle, name: str = "policy") -> None:
        """Raise `PolicyError` unless this policy was solved for this car: for every number the decision model reads."""
        if self.vehicle_hash != vehicle.hash:
            raise PolicyError(
                f"{name}: was solved for {_car(self.vehicle_name, self.vehicle_hash, self.idle_drive)}, not for "
                f"{_car(vehicle.name, vehicle.hash, vehicle.idle_drive)}; solve one for this car with solve_policy"
            )

    def table(self, rule: Sequence[float] = (), schedule: Sequence[float] = ()) -> PolicyTable:
        """The numbers for the control law."""
        problem = self.problem

        def expected(cost_j: NDArray[np.float64]) -> NDArray[np.float64]:
            """As `expect_over_demand`, to the last bit, but with nothing to compile before the first command."""
            cost = np.ascontiguousarray(cost_j).reshape(problem.power_w.size, problem.speed_mps.size, -1)
            ahead = np.zeros_like(cost)
            for q, weight in enumerate(self.chain.matrix.transpose(2, 1, 0)[..., np.newaxis]):
                reached = weight.any(axis=(1, 2))
                ahead[reached] += weight[reached] * cost[q]
            return ahead.reshape(problem.shape)

        dearer = np.zeros((len(self.dearer_cost_j), *problem.shape))
        for level, cost_j in enumerate(self.dearer_cost_j):
            dearer[level] = expected(cost_j)
        return PolicyTable(
            power_w=problem.power_w,
            speed_mps=problem.speed_mps,
            slip_front=problem.slip_front,
            slip_rear=problem.slip_rear,
            previous_share=problem.previous_shares,
            share=problem.share,
            front_share=np.ascontiguousarray(self.front_share),
            expected_cost_j=expected(self.cost_j),
            discount=problem.discount,
            switching_cost_j=problem.switching_cost_j,
            switching_fixed_cost_j=problem.switching_fixed_cost_j,
            problem=problem.params(self.friction),
            rule=as_vector(rule, 4),
            schedule=as_vector(schedule, 1),
            changes_per_min=problem.changes_per_min,
            dearer_cost_j=dearer,
            elasticity=elasticity_of(self.trials, problem.switching_cost_j, problem.changes_per_min),
        )


def cost_quantum_j(tolerance_j: float) -> float:
    """Step to which the stored cost-to-go is rounded: the largest power of two up to an eighth of the tolerance.

    Rounding makes the file a third of its size and hides the last bits, in which mathematical libraries differ.
    """
    return 2.0 ** math.floor(math.log2(tolerance_j / 8.0))


def make_policy(
    problem: Problem,
    vehicle: Vehicle,
    friction: float,
    chain: DemandChain,
    sources: Sequence[Source],
    solution: Solution,
    dearer: Sequence[Solution] = (),
    trials: Sequence[Trial] = (),
) -> Policy:
    """A `Policy` from a solution. Its bound includes the rounding of the cost-to-go.

    Parameters
    ----------
    dearer : solutions at `control.budget.DEARER` times the problem's price of a change; none without a budget
    trials : prices tried for the budget
    """
    quantum = cost_quantum_j(problem.tolerance_j)

    def rounded(cost_j: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.round(cost_j / quantum) * quantum + 0.0

    bound = solution.bound_j + quantum / 2.0
    front_share = np.append(problem.share, np.nan)[solution.policy]
    gated = solution.policy == GATED
    if problem.previous_share:
        front_share[gated] = np.broadcast_to(problem.share[None, :, None], gated.shape)[gated]
    else:
        params = problem.params(friction)
        f, r = problem.slip_front.size, problem.slip_rear.size
        for p, _, c in np.argwhere(gated):
            front, rear = axles_gated(
                problem.power_w[p], problem.slip_front[c // r % f], problem.slip_rear[c % r], params
            )
            front_share[p, 0, c] = 0.5 if front and rear else 0.0 if front else 1.0

    def table(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.ascontiguousarray(values.transpose(0, 2, 1)).reshape(problem.shape)

    policy = Policy(
        problem=problem,
        friction=float(friction),
        front_share=table(front_share),
        cost_j=table(rounded(solution.cost_j)),
        dearer_cost_j=np.array([table(rounded(other.cost_j)) for other in dearer]).reshape(-1, *problem.shape),
        trials=tuple(trials),
        chain=chain,
        vehicle_name=vehicle.name,
        vehicle_hash=vehicle.hash,
        idle_drive=vehicle.idle_drive,
        sources=tuple(
            {"name": s.name, "sha256": s.sha256, "weight": float(s.weight), "steps": s.steps} for s in sources
        ),
        iterations=solution.iterations,
        bound_j=bound,
        converged=bool(bound <= problem.tolerance_j),
        package_version=__version__,
        checksum="",
    )
    return _with_checksum(policy)


def with_residual(policy: Policy, residual_j: float) -> Policy:
    """The policy with the Bellman residual of its cost-to-go, J: another file, another checksum."""
    return _with_checksum(dataclasses.replace(policy, residual_j=residual_j))


def _with_checksum(policy: Policy) -> Policy:
    arrays, metadata = _content(policy)
    return dataclasses.replace(policy, checksum=checksum_of(arrays, metadata))


def _content(policy: Policy) -> tuple[dict[str, NDArray[np.float64]], bytes]:
    arrays = {
        "front_share": policy.front_share,
        "cost_j": policy.cost_j,
        "dearer_cost_j": policy.dearer_cost_j,
        "demand_probability": policy.chain.probability,
        "demand_by_speed": policy.chain.by_speed,
        "demand_steps": policy.chain.row_steps,
    }
    metadata: dict[str, Any] = {
        "format": FORMAT_NAME,
        "format_version": FORMAT_VERSION,
        "package_version": policy.package_version,
        "vehicle": {"name": policy.vehicle_name, "hash": policy.vehicle_hash, "idle_drive": policy.idle_drive},
        "friction": policy.friction,
        "problem": policy.problem.settings(),
        "demand": {"sources": list(policy.sources), "clipped": policy.chain.clipped},
        "solver": {
            "method": "inexact policy iteration, BiCGSTAB",
            "bound_j": policy.bound_j,
            "converged": policy.converged,
            "columns": list(Iteration._fields),
            "iterations": [list(iteration) for iteration in policy.iterations],
            "prices_tried": [list(trial) for trial in policy.trials],
        },
    }
    if policy.residual_j is not None:
        metadata["solver"]["residual_j"] = policy.residual_j
        metadata["solver"]["proven_j"] = policy.proven_j
    return arrays, json.dumps(metadata, indent=1, sort_keys=True, allow_nan=False).encode()


def checksum_of(arrays: Mapping[str, NDArray[np.float64]], metadata: bytes) -> str:
    """What a policy file has to state of its content: SHA-256 of its metadata and of its arrays' names and numbers."""
    digest = hashlib.sha256(metadata)
    for name in _ARRAYS:
        array = np.ascontiguousarray(arrays[name], dtype="<f8")
        digest.update(f"{name}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def policy_bytes(policy: Policy) -> bytes:
    """The file's content."""
    arrays, metadata = _content(policy)
    members = {name: np.ascontiguousarray(array, dtype="<f8") for name, array in arrays.items()}
    members["metadata"] = np.frombuffer(metadata, dtype=np.uint8)
    members["checksum"] = np.frombuffer(checksum_of(arrays, metadata).encode(), dtype=np.uint8)
    output = io.BytesIO()
    with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name in _MEMBERS:
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, members[name], version=(1, 0), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, buffer.getvalue(), compresslevel=9)
    return output.getvalue()


def save_policy(policy: Policy, path: Path | str) -> None:
    """Write a policy file, atomically; the same policy gives the same bytes. `ConfigError` if it cannot be written."""
    atomic_write(path, policy_bytes(policy))


def load_policy(path: Path | str) -> Policy:
    """Read a policy file and verify all of it.

    Raises
    ------
    PolicyError
        It is missing, no policy, damaged, or of another format version; one line says which, and what to do.
    """
    try:
        members = read_npz(path, _MEMBERS, "policy file")
    except ConfigError as error:
        raise PolicyError(str(error)) from None
    if "metadata" not in members:
        raise PolicyError(f"{path}: is no policy file: it holds no metadata")
    raw = members["metadata"].tobytes()
    try:
        metadata = json.loads(raw, parse_constant=_no_number)
        ours = metadata["format"] == FORMAT_NAME
        version = metadata["format_version"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise PolicyError(f"{path}: is damaged: its metadata cannot be read") from None
    if not ours:
        raise PolicyError(f"{path}: is no policy file of {__package__}: its format is '{metadata['format']}'")
    if version != FORMAT_VERSION:
        raise PolicyError(f"{path}: {_other_version(version, metadata, path)}")
    missing = [name for name in _MEMBERS if name not in members]
    if missing:
        raise PolicyError(f"{path}: is damaged: {', '.join(missing)} is missing")
    for name in _ARRAYS:
        if members[name].dtype != np.dtype("<f8"):
            raise PolicyError(f"{path}: is damaged: {name} holds {members[name].dtype}, not float64")
    arrays = {name: np.ascontiguousarray(members[name], dtype=np.float64) for name in _ARRAYS}
    checksum = checksum_of(arrays, raw)
    if members["checksum"].tobytes() != checksum.encode():
        raise PolicyError(f"{path}: is damaged: its content does not match its checksum")
    return _policy_from(arrays, metadata, checksum, path)


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")


def _other_version(version: Any, metadata: Any, path: Path | str) -> str:
    if isinstance(version, int) and version > FORMAT_VERSION:
        return (
            f"has format version {version}, newer than the {FORMAT_VERSION} this package ({__version__}) reads: "
            "update the package"
        )
    friction = metadata.get("friction", "MU")
    return (
        f"has format version {version!r}, this package reads {FORMAT_VERSION}: solve it again with "
        f"solve_policy --vehicle VEHICLE --cycle CYCLE --grid GRID --friction {friction} --output {path}"
    )


#: Costs that are added and compared must not overflow; no car has so much energy.
_RANGES = (
    ("front_share", 0.0, 1.0),
    ("cost_j", -1e15, 1e15),
    ("dearer_cost_j", -1e15, 1e15),
    ("demand_steps", 0.0, 1e15),
)


def _policy_from(arrays: Mapping[str, NDArray[np.float64]], metadata: Any, checksum: str, path: Path | str) -> Policy:
    """Build the policy; the checksum is right, so what is inconsistent now was written by another program."""
    try:
        settings = {key: value for key, value in metadata["problem"].items() if key != "name"}
        problem = problem_from({"format": PROBLEM_FORMAT, **settings}, path)
        problem = dataclasses.replace(problem, name=check_name(path, "problem.name", metadata["problem"]["name"]))
        points = problem.power_w.size
        for name, shape in (
            ("front_share", problem.shape),
            ("cost_j", problem.shape),
            ("dearer_cost_j", (len(DEARER) if problem.changes_per_min > 0.0 else 0, *problem.shape)),
            ("demand_probability", (points, points)),
            ("demand_by_speed", (problem.speed_mps.size if problem.demand_by_speed else 0, points, points)),
            ("demand_steps", (points,)),
        ):
            if arrays[name].shape != shape:
                raise PolicyError(f"{path}: {name} has shape {arrays[name].shape}, its axes say {shape}")
            if not np.all(np.isfinite(arrays[name])):
                raise PolicyError(f"{path}: {name} holds a value that is not finite")
        for name, low, high in _RANGES:
            if np.any((arrays[name] < low) | (arrays[name] > high)):
                raise PolicyError(f"{path}: {name} holds a value outside {low:g} to {high:g}")
        probability, by_speed = arrays["demand_probability"], arrays["demand_by_speed"]
        for name, rows in (("demand_probability", probability[None]), ("demand_by_speed", by_speed)):
            if np.any(rows < 0.0) or np.any(np.abs(rows.sum(axis=2) - 1.0) > 1e-9):
                raise PolicyError(f"{path}: a row of {name} is no distribution")
        solver = metadata["solver"]
        clipped = check_number(path, "clipped", metadata["demand"]["clipped"], 0.0, 1.0)
        chain = DemandChain(problem.power_w, probability, by_speed, arrays["demand_steps"], clipped)
        return Policy(
            problem=problem,
            friction=check_number(path, "friction", metadata["friction"], *FRICTION_RANGE),
            front_share=arrays["front_share"],
            cost_j=arrays["cost_j"],
            dearer_cost_j=arrays["dearer_cost_j"],
            trials=tuple(Trial(*row) for row in solver["prices_tried"]),
            chain=chain,
            vehicle_name=check_name(path, "vehicle.name", metadata["vehicle"]["name"]),
            vehicle_hash=check_name(path, "vehicle.hash", metadata["vehicle"]["hash"]),
            idle_drive=check_name(path, "vehicle.idle_drive", metadata["vehicle"]["idle_drive"]),
            sources=tuple(metadata["demand"]["sources"]),
            iterations=tuple(Iteration(*row) for row in solver["iterations"]),
            bound_j=check_number(path, "bound_j", solver["bound_j"], 0.0),
            converged=bool(solver["converged"]),
            package_version=str(metadata["package_version"]),
            checksum=checksum,
            residual_j=check_number(path, "residual_j", solver["residual_j"], 0.0) if "residual_j" in solver else None,
        )
    except ConfigError as error:
        raise PolicyError(str(error)) from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise PolicyError(f"{path}: its metadata is incomplete: {error!r}") from None


def load_policy_bank(path: Path | str, vehicle: Vehicle | None = None) -> list[Policy]:
    """All policies of a folder (`*.npz`), or the one in a file, by rising friction.

    Parameters
    ----------
    vehicle : the car they have to be for: of a folder, policies for other cars do not count (each is verified all the
        same); a file has to fit. None takes them as they are, all for one car.

    Raises
    ------
    PolicyError
        There is none, one is bad, two are for the same friction, or they are for different cars.
    """
    path = Path(path)
    files = sorted(path.glob("*.npz")) if os.path.isdir(path) else [path]
    if not files:
        raise PolicyError(f"{path}: holds no policy file (*.npz)")
    loaded = [(file, load_policy(file)) for file in files]
    if vehicle is not None:
        if not os.path.isdir(path):
            loaded[0][1].check_vehicle(vehicle, str(path))
        cars = {_car(policy.vehicle_name, policy.vehicle_hash, policy.idle_drive) for _, policy in loaded}
        loaded = [(file, policy) for file, policy in loaded if policy.vehicle_hash == vehicle.hash]
        if not loaded:
            raise PolicyError(
                f"{path}: holds no policy for {_car(vehicle.name, vehicle.hash, vehicle.idle_drive)}, only for "
                f"{', '.join(sorted(cars)[:3])}; solve one for this car with solve_policy"
            )
    first_file, first = loaded[0]
    by_friction: dict[float, Path] = {}
    for file, policy in loaded:
        if policy.friction in by_friction:
            raise PolicyError(f"{file}: is for friction {policy.friction:g}, as is {by_friction[policy.friction].name}")
        by_friction[policy.friction] = file
        if policy.vehicle_hash != first.vehicle_hash:
            raise PolicyError(
                f"{file}: was solved for '{policy.vehicle_name}' ({policy.vehicle_hash}), {first_file.name} for "
                f"'{first.vehicle_name}' ({first.vehicle_hash}): a bank holds one car's policies"
            )
    return sorted((policy for _, policy in loaded), key=lambda policy: policy.friction)


def _car(name: str, vehicle_hash: str, idle_drive: str) -> str:
    """A car as messages name it: two of one name that differ in a number differ in the hash."""
    return f"'{name}' ({vehicle_hash}, idle_drive {idle_drive})"


def choose(bank: Sequence[Policy], friction: float) -> Policy:
    """The policy whose friction is nearest by ratio; halfway between two, the one for the more slippery road."""
    if not bank:
        raise PolicyError("no policy to choose from")
    if not (math.isfinite(friction) and friction > 0.0):
        raise PolicyError(f"friction {friction} is out of range; allowed: > 0")
    return min(bank, key=lambda policy: (abs(math.log(friction / policy.friction)), policy.friction))


class PolicyBank:
    """Policies by friction, loaded when a strategy first needs one.

    Parameters
    ----------
    path : file or folder; "" for none
    rule : coefficients of the strategy `rule`
    vehicle : the car they have to be solved for
    why_none : what to say where a policy is needed and there is none
    """

    def __init__(self, path: str, rule: Sequence[float], vehicle: Vehicle, why_none: str = "") -> None:
        self._path = path
        self._why_none = why_none or "name one with --policy"
        self._rule = tuple(rule)
        self._vehicle = vehicle
        self._bank: list[Policy] = []
        self._tables: dict[str, PolicyTable] = {}
        self._empty = empty_table(rule=self._rule)

    def table(self, strategy: int, friction: float) -> PolicyTable:
        """Numbers for the law, of the policy whose friction is nearest.

        Raises
        ------
        PolicyError
            The strategy needs a policy, and there is none that is whole and for this car.
        """
        if not STRATEGIES[name_of(strategy)].needs_policy:
            return self._empty
        if not self._path:
            raise PolicyError(f"strategy {name_of(strategy)} needs a policy: {self._why_none}")
        self._bank = self._bank or load_policy_bank(resolve(self._path), self._vehicle)
        policy = choose(self._bank, friction)
        if policy.checksum not in self._tables:
            self._tables[policy.checksum] = policy.table(self._rule)
        return self._tables[policy.checksum]

    @property
    def checksums(self) -> list[str]:
        """Identities of the policies loaded so far."""
        return [policy.checksum for policy in self._bank]

    @property
    def used(self) -> list[str]:
        """Grid and checksum of the policies that steps were decided with so far."""
        return [policy.identity for policy in self._bank or [] if policy.checksum in self._tables]

    @property
    def content_sha256(self) -> str:
        """Hash of the file or folder, as a recorder takes it; "" if no step needed a policy."""
        return content_sha256(resolve(self._path)) if self._bank else ""
