# SPDX-License-Identifier: Apache-2.0
"""The driver's power demand as a Markov chain (eq. 38, 39), counted from drive cycles and from recorded driving.

A demand signal is sampled every decision step; each sample falls into the bin of the nearest point of the power axis
(beyond the axis, into its end), and the steps from bin to bin are counted. Row i of the matrix is the distribution of
the next demand, given demand i.

Dependence on speed
-------------------
The paper's chain knows the demand only. But 3 kW at 2 m/s is a start that will be over in a second, and 3 kW at 25 m/s
is cruising; how long a choice of the split will pay is just what the chain is to tell. With `demand_by_speed` there is
a matrix for each point of the speed axis, counted from the steps that end near that speed, and mixed with the chain of
all speeds where there are few. The solver's structure stays: the next speed does not depend on the next demand.

Rows without data
-----------------
A demand no source ever had still needs a next one, or the problem is not defined. It moves one bin a step towards the
nearest demand that was seen (of two, the smaller one in magnitude): an excursion beyond what was driven is taken to
return the way it came, at a rate a driver can have. Staying put would be the other simple choice, but then the
cost-to-go there would be that of driving at this power for ever.

A driver in between
-------------------
The paper takes the power that following a cycle exactly would need (`cycle_demand: exact`): on a schedule with a point
a second this is a saw-tooth that jumps once a second. Nobody's foot does, and how long a demand lasts is what the
solution lives on. With `cycle_demand: driven` the driver model follows the cycle in a car that does what it is told,
and what the pedals ask for is counted, jitter and all.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.cycle import Cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.jit import kernel
from iwm_power_manager.mdp.problem import DRIVEN, Problem
from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.model.driver import DriverState, Trace, drive, sample
from iwm_power_manager.model.parameters import VehicleParams

#: Rows with less data than this are called thin: 10 s at the paper's step.
THIN_ROW_STEPS = 100
#: A recording with a gap longer than this is taken as two recordings.
MAX_GAP_S = 0.5
#: A driver looks at the speedometer this often: the control step of nodes and simulation.
DRIVER_STEP_S = 0.01


@dataclass(frozen=True, eq=False)
class Source:
    """Demand sequences from one cycle or bag.

    Attributes
    ----------
    name : of the cycle or bag
    sha256 : hash of its content
    weight : how much each of its steps counts
    sequences : demand in W at the decision step; no step leads from one sequence to the next
    speeds : vehicle speed in m/s at the same instants; empty if it is not known
    """

    name: str
    sha256: str
    weight: float
    sequences: tuple[NDArray[np.float64], ...]
    speeds: tuple[NDArray[np.float64], ...] = ()

    @property
    def steps(self) -> int:
        """Number of steps from a sample to the next."""
        return sum(max(sequence.size - 1, 0) for sequence in self.sequences)


@dataclass(frozen=True, eq=False)
class DemandChain:
    """Transition matrix of the power demand.

    Attributes
    ----------
    power_w : float64[P], the axis
    probability : float64[P, P], row i to column j; rows sum to 1
    by_speed : float64[V, P, P], the same for each point of the speed axis; V = 0 if it does not depend on the speed
    row_steps : float64[P], weighted number of steps counted in each row; 0 where it was never visited
    clipped : part of all samples that lay outside the axis
    """

    power_w: NDArray[np.float64]
    probability: NDArray[np.float64]
    by_speed: NDArray[np.float64]
    row_steps: NDArray[np.float64]
    clipped: float

    @property
    def matrix(self) -> NDArray[np.float64]:
        """float64[G, P, P] as the solver takes it: G = V, or 1 if it does not depend on the speed."""
        return self.by_speed if self.by_speed.shape[0] else self.probability[None]

    @property
    def unvisited_w(self) -> NDArray[np.float64]:
        """Demands no source ever left."""
        return self.power_w[self.row_steps == 0.0]

    @property
    def thin_w(self) -> NDArray[np.float64]:
        """Demands with some, but little data."""
        return self.power_w[(self.row_steps > 0.0) & (self.row_steps < THIN_ROW_STEPS)]


@kernel
def _quasi_static(speed_mps, grade, dt_s, vehicle, out):
    mass = equivalent_mass_kg(vehicle)
    for k in range(out.size):
        mean = 0.5 * (speed_mps[k] + speed_mps[k + 1])
        force = mass * (speed_mps[k + 1] - speed_mps[k]) / dt_s
        if mean > 0.0:
            force += road_load_n(mean, 0.5 * (grade[k] + grade[k + 1]), vehicle.chassis)
        out[k] = force * mean


def cycle_power_w(cycle: Cycle, dt_s: float, vehicle: VehicleParams) -> NDArray[np.float64]:
    """Mean power at the wheels in each step of a cycle followed exactly, W: inertia (wheels included) and road load."""
    even = cycle.resample(dt_s)
    power = np.empty(even.time_s.size - 1)
    _quasi_static(even.speed_mps, even.grade, dt_s, vehicle, power)
    return power


def cycle_source(cycle: Cycle, dt_s: float, vehicle: VehicleParams, weight: float = 1.0) -> Source:
    """A cycle as a source of demand."""
    speed = cycle.resample(dt_s).speed_mps
    return Source(
        cycle.name, cycle.sha256, weight, (cycle_power_w(cycle, dt_s, vehicle),), (0.5 * (speed[1:] + speed[:-1]),)
    )


@kernel
def _driven(trace: Trace, dt_s, vehicle, power_w, speed_mps):
    mass = equivalent_mass_kg(vehicle)
    driver_state = DriverState(0.0)
    speed = trace.speed_mps[0]
    for k in range(power_w.size):
        pedals, driver_state = drive(
            driver_state,
            speed,
            trace.speed_mps[k],
            trace.ahead_mps[k],
            trace.ahead_mps2[k],
            trace.grade[k],
            dt_s,
            vehicle,
        )
        power_w[k] = pedals.power_demand_w
        speed_mps[k] = speed
        force = pedals.power_demand_w / max(speed, vehicle.driver.power_speed_floor_mps)
        force -= road_load_n(speed, trace.grade[k], vehicle.chassis)
        speed = max(speed + force / mass * dt_s, 0.0)


def driven_source(cycle: Cycle, dt_s: float, vehicle: VehicleParams, weight: float = 1.0) -> Source:
    """What the driver model asks for on a cycle, in a car that delivers it (no slip, no lag), as a source of demand."""
    trace = sample(cycle, DRIVER_STEP_S, vehicle.driver.preview_s)
    power = np.empty(trace.speed_mps.size)
    speed = np.empty(trace.speed_mps.size)
    _driven(trace, DRIVER_STEP_S, vehicle, power, speed)
    time = DRIVER_STEP_S * np.arange(power.size, dtype=np.float64)
    source = signal_source(cycle.name, time, power, dt_s, weight, speed)
    return dataclasses.replace(source, sha256=cycle.sha256)


def source_of(cycle: Cycle, problem: Problem, vehicle: VehicleParams, weight: float = 1.0) -> Source:
    """A cycle as the source a problem asks for."""
    make = driven_source if problem.cycle_demand == DRIVEN else cycle_source
    return make(cycle, problem.dt_s, vehicle, weight)


def signal_source(
    name: str,
    time_s: NDArray[np.float64],
    power_w: NDArray[np.float64],
    dt_s: float,
    weight: float = 1.0,
    speed_mps: NDArray[np.float64] | None = None,
) -> Source:
    """A recorded demand signal as a source: cut at gaps, each piece sampled at the decision step.

    Its hash is that of the signal, so that a bag that was only split or compressed anew still counts as the same.

    Samples that are not finite and times that do not increase are left out.

    Parameters
    ----------
    time_s, power_w : float64[n], stamps and demand
    speed_mps : float64[n], vehicle speed, if it is known
    """
    columns = [np.asarray(values, dtype=np.float64) for values in (time_s, power_w, speed_mps) if values is not None]
    good = np.all(np.isfinite(columns), axis=0)
    columns = [values[good] for values in columns]
    if columns[0].size:
        latest = np.maximum.accumulate(columns[0])
        rising = np.concatenate([[True], columns[0][1:] > latest[:-1]])
        columns = [values[rising] for values in columns]
    cuts = np.flatnonzero(np.diff(columns[0]) > MAX_GAP_S) + 1
    pieces: list[list[NDArray[np.float64]]] = [[] for _ in columns[1:]]
    for times, *signals in zip(*(np.split(values, cuts) for values in columns), strict=True):
        if times.size >= 2 and times[-1] - times[0] >= dt_s:
            steps = int((times[-1] - times[0]) / dt_s + 1e-9)
            at = times[0] + np.arange(steps + 1) * dt_s
            for piece, signal in zip(pieces, signals, strict=True):
                piece.append(np.interp(at, times, signal))
    digest = hashlib.sha256(b"".join(values.tobytes() for values in columns)).hexdigest()
    return Source(name, digest, weight, *map(tuple, pieces))


def nearest_bin(axis: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index of the axis point nearest to each value; halfway between two, the left one."""
    return np.searchsorted(0.5 * (axis[1:] + axis[:-1]), values, side="left")


def count_steps(axis: NDArray[np.float64], sequence: NDArray[np.float64]) -> NDArray[np.float64]:
    """counts[i, j]: how often bin i was followed by bin j in a sequence."""
    n = axis.size
    bins = nearest_bin(axis, sequence)
    return np.bincount(bins[:-1] * n + bins[1:], minlength=n * n).reshape(n, n).astype(np.float64)


def demand_chain(axis: NDArray[np.float64], sources: Sequence[Source]) -> DemandChain:
    """The demand's Markov chain from one or more sources (eq. 38, 39).

    Raises
    ------
    ConfigError
        There is not a single step to count.
    """
    n = axis.size
    counts = np.zeros((n, n))
    samples = outside = 0
    for source in sources:
        for sequence in source.sequences:
            counts += source.weight * count_steps(axis, sequence)
            samples += sequence.size
            outside += int(np.count_nonzero((sequence < axis[0]) | (sequence > axis[-1])))
    row_steps = counts.sum(axis=1)
    visited = np.flatnonzero(row_steps > 0.0)
    if visited.size == 0:
        names = ", ".join(source.name for source in sources)
        raise ConfigError(names or "demand", "", "holds no step of power demand", "two samples or more, a step apart")
    probability = np.zeros((n, n))
    probability[visited] = counts[visited] / row_steps[visited, None]
    for row in np.flatnonzero(row_steps == 0.0):
        distance = np.abs(axis[visited] - axis[row])
        candidates = visited[distance == distance.min()]
        target = candidates[np.argmin(np.abs(axis[candidates]))]
        probability[row, row + np.sign(target - row)] = 1.0
    return DemandChain(axis, probability, np.zeros((0, n, n)), row_steps, outside / max(samples, 1))


def chain_of(problem: Problem, sources: Sequence[Source]) -> DemandChain:
    """The Markov chain a problem asks for: of the demand alone, or of the demand at each speed.

    Raises
    ------
    ConfigError
        There is not a single step to count, or a source lacks the speed.
    """
    if problem.needs_car:
        raise ConfigError(problem.name, "power_w", "is relative to a car that was not named", "Problem.for_car")
    chain = demand_chain(problem.power_w, sources)
    if not problem.demand_by_speed:
        return chain
    n, points = problem.power_w.size, problem.speed_mps
    # Each point's share of a step fades out linearly with the distance in speed, and reaches its neighbours at least.
    gap = np.diff(points)
    reach = np.maximum(
        problem.speed_bandwidth_mps, 0.5 * (np.append(gap, gap[-1:]) + np.insert(gap, 0, gap[:1])) if gap.size else 0.0
    )
    counts = np.zeros((points.size, n, n))
    for source in sources:
        if len(source.speeds) != len(source.sequences):
            raise ConfigError(source.name, "speed", "is not known, and the problem has demand_by_speed")
        for sequence, speed in zip(source.sequences, source.speeds, strict=True):
            bins = nearest_bin(problem.power_w, sequence)
            for v, point in enumerate(points):
                weight = source.weight * np.maximum(1.0 - np.abs(speed[1:] - point) / reach[v], 0.0)
                counts[v] += np.bincount(bins[:-1] * n + bins[1:], weight, n * n).reshape(n, n)
    mixed = counts + problem.prior_steps * chain.probability
    by_speed = mixed / mixed.sum(axis=2, keepdims=True)
    return dataclasses.replace(chain, by_speed=by_speed)
