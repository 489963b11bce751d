# SPDX-License-Identifier: Apache-2.0
"""The simulated battery and the energy balance of a car, from their equations."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq


def open_circuit_v(soc, battery):
    return battery.cells_in_series * float(np.interp(soc, battery.ocv_soc, battery.ocv_cell_v))


def ohmic_ohm(soc, battery):
    """Constant above 30 %, the given factor at 10 %, on a line below."""
    return battery.ohmic_resistance_ohm * float(
        np.interp(
            soc,
            [-1.0, 0.1, 0.3],
            [1.0 + (battery.ohmic_factor_at_10_percent - 1.0) * 6.5, battery.ohmic_factor_at_10_percent, 1.0],
        )
    )


def battery_at(power, seconds, soc, battery):
    """State of charge, polarisation voltage and current of a rested pack after a time at a constant power."""

    def current(soc, polarisation):
        source, r = open_circuit_v(soc, battery) - polarisation, ohmic_ohm(soc, battery)
        return brentq(lambda i: i * (source - r * i) - power, -source / r, source / (2.0 * r))

    def rates(_, x):
        i = current(*x)
        charged = battery.polarisation_resistance_ohm * i
        return [-i / 3600.0 / battery.capacity_ah, (charged - x[1]) / battery.polarisation_time_constant_s]

    end = solve_ivp(rates, (0.0, seconds), [soc, 0.0], rtol=1e-8, atol=1e-10).y[:, -1]
    return end[0], end[1], current(*end)


def imbalance_j(before, after, vehicle):
    """Chemical energy less everything it went into."""
    books = {name: getattr(after.energies, name) - getattr(before.energies, name) for name in after.energies._fields}
    inertia, battery = vehicle.front.wheel.inertia_kgm2, vehicle.battery

    def stored(state):
        chassis = vehicle.chassis
        kinetic = 0.5 * chassis.mass_kg * (state.speed_mps**2 + state.lateral_speed_mps**2)
        kinetic += 0.5 * chassis.yaw_inertia_kgm2 * state.yaw_rate_radps**2
        kinetic += sum(0.5 * inertia * w**2 for w in state.wheel_speed_radps)
        r1 = battery.polarisation_resistance_ohm
        return kinetic + (0.5 * battery.polarisation_time_constant_s / r1 * state.polarisation_v**2 if r1 else 0.0)

    return 2.0 * books["chemical_j"] - sum(books.values()) - (stored(after) - stored(before))
