# SPDX-License-Identifier: Apache-2.0
"""How much later or earlier torques act than stamps and `actuator_delay_s` say, as the wheels answer.

What the road takes from a wheel changes little from step to step, while at the limit of the road torques change a lot.
So of several delays the right one is that with which the road's torque is smoothest. Where torques hardly change no
delay is told from another, and it is no matter which is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from iwm_power_manager.control.types import Wheels

FloatArray = npt.NDArray[np.float64]

#: Delays that are compared, beyond what is told, ns. One that is too short by 8 ms is borne, too long by 3 is not.
BEYOND_NS = np.arange(-20_000_000, 30_000_001, 2_500_000)
_TOLD = int(np.flatnonzero(BEYOND_NS == 0)[0])
_SHORTEST_NS, _LONGEST_NS = int(BEYOND_NS.min()), int(BEYOND_NS.max())
#: A torque that changes by less from step to step tells nothing beside the noise of wheel speeds, N m.
TELLING_NM = 100.0
#: Wheels that are slower tell nothing: they stand, or are about to, rad/s.
TURNING_RADPS = 6.0
#: What is left of what was seen with each step that tells something.
KEPT = 0.8
#: A delay explains a wheel with which at most this part of its torque's changes, squared, is left to the road; if by it
#: torques have acted of which the changes are at least the second part of the largest.
EXPLAINED, ACTED = 0.15, 0.1
#: A shorter or a longer delay is taken where the one at hand leaves so many times what the best one does, and the last
#: more, (N m)2: the nearest of those that leave no more than the first number of times as much.
SHORTER, LONGER, LEAST_NM2 = 2.0, 8.0, 100.0**2


def _explaining(left: FloatArray, swung: FloatArray) -> npt.NDArray[np.bool_]:
    """Which delays explain each wheel, or several in one."""
    return (left < EXPLAINED * swung) & (swung > ACTED * swung.max(axis=0))


class FoundDelay:
    """The delay that explains best how the wheels turn.

    Attributes
    ----------
    beyond_ns : what was found, beyond what is told
    """

    def __init__(self) -> None:
        self._chosen = _TOLD
        # By delay and wheel: squared changes of what is left to the road, and of the torque.
        self._left = np.zeros((len(BEYOND_NS), 4))
        self._swung = np.zeros((len(BEYOND_NS), 4))
        self._before: tuple[int, int, Wheels] | None = None

    @property
    def beyond_ns(self) -> int:
        """What was found, beyond what is told."""
        return int(BEYOND_NS[self._chosen])

    def rest(self, from_ns: int, to_ns: int, turned_nm: Wheels) -> None:
        """A step in which all delays tell much the same torque; arguments as of `learn`."""
        self._before = from_ns, to_ns, turned_nm

    def learn(
        self, torques: Sequence[tuple[int, Wheels]], from_ns: int, to_ns: int, turned_nm: Wheels, speed_radps: Wheels
    ) -> None:
        """Hold a step against the one before.

        Parameters
        ----------
        torques : each from its time on; the first that is remembered stands for those before
        from_ns, to_ns : when the speeds changed, as far as is told
        turned_nm : what turned the wheels: inertia times change
        speed_radps : of the wheels
        """
        before, self._before = self._before, (from_ns, to_ns, turned_nm)
        if before is None:
            return
        acting = _acting(torques, before[0] - _LONGEST_NS, to_ns - _SHORTEST_NS)
        if all(max(wheel) - min(wheel) <= TELLING_NM for wheel in zip(*[nm for _, nm in acting], strict=True)):
            return
        changes = _means_nm(acting, from_ns, to_ns) - _means_nm(acting, *before[:2])
        telling = (np.abs(changes).max(axis=0) > TELLING_NM) & (np.abs(speed_radps) > TURNING_RADPS)
        if telling.any():
            kept = np.where(telling, KEPT, 1.0)
            self._left = kept * self._left + telling * (changes - np.subtract(turned_nm, before[2])) ** 2
            self._swung = kept * self._swung + telling * changes**2
            self._choose()

    def _choose(self) -> None:
        wheels = _explaining(self._left, self._swung).any(axis=0)
        left, swung = self._left @ wheels, self._swung @ wheels
        explaining = _explaining(left, swung)
        if explaining.any():
            best = int(np.where(explaining, left, np.inf).argmin())
            worse = SHORTER if best < self._chosen else LONGER
            if left[self._chosen] > worse * left[best] + LEAST_NM2:
                alike = np.flatnonzero(explaining & (left <= SHORTER * left[best] + LEAST_NM2))
                self._chosen = int(alike[np.abs(alike - self._chosen).argmin()])


def _acting(torques: Sequence[tuple[int, Wheels]], from_ns: int, to_ns: int) -> list[tuple[int, Wheels]]:
    """Those of the torques that act between two times."""
    acting = []
    for torque in reversed(torques):
        if torque[0] < to_ns:
            acting.append(torque)
        if torque[0] <= from_ns:
            break
    return acting[::-1]


def _means_nm(torques: Sequence[tuple[int, Wheels]], from_ns: int, to_ns: int) -> FloatArray:
    """Mean torque of each wheel between two times, by each delay."""
    times = np.array([time_ns - from_ns for time_ns, _ in torques])
    nm = np.array([torque for _, torque in torques])
    upto = np.zeros_like(nm)
    np.cumsum(nm[:-1] * np.diff(times)[:, None], axis=0, out=upto[1:])
    ends = np.concatenate((-BEYOND_NS, to_ns - from_ns - BEYOND_NS))
    k = np.maximum(times.searchsorted(ends, side="right") - 1, 0)
    integrals = upto[k] + nm[k] * (ends - times[k])[:, None]
    n = len(BEYOND_NS)
    return np.asarray((integrals[n:] - integrals[:n]) / (to_ns - from_ns))
