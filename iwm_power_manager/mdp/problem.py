# SPDX-License-Identifier: Apache-2.0
"""The optimisation problem: state and control grids, and what a step costs.

State x = (power demand, speed, slip of the front axle, slip of the rear axle[, previous front share]), eq. 32-37.
Control: the front share u of the demand, P_f = u * P_dem. Cost of a step in joules of battery energy (eq. 28):

    xi = battery energy + alpha * power error * dt + switching cost of |u - previous u|

A problem file is YAML; `load_problem` checks every value of it. An axis may have a single point, and then the problem
does not depend on that state.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.budget import price_units
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import (
    check_bool,
    check_choice,
    check_integer,
    check_keys,
    check_number,
    dotted,
    read_yaml,
)
from iwm_power_manager.model.decision import (
    ERROR_NORMS,
    POWER_ERRORS,
    SKID_AVOIDANCE,
    SLIP_MODELS,
    ProblemParams,
)
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.top_speed import motor_power_w, top_speed_mps

FORMAT = 1

#: What a cycle says about the demand: the power that following it exactly needs, or what a driver asks for.
EXACT, DRIVEN = CYCLE_DEMANDS = ("exact", "driven")

MAX_AXIS_POINTS = 1000
#: State-control pairs: beyond it the solver would need gigabytes.
MAX_PAIRS = 20_000_000


@dataclass(frozen=True, eq=False)
class Problem:
    """A checked problem file.

    Attributes
    ----------
    name : the file's name without its ending
    power_w, speed_mps, slip_front, slip_rear : state axes, float64, strictly increasing
    share : control levels, 0..1; also the axis of the previous share
    previous_share : whether the previous share is a state
    dt_s : length of a step
    discount : gamma, 0 < gamma < 1
    alpha, power_error, error_norm, slip_model, skid_avoidance, critical_slip : see `ProblemParams`, codes by name
    switching_cost_j : cost of moving the whole power from one axle to the other, proportional to |change of share|
    switching_cost_by_friction : pairs (friction, switching_cost_j), linear between them and constant beyond;
        empty where it is the same on every road
    switching_fixed_cost_j : cost of any change at all
    demand_by_speed : whether the demand's Markov chain depends on the speed; the paper's does not
    speed_bandwidth_mps : with it, steps at speeds up to this far away count for a point of the speed axis, fading out
    cycle_demand : exact: what following a cycle exactly would need; driven: what a driver asks for (`mdp.demand`)
    prior_steps : with it, the chain of all speeds counts as this many steps in every row, where data are few
    tolerance_j : solve until the cost-to-go is certified to be this close to the optimal one, J
    max_iterations : give up after this many policies
    changes_per_min : budget of changes of the share (`control.budget`); 0 is none. With it, a `switching_cost_j` of 0
        is to be found by the solver (`mdp.budget`)
    power_of_car, speed_of_car : points of an axis that is relative to the car; none where it is absolute, and in what
        `for_car` returns
    """

    name: str
    power_w: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    slip_front: NDArray[np.float64]
    slip_rear: NDArray[np.float64]
    share: NDArray[np.float64]
    previous_share: bool
    dt_s: float
    discount: float
    alpha: float
    power_error: str
    error_norm: str
    slip_model: str
    skid_avoidance: str
    critical_slip: float
    switching_cost_j: float
    switching_cost_by_friction: tuple[tuple[float, float], ...]
    switching_fixed_cost_j: float
    demand_by_speed: bool
    cycle_demand: str
    speed_bandwidth_mps: float
    prior_steps: float
    tolerance_j: float
    max_iterations: int
    changes_per_min: float = 0.0
    power_of_car: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    speed_of_car: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def needs_car(self) -> bool:
        """Whether axes are still relative: `for_car` makes them absolute."""
        return self.power_of_car.size > 0 or self.speed_of_car.size > 0

    def for_car(self, vehicle: VehicleParams) -> Problem:
        """The problem with axes in W and m/s: relative points are multiples of the car's power and top speed."""
        if not self.needs_car:
            return self
        power, speed = self.power_w, self.speed_mps
        if self.power_of_car.size:
            power = np.round(self.power_of_car * motor_power_w(vehicle), 1) + 0.0
        if self.speed_of_car.size:
            points = np.round(self.speed_of_car * top_speed_mps(vehicle.chassis, motor_power_w(vehicle)), 2)
            # Points of both kinds must not crowd where they meet.
            speed = np.concatenate([speed, points[points > 1.1 * speed[-1]]])
        none = np.zeros(0)
        return dataclasses.replace(self, power_w=power, speed_mps=speed, power_of_car=none, speed_of_car=none)

    def params(self, friction: float) -> ProblemParams:
        """The numbers the kernels take, for one road."""
        return ProblemParams(
            dt_s=self.dt_s,
            friction=float(friction),
            alpha=self.alpha,
            power_error=POWER_ERRORS[self.power_error],
            error_norm=ERROR_NORMS[self.error_norm],
            slip_model=SLIP_MODELS[self.slip_model],
            skid_avoidance=SKID_AVOIDANCE[self.skid_avoidance],
            critical_slip=self.critical_slip,
        )

    def on_road(self, friction: float) -> Problem:
        """The problem as it is on one road: `switching_cost_j` taken from `switching_cost_by_friction`."""
        if not self.switching_cost_by_friction:
            return self
        frictions, costs = zip(*self.switching_cost_by_friction, strict=True)
        price = float(np.interp(friction, frictions, costs))
        return dataclasses.replace(self, switching_cost_j=price, switching_cost_by_friction=())

    @property
    def previous_shares(self) -> NDArray[np.float64]:
        """Axis of the previous share: the control levels, or a single point where it is no state."""
        return self.share if self.previous_share else np.zeros(1)

    @property
    def shape(self) -> tuple[int, int, int, int, int]:
        """Number of points over (power, speed, slip front, slip rear, previous share)."""
        return (
            self.power_w.size,
            self.speed_mps.size,
            self.slip_front.size,
            self.slip_rear.size,
            self.previous_shares.size,
        )

    def switching_cost(self) -> NDArray[np.float64]:
        """Cost in J of going from a previous share (rows) to a share (columns)."""
        change = np.abs(self.previous_shares[:, None] - self.share[None, :])
        if not self.previous_share:
            return np.zeros_like(change)
        if self.changes_per_min > 0.0:
            return self.switching_cost_j * price_matrix(self.share)
        return self.switching_cost_j * change + self.switching_fixed_cost_j * (change > 0.0)

    def settings(self) -> dict[str, Any]:
        """Every setting by name, as plain values: what a policy file records."""
        return {
            entry.name: value.tolist() if isinstance(value := getattr(self, entry.name), np.ndarray) else value
            for entry in dataclasses.fields(self)
            if entry.name not in ("power_of_car", "speed_of_car")
        }


def price_matrix(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[U, U]: what a change from a share (rows) to another (columns) costs, in prices of a change."""
    return np.array([[price_units(after - before) for after in share] for before in share])


_AXES = {  # axis: (low, high, unit)
    "power_w": (-1e6, 1e6, "W"),
    "speed_mps": (0.0, 100.0, "m/s"),
    "slip_front": (-1.0, 1.0, ""),
    "slip_rear": (-1.0, 1.0, ""),
    "share": (0.0, 1.0, ""),
}
_REQUIRED = ("format", *_AXES, "dt_s", "discount", "alpha")
_OPTIONAL = (
    "previous_share",
    "power_error",
    "error_norm",
    "slip_model",
    "skid_avoidance",
    "critical_slip",
    "switching_cost_j",
    "switching_cost_by_friction",
    "switching_fixed_cost_j",
    "demand_by_speed",
    "cycle_demand",
    "speed_bandwidth_mps",
    "prior_steps",
    "tolerance_j",
    "max_iterations",
    "changes_per_min",
)


def load_problem(path: Path | str) -> Problem:
    """Read and check a problem file (`config/grids/*.yaml`).

    Raises
    ------
    ConfigError
        Anything unreadable, unknown, missing, of the wrong type or out of range, or a combination without meaning.
    """
    return problem_from(read_yaml(path), path)


def problem_from(content: Any, path: Path | str) -> Problem:
    """A `Problem` from the mapping a problem file holds; `path` is what errors name."""
    check_keys(path, content, _REQUIRED, _OPTIONAL)
    check_integer(path, "format", content["format"], FORMAT, FORMAT)
    axes = {key: read_axis(path, key, _absolute(content[key]), *limits) for key, limits in _AXES.items()}
    switching = {
        key: check_number(path, key, content.get(key, 0.0), 0.0, 1e6, unit="J")
        for key in ("switching_cost_j", "switching_fixed_cost_j")
    }
    problem = Problem(
        name=Path(path).stem,
        power_w=axes["power_w"],
        speed_mps=axes["speed_mps"],
        slip_front=axes["slip_front"],
        slip_rear=axes["slip_rear"],
        share=axes["share"],
        previous_share=check_bool(path, "previous_share", content.get("previous_share", False)),
        dt_s=check_number(path, "dt_s", content["dt_s"], 0.001, 10.0, unit="s"),
        discount=check_number(path, "discount", content["discount"], 0.0, 0.9999),
        alpha=check_number(path, "alpha", content["alpha"], 0.0, 1e6),
        power_error=check_choice(path, "power_error", content.get("power_error", "road"), POWER_ERRORS),
        error_norm=check_choice(path, "error_norm", content.get("error_norm", "absolute"), ERROR_NORMS),
        slip_model=check_choice(path, "slip_model", content.get("slip_model", "dynamic"), SLIP_MODELS),
        skid_avoidance=check_choice(path, "skid_avoidance", content.get("skid_avoidance", "braking"), SKID_AVOIDANCE),
        critical_slip=check_number(path, "critical_slip", content.get("critical_slip", 0.2), 0.01, 1.0),
        switching_cost_j=switching["switching_cost_j"],
        switching_cost_by_friction=_by_friction(path, content.get("switching_cost_by_friction", [])),
        switching_fixed_cost_j=switching["switching_fixed_cost_j"],
        demand_by_speed=check_bool(path, "demand_by_speed", content.get("demand_by_speed", False)),
        cycle_demand=check_choice(path, "cycle_demand", content.get("cycle_demand", EXACT), CYCLE_DEMANDS),
        speed_bandwidth_mps=check_number(
            path, "speed_bandwidth_mps", content.get("speed_bandwidth_mps", 0.5), 0.0, 50.0, above=True, unit="m/s"
        ),
        prior_steps=check_number(path, "prior_steps", content.get("prior_steps", 5.0), 0.0, 1e9, above=True),
        tolerance_j=check_number(path, "tolerance_j", content.get("tolerance_j", 0.01), 1e-6, 1e6, unit="J"),
        max_iterations=check_integer(path, "max_iterations", content.get("max_iterations", 100), 1, 10_000),
        changes_per_min=check_number(
            path, "changes_per_min", content.get("changes_per_min", 0.0), 0.0, 1e4, unit="1/min"
        ),
        power_of_car=_relative(path, "power_w", content["power_w"], -10.0),
        speed_of_car=_relative(path, "speed_mps", content["speed_mps"], 0.0),
    )
    _check_combination(problem, path)
    return problem


def _check_combination(problem: Problem, path: Path | str) -> None:
    if problem.slip_model == "quasi_steady":
        for key in ("slip_front", "slip_rear"):
            axis = getattr(problem, key)
            if axis.size != 1 or axis[0] != 0.0:
                raise ConfigError(path, key, "is no state with slip_model quasi_steady", "[0]")
    if problem.switching_cost_by_friction and problem.switching_cost_j > 0.0:
        raise ConfigError(path, "switching_cost_by_friction", "stands beside switching_cost_j", "one of them")
    if not problem.previous_share:
        for key in ("switching_cost_j", "switching_cost_by_friction", "switching_fixed_cost_j", "changes_per_min"):
            if getattr(problem, key) not in (0.0, ()):
                raise ConfigError(path, key, "needs previous_share: true", "0, or previous_share: true")
    powers = max(problem.power_w.size, problem.power_of_car.size)
    speeds = problem.speed_mps.size + problem.speed_of_car.size
    pairs = int(float(powers) * speeds * problem.slip_front.size * problem.slip_rear.size * problem.share.size)
    if pairs > MAX_PAIRS:
        problem_text = f"has {pairs:.3g} pairs of state and control"
        raise ConfigError(path, "", problem_text, f"<= {MAX_PAIRS:.3g}: use coarser axes")


def _absolute(value: Any) -> Any:
    """The part of an axis that does not depend on the car; rest, where all of it does."""
    if isinstance(value, dict) and "of_car" in value:
        return value.get("fixed", [0.0])
    return value


def _relative(path: Path | str, key: str, value: Any, low: float) -> NDArray[np.float64]:
    """The part of an axis that is given in multiples of the car's own power or top speed."""
    if not (isinstance(value, dict) and "of_car" in value):
        return np.zeros(0)
    check_keys(path, value, ("of_car",), ("fixed",), key)
    return read_axis(path, dotted(key, "of_car"), value["of_car"], low, 10.0, "")


def _by_friction(path: Path | str, value: Any) -> tuple[tuple[float, float], ...]:
    key = "switching_cost_by_friction"
    if not isinstance(value, list | tuple):
        raise ConfigError(path, key, f"{value!r} is no list of pairs", "[[friction, J], ...]")
    pairs: list[tuple[float, float]] = []
    for i, pair in enumerate(value):
        where = f"{key}[{i}]"
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise ConfigError(path, where, f"{pair!r} is no pair", "[friction, J]")
        friction = check_number(path, where, pair[0], 0.01, 2.0)
        if pairs and friction <= pairs[-1][0]:
            raise ConfigError(path, where, f"{friction:g} does not increase", f"> {pairs[-1][0]:g}")
        pairs.append((friction, check_number(path, where, pair[1], 0.0, 1e6, unit="J")))
    return tuple(pairs)


def read_axis(file: Path | str, key: str, value: Any, low: float, high: float, unit: str) -> NDArray[np.float64]:
    """An axis from a list of numbers, from `{from, to, step}`, or from `{mirrored: [0, a, b, ...]}`.

    `{fixed: AXIS, of_car: AXIS}` is read in two parts, the second in multiples of the car's power or top speed.

    Raises
    ------
    ConfigError
        It is empty, too long, not strictly increasing, or has a point that is no number or outside low..high.
    """
    if isinstance(value, dict) and "mirrored" in value:
        check_keys(file, value, ("mirrored",), parent=key)
        half = _points(file, dotted(key, "mirrored"), value["mirrored"], max(low, 0.0), high, unit)
        points = np.concatenate([-half[::-1], half[1:] if half[0] == 0.0 else half])
    elif isinstance(value, dict):
        check_keys(file, value, ("from", "to", "step"), parent=key)
        first = check_number(file, dotted(key, "from"), value["from"], low, high, unit=unit)
        last = check_number(file, dotted(key, "to"), value["to"], first, high, unit=unit)
        step = check_number(file, dotted(key, "step"), value["step"], 0.0, high - low, above=True, unit=unit)
        intervals = round(min((last - first) / step, 1e9))
        if abs(first + intervals * step - last) > 1e-6 * step:
            raise ConfigError(file, dotted(key, "step"), f"{step:g} does not divide {first:g} to {last:g}")
        if intervals >= MAX_AXIS_POINTS:
            problem = f"{step:g} gives {intervals + 1} points"
            raise ConfigError(file, dotted(key, "step"), problem, f"<= {MAX_AXIS_POINTS}")
        # Whole multiples, rounded: 0.1 * 3 must be the 0.3 that a list would hold.
        points = np.array([float(f"{first + i * step:.12g}") for i in range(intervals + 1)])
    else:
        points = _points(file, key, value, low, high, unit)
    if points.size > MAX_AXIS_POINTS:
        raise ConfigError(file, key, f"has {points.size} points", f"<= {MAX_AXIS_POINTS}")
    return points + 0.0  # -0.0 becomes 0.0


def _points(file: Path | str, key: str, value: Any, low: float, high: float, unit: str) -> NDArray[np.float64]:
    if not isinstance(value, list) or not value:
        allowed = "[a, b, ...], {from, to, step} or {mirrored: [0, a, ...]}"
        raise ConfigError(file, key, f"{value!r} is no axis", allowed)
    points = np.array([check_number(file, f"{key}[{i}]", x, low, high, unit=unit) for i, x in enumerate(value)])
    for i in np.flatnonzero(np.diff(points) <= 0.0):
        raise ConfigError(file, f"{key}[{i + 1}]", f"{value[i + 1]} does not increase", f"> {value[i]}")
    return points
