# SPDX-License-Identifier: Apache-2.0
"""Battery of the control-oriented model: a voltage source behind a resistance (eq. 21, 22, Fig. 6).

The paper prints the other root in eq. 21 (3771 A at no load) and no sign in eq. 22; here a discharging current is
positive and lowers the state of charge.
"""

from __future__ import annotations

import math

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import Battery


@kernel
def current_a(power_w: float, open_circuit_v: float, resistance_ohm: float) -> float:
    """Current that gives this terminal power (eq. 21, smaller root), discharge positive.

    A power beyond Voc^2 / 4R cannot be given; the current of the largest power is returned.
    """
    root = open_circuit_v * open_circuit_v - 4.0 * resistance_ohm * power_w
    if root <= 0.0:
        return open_circuit_v / (2.0 * resistance_ohm)
    return 2.0 * power_w / (open_circuit_v + math.sqrt(root))  # the same root, without cancellation at small power


@kernel
def chemical_power_w(power_w: float, battery: Battery) -> float:
    """Power taken out of the cells, W: terminal power plus R I^2. Proportional to the depletion Delta SoC."""
    open_circuit_v = battery.cells_in_series * battery.nominal_cell_voltage_v
    return open_circuit_v * current_a(power_w, open_circuit_v, battery.resistance_ohm)


@kernel
def depletion_per_joule(battery: Battery) -> float:
    """Delta SoC (0..1, eq. 22) for each joule of chemical energy of the control model."""
    return 1.0 / (3600.0 * battery.capacity_ah * battery.cells_in_series * battery.nominal_cell_voltage_v)
