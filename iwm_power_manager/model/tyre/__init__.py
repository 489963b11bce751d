# SPDX-License-Identifier: Apache-2.0
"""Tyre: slip (eq. 10), and friction over slip by the model that the vehicle file names.

Each model is a module of its own that alone knows its parameters; here they are told apart by a number, at run time, so
that cars with different tyres share the compiled code. A new model is its module, its lines here and its test.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import Tyre
from iwm_power_manager.model.tyre import fiala, magic_formula
from iwm_power_manager.model.tyre.slip import slip_ratio, wheel_speed_at_slip

__all__ = [
    "DEFAULT",
    "MODELS",
    "TyreModel",
    "friction_and_slope",
    "friction_coefficient",
    "least_slip_at_friction",
    "make",
    "numbers",
    "peak_ratio",
    "peak_slip",
    "slip_at_friction",
    "slip_ratio",
    "wheel_speed_at_slip",
]

_MAGIC_FORMULA, _FIALA = range(2)

#: The model of a vehicle file that names none.
DEFAULT = "magic_formula"


class TyreModel(NamedTuple):
    """A model: its number, and its keys in a vehicle file with range and meaning, in the order of the coefficients."""

    code: int
    ranges: dict[str, tuple[float, float]]
    meanings: dict[str, str]


MODELS = {
    "magic_formula": TyreModel(_MAGIC_FORMULA, magic_formula.RANGES, magic_formula.MEANINGS),
    "fiala": TyreModel(_FIALA, fiala.RANGES, fiala.MEANINGS),
}


def make(name: str, values: Mapping[str, float], slip_speed_floor_mps: float) -> Tyre:
    """A tyre from a model's name and the values of its keys."""
    model = MODELS[name]
    a, b, c, d = [float(values[key]) for key in model.ranges] + [0.0] * (4 - len(model.ranges))
    return Tyre(model.code, (a, b, c, d), float(slip_speed_floor_mps))


def numbers(tyre: Tyre) -> tuple[str, dict[str, float]]:
    """Name of a tyre's model and the values of its keys, as a vehicle file has them."""
    name, model = next((name, model) for name, model in MODELS.items() if model.code == tyre.model)
    return name, dict(zip(model.ranges, tyre.coefficients, strict=False))


@kernel
def friction_coefficient(slip: float, peak_friction: float, tyre: Tyre) -> float:
    """Friction coefficient in use at a slip, -1 (locked) to 1, on a road of this peak friction."""
    if tyre.model == _FIALA:
        return fiala.friction_coefficient(slip, peak_friction, tyre.coefficients)
    return magic_formula.friction_coefficient(slip, peak_friction, tyre.coefficients)


@kernel
def friction_and_slope(slip: float, peak_friction: float, tyre: Tyre) -> tuple[float, float]:
    """Friction coefficient at a slip and its derivative with respect to slip."""
    if tyre.model == _FIALA:
        return fiala.friction_and_slope(slip, peak_friction, tyre.coefficients)
    return magic_formula.friction_and_slope(slip, peak_friction, tyre.coefficients)


@kernel
def slip_at_friction(friction: float, peak_friction: float, tyre: Tyre) -> float:
    """Slip on the rising branch at which the tyre gives this friction coefficient.

    A demand beyond the peak returns the slip of the peak, with the sign of the demand.
    """
    if tyre.model == _FIALA:
        return fiala.slip_at_friction(friction, peak_friction, tyre.coefficients)
    return magic_formula.slip_at_friction(friction, peak_friction, tyre.coefficients)


@kernel
def least_slip_at_friction(friction: float, peak_friction: float, tyre: Tyre) -> float:
    """A slip of the same sign as `slip_at_friction` and never larger, without solving for it."""
    if tyre.model == _FIALA:
        return fiala.least_slip_at_friction(friction, peak_friction, tyre.coefficients)
    return magic_formula.least_slip_at_friction(friction, peak_friction, tyre.coefficients)


@kernel
def peak_ratio(tyre: Tyre) -> float:
    """Largest friction coefficient the tyre reaches, as a multiple of the road's peak friction."""
    if tyre.model == _FIALA:
        return 1.0
    return magic_formula.peak_ratio(tyre.coefficients)


@kernel
def peak_slip(tyre: Tyre, peak_friction: float = 1.0) -> float:
    """Slip at which the friction is largest on a road of this peak friction (0.18 for the paper's tyre on any road)."""
    return slip_at_friction(2.0 * peak_friction * peak_ratio(tyre), peak_friction, tyre)
