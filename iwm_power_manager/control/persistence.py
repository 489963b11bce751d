# SPDX-License-Identifier: Apache-2.0
"""How much of a change of demand will last: what the driver's noise leaves of it.

The policy's Markov chain knows drives without noise. A demand that jitters, because a logged trace was rounded or a
foot shakes, looks to it like one that moves and stays, and every jump is worth a change of the split; a tenth of a
second later it is gone. So the noise is measured while driving. In a series of differences d of the demand, white noise
of variance s2 on top of a signal that wanders shows as E[d_t d_(t-1)] = -s2 (and E[d_t^2] = 2 s2 + q, with q what the
signal itself wanders): noise alone goes back the way it came. Its steady Kalman gain K, from q / s2, is the part of a
new value that lasts. The strategy then judges a share by the mean over the latest demands, weighted K (1 - K)^age,
instead of by the present one. It averages costs, not demands: the cost of a jittering demand is not that of its mean;
but for the part of its slip that wheels do not reach while it lasts (`model.decision.slip_followed`).

A brake pedal asks for a force. In a stop the power of one that rests falls with the speed, to nothing: powers of a
second ago, taken for powers of now, would be forces that nobody asks for. So braking is remembered as a force.

The noise goes on. The cost-to-go of a policy that knows none would answer the next jump with a change; what really
happens is that the share is held and meets the same jumps again. So the mean cost of a step counts for as long as the
estimate is good: until the signal, which wanders q = s2 K^2 / (1 - K) a sample, is on average over that time as
uncertain as the estimate, s2 K. That is 2 (1 - K) / K samples; the cost-to-go counts from then on. A change
away from the middle has to be worth more than chance explains: the standard error of the mean of what it saves, for the
same time.

Where no noise can be told from chance, which is every drive without any, K is 1 and nothing is averaged.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.jit import kernel

#: The demand is sampled this often, s: as a logger at 10 Hz does.
SAMPLE_S = 0.1
#: Samples remembered: one second, which is what two noisy states at 10 Hz need to be told apart, and no more.
SAMPLES = 10
#: Time constant of the moments, s.
MOMENTS_S = 10.0
#: Samples the moments rest on, and with it the chance correlation that is not taken for noise (two standard errors).
_EFFECTIVE = 2.0 * MOMENTS_S / SAMPLE_S
_CHANCE = 2.0 / math.sqrt(_EFFECTIVE)
_LEAST_GAIN = 1.0 / SAMPLES

Samples = tuple[float, float, float, float, float, float, float, float, float, float]


class Jitter(NamedTuple):
    """What is remembered of the demand.

    Attributes
    ----------
    age_s : time since the latest sample
    samples_w : demand at the latest samples, newest first
    speeds_mps : speed of the car at these
    taken : samples taken in all
    step_w : latest difference of two
    variance_w2, covariance_w2 : means of d_t^2 and d_t d_(t-1)
    gain : part of a new demand that lasts, 0..1
    """

    age_s: float
    samples_w: Samples
    speeds_mps: Samples
    taken: int
    step_w: float
    variance_w2: float
    covariance_w2: float
    gain: float


def no_jitter() -> Jitter:
    """Before the first demand."""
    return Jitter(
        age_s=0.0,
        samples_w=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        speeds_mps=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        taken=0,
        step_w=0.0,
        variance_w2=0.0,
        covariance_w2=0.0,
        gain=1.0,
    )


@kernel
def lasting_gain(variance: float, covariance: float) -> float:
    """Steady Kalman gain of a wandering signal in white noise, from the moments of its differences."""
    if -covariance <= _CHANCE * variance:
        return 1.0
    ratio = max(variance + 2.0 * covariance, 0.0) / -covariance
    return max(0.5 * (math.sqrt(ratio * ratio + 4.0 * ratio) - ratio), _LEAST_GAIN)


@kernel
def held_s(gain: float) -> float:
    """How long a share that was judged by a mean over noise meets the same noise, s."""
    return 2.0 * (1.0 - gain) / gain * SAMPLE_S


@kernel
def observed(jitter: Jitter, demand_w: float, speed_mps: float, seconds: float) -> Jitter:
    """Take note of the demand, and of the speed it was made at, `seconds` after the last time."""
    age = jitter.age_s + seconds
    if jitter.taken > 0 and age < SAMPLE_S - 1e-6:
        return Jitter(
            age,
            jitter.samples_w,
            jitter.speeds_mps,
            jitter.taken,
            jitter.step_w,
            jitter.variance_w2,
            jitter.covariance_w2,
            jitter.gain,
        )
    s, v = jitter.samples_w, jitter.speeds_mps
    samples = (demand_w, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8])
    speeds = (speed_mps, v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8])
    if jitter.taken == 0:
        return Jitter(0.0, samples, speeds, 1, 0.0, 0.0, 0.0, 1.0)
    step = demand_w - s[0]
    weight = max(SAMPLE_S / MOMENTS_S, 1.0 / jitter.taken)
    variance = jitter.variance_w2 + weight * (step * step - jitter.variance_w2)
    covariance = jitter.covariance_w2 + weight * (step * jitter.step_w - jitter.covariance_w2)
    gain = lasting_gain(variance, covariance)
    return Jitter(0.0, samples, speeds, jitter.taken + 1, step, variance, covariance, gain)


@kernel
def carried_w(jitter: Jitter, k: int, speed_mps: float, floor_mps: float) -> float:
    """The demand of the k-th sample at a speed, W: driving the same power, braking the same force.

    `floor_mps` : below it a power cannot be turned into a force (`model.pedals`)
    """
    demand_w = jitter.samples_w[k]
    if demand_w >= 0.0:
        return demand_w
    return demand_w * max(speed_mps, floor_mps) / max(jitter.speeds_mps[k], floor_mps)


@kernel
def remembered_s(jitter: Jitter) -> float:
    """For how long the demand has been sampled, s."""
    return jitter.age_s + (jitter.taken - 1) * SAMPLE_S


@kernel
def demand_ago(jitter: Jitter, demand_w: float, seconds: float) -> float:
    """The demand some time ago, W, between two samples by interpolation; the present one where none is that old."""
    position = (seconds - jitter.age_s) / SAMPLE_S
    k = int(position)
    if position < 0.0 or k + 1 >= min(jitter.taken, SAMPLES):
        return demand_w
    part = position - k
    return (1.0 - part) * jitter.samples_w[k] + part * jitter.samples_w[k + 1]
