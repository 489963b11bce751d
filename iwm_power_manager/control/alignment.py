# SPDX-License-Identifier: Apache-2.0
"""Which torque a wheel had while its speed changed by what is shown.

What the road takes from a wheel is told by its torque, and by how its speed changed meanwhile. Wheel speeds come late,
several at a time or not at all, so that the torque of the last step is not the one that belongs to them: the slip
limiter would answer its own torque, and swing. Stamps say when speeds were measured; the torques of then are looked up.
What neither stamps nor `delay_s` say is found (`found_delay`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from operator import sub

from iwm_power_manager.control.found_delay import FoundDelay
from iwm_power_manager.control.types import Command, Measurement, Wheels

_NS_PER_S = 1e9
#: Wheel speeds that are older belong to no torque that is remembered.
LATEST_S = 0.25
#: Speeds measured within this part of a step are too near to each other to tell a torque.
_LEAST_PART = 0.5
#: Where messages stay away for longer, what the road takes is not known any more.
_SILENT_NS = 60_000_000
#: Weights of a speed that is made of the newest message alone.
ALONE = (1.0,)
#: Delays are told from each other for so long after a torque has changed by so much in a step, N m.
_LIVELY_NS, _LIVELY_NM = 100_000_000, 50.0
NO_SHIFT: Wheels = (0.0, 0.0, 0.0, 0.0)


def arrived_nm(command: Command, measurement: Measurement) -> Wheels:
    """Torque at each wheel by a command, as far as motors and brakes are known, N m, forwards positive."""
    gain, stuck, brakes = measurement.motor_gain, measurement.motor_stuck_nm, command.brake_gain
    motor, friction, turning = command.motor_torque_nm, command.friction_torque_nm, measurement.wheel_speed_radps
    a, b, c, d = [
        gain[i] * motor[i] + stuck[i] + (brakes[i] if turning[i] >= 0.0 else -brakes[i]) * friction[i] for i in range(4)
    ]
    return a, b, c, d


class Alignment:
    """Torques of the last moments, held against the stamps of wheel speeds.

    Parameters
    ----------
    inertia_kgm2 : of each wheel
    delay_s : time after which a command is a torque

    Attributes
    ----------
    found : by how much torques act later than stamps and `delay_s` say
    """

    def __init__(self, inertia_kgm2: Sequence[float], delay_s: float) -> None:
        self._inertia_kgm2 = inertia_kgm2
        self._delay_ns = round(delay_s * _NS_PER_S)
        self.forget()

    def forget(self) -> None:
        """Start again without history: as at activation, or after the clock was set back."""
        self._torques: deque[tuple[int, Wheels]] = deque()
        self._last_radps: Wheels | None = None
        self._since_ns, self._since_radps = 0, NO_SHIFT
        self._road_nm: Wheels | None = None
        self._means: deque[Wheels] = deque()
        self._newest_ns = self._arrived_ns = 0
        self._lively_ns = -_LIVELY_NS
        self.found = FoundDelay()

    def applied(self, now_ns: int, torque_nm: Wheels) -> None:
        """Note the torques that are commanded now."""
        torques = self._torques
        if torques and max(map(abs, map(sub, torque_nm, torques[-1][1]))) > _LIVELY_NM:
            self._lively_ns = now_ns
        torques.append((now_ns, torque_nm))
        # Of speeds that are as old as may be, since those before, which may be as much older.
        while len(torques) > 1 and torques[1][0] < now_ns - self._delay_ns - 2.0 * LATEST_S * _NS_PER_S:
            torques.popleft()

    def shift_nm(
        self, now_ns: int, dt_s: float, stamp_ns: int, speed_radps: Wheels, weights: Sequence[float] = ALONE
    ) -> Wheels:
        """What to add to the torques commanded last, to get those that explain how the wheels' speeds have changed.

        Parameters
        ----------
        now_ns, dt_s : of the step
        stamp_ns, speed_radps : of the newest wheel speeds
        weights : of the newest messages that they are made of; each of several counts teeth since the one before it

        Returns
        -------
        Wheels
            N m, forwards positive
        """
        if self._torques and now_ns <= self._torques[-1][0]:
            self.forget()
        if stamp_ns != self._newest_ns:
            self._newest_ns, self._arrived_ns = stamp_ns, now_ns
        before, since_s = self._last_radps, (stamp_ns - self._since_ns) / _NS_PER_S
        self._last_radps = speed_radps
        if before is None or not self._torques:
            self._since_ns, self._since_radps = stamp_ns, speed_radps
            return NO_SHIFT
        inertia, road, last = self._inertia_kgm2, self._road_nm, self._torques[-1][1]
        if not 0.0 <= since_s <= LATEST_S:
            # After a gap in the messages nobody knows what the road took in it.
            self._since_ns, self._since_radps = stamp_ns, speed_radps
        elif since_s >= _LEAST_PART * dt_s:
            start = self._since_radps
            a, b, c, d = [inertia[i] * (speed_radps[i] - start[i]) / since_s for i in range(4)]
            if len(weights) == 1:
                self._learn(stamp_ns, (a, b, c, d), speed_radps)
            delay_ns = self._delay_ns + self.found.beyond_ns
            mean = self._weighted_nm(self._since_ns - delay_ns, stamp_ns - delay_ns, weights)
            self._road_nm = road = mean[0] - a, mean[1] - b, mean[2] - c, mean[3] - d
            self._since_ns, self._since_radps = stamp_ns, speed_radps
        if road is None or now_ns - self._arrived_ns > _SILENT_NS:
            return NO_SHIFT
        a, b, c, d = [road[i] + inertia[i] * (speed_radps[i] - before[i]) / dt_s - last[i] for i in range(4)]
        return a, b, c, d

    def _learn(self, stamp_ns: int, turned_nm: Wheels, speed_radps: Wheels) -> None:
        from_ns, to_ns = self._since_ns - self._delay_ns, stamp_ns - self._delay_ns
        if stamp_ns - self._lively_ns > _LIVELY_NS:
            self.found.rest(from_ns, to_ns, turned_nm)
        else:
            self.found.learn(self._torques, from_ns, to_ns, turned_nm, speed_radps)

    def _weighted_nm(self, from_ns: int, to_ns: int, weights: Sequence[float]) -> Wheels:
        """Mean of the torques by which a speed has changed that is made of several messages."""
        if len(weights) == 1:
            return self._mean_nm(from_ns, to_ns)
        half_ns = (to_ns - from_ns) // 2
        means = self._means
        means.append(self._mean_nm(from_ns - half_ns, to_ns - half_ns))
        while len(means) > len(weights):
            means.popleft()
        newest = weights[-len(means) :]
        total = sum(newest)
        a, b, c, d = (sum(w * mean[i] for w, mean in zip(newest, means, strict=True)) / total for i in range(4))
        return a, b, c, d

    def _mean_nm(self, from_ns: int, to_ns: int) -> Wheels:
        """Mean of the torques that acted between two times; the first that is remembered stands for those before."""
        a = b = c = d = 0.0
        k, end, whole = len(self._torques), to_ns, to_ns - from_ns
        while end > from_ns:
            k -= 1
            begin_ns, torque = self._torques[k]
            begin = max(begin_ns, from_ns) if k else from_ns
            if begin < end:
                part = (end - begin) / whole
                a, b, c, d = a + part * torque[0], b + part * torque[1], c + part * torque[2], d + part * torque[3]
                end = begin
        return a, b, c, d
