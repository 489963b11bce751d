"""The driver's power demand as a Markov chain (eq. 38, 39), counted from drive cycles and from recorded driving.

A demand signal is sampled every decision step; each sample falls into the bin of the nearest point of the power axis
(beyond the axis, into its end), and the steps from bin to bin are counted. Row i of the matrix is the distribution of
the next demand, given demand i.

Rows without data
-----------------
A demand no source ever had still needs a next one, or the problem is not defined. It moves one bin a step towards the
nearest demand that was seen (of two, the smaller one in magnitude): an excursion beyond what was driven is taken to
return the way it came, at a rate a driver can have. Staying put would be the other simple choice, but then the
cost-to-go there would be that of driving at this power for ever.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.cycle import Cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.vehicle import VehicleParams

#: Rows with less data than this are called thin: 10 s at the paper's step.
THIN_ROW_STEPS = 100
#: A recording with a gap longer than this is taken as two recordings.
MAX_GAP_S = 0.5


@dataclass(frozen=True, eq=False)
class Source:
    """Demand sequences from one cycle or bag.

    Attributes
    ----------
    name : of the cycle or bag
    sha256 : hash of its content
    weight : how much each of its steps counts
    sequences : demand in W at the decision step; no step leads from one sequence to the next
    """

    name: str
    sha256: str
    weight: float
    sequences: tuple[NDArray[np.float64], ...]

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
    row_steps : float64[P], weighted number of steps counted in each row; 0 where it was never visited
    clipped : part of all samples that lay outside the axis
    """

    power_w: NDArray[np.float64]
    probability: NDArray[np.float64]
    row_steps: NDArray[np.float64]
    clipped: float

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
    return Source(cycle.name, cycle.sha256, weight, (cycle_power_w(cycle, dt_s, vehicle),))


def signal_source(
    name: str,
    time_s: NDArray[np.float64],
    power_w: NDArray[np.float64],
    dt_s: float,
    weight: float = 1.0,
) -> Source:
    """A recorded demand signal as a source: cut at gaps, each piece sampled at the decision step.

    Its hash is that of the signal, so that a bag that was only split or compressed anew still counts as the same.

    Samples that are not finite and times that do not increase are left out.

    Parameters
    ----------
    time_s, power_w : float64[n], stamps and demand
    """
    time_s, power_w = np.asarray(time_s, dtype=np.float64), np.asarray(power_w, dtype=np.float64)
    good = np.isfinite(time_s) & np.isfinite(power_w)
    time_s, power_w = time_s[good], power_w[good]
    if time_s.size:
        latest = np.maximum.accumulate(time_s)
        rising = np.concatenate([[True], time_s[1:] > latest[:-1]])
        time_s, power_w = time_s[rising], power_w[rising]
    cuts = np.flatnonzero(np.diff(time_s) > MAX_GAP_S) + 1
    sequences = []
    for times, values in zip(np.split(time_s, cuts), np.split(power_w, cuts), strict=True):
        if times.size >= 2 and times[-1] - times[0] >= dt_s:
            steps = int((times[-1] - times[0]) / dt_s + 1e-9)
            sequences.append(np.interp(times[0] + np.arange(steps + 1) * dt_s, times, values))
    digest = hashlib.sha256(time_s.tobytes() + power_w.tobytes()).hexdigest()
    return Source(name, digest, weight, tuple(sequences))


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
    return DemandChain(axis, probability, row_steps, outside / max(samples, 1))
