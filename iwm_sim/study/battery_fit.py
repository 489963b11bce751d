# SPDX-License-Identifier: Apache-2.0
"""The paper's parameter estimation (eq. 25): the control model's battery, fitted to the plant's state of charge.

The plant drives FTP-75 and HWFET with equal split; its electrical power goes through the static circuit of the control
model (eq. 21, 22), whose resistance is chosen so that both states of charge agree best:

    RMSE = sqrt( 1/N sum (SoC_plant - SoC_model)^2 )

with the 1/N that eq. 25 lacks; without it the number grows with the length of the cycle (the minimum is the same).

What the resistance comes out as hangs on the circuit's constant voltage. An LFP cell at 80 % charge stands above its
nominal 3.3 V, so that a model at nominal voltage already draws too much current and compensates with a resistance that
is too small. So the fit is made three times: at the nominal voltage, at the mean open-circuit voltage the plant had,
and with the voltage free as well; voltage and resistance can stand in for each other, as the errors show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize, minimize_scalar

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.vehicle import Vehicle, nominal_voltage_v, with_params
from iwm_sim import closed_loop
from iwm_sim.study import cases
from iwm_sim.study.cases import Case
from iwm_sim.study.report import Column
from iwm_sim.study.tables import plain_table

FloatArray = npt.NDArray[np.float64]

CYCLES = ("ftp75", "hwfet")
PAPER_RESISTANCE_OHM = 0.063

#: What the circuits of a `Fit` are.
CIRCUITS = {
    "nominal": "R fitted at the nominal voltage",
    "plant": "R fitted at the plant's mean voltage",
    "free": "R and voltage fitted",
    "file": "as in the vehicle's file",
}

#: Resistances searched, ohm.
_HIGHEST_OHM = 0.5


class Estimate(NamedTuple):
    """A fitted circuit, and its error over all samples and on each cycle, in SoC (0..1)."""

    resistance_ohm: float
    voltage_v: float
    rmse: float
    rmse_by_cycle: dict[str, float]


class Comparison(NamedTuple):
    """Plant and fitted control model on one cycle, each (N,)."""

    time_s: FloatArray
    plant_speed_mps: FloatArray
    model_speed_mps: FloatArray
    plant_soc: FloatArray
    model_soc: FloatArray


#: Columns of a table of circuits, by their names.
COLUMNS: tuple[Column[tuple[str, Estimate]], ...] = (
    Column("Control model", lambda row: CIRCUITS[row[0]]),
    Column("Resistance", lambda row: row[1].resistance_ohm, "Ω", 4),
    Column("Voltage", lambda row: row[1].voltage_v, "V", 2),
    Column("RMSE", lambda row: 100.0 * row[1].rmse, "% SoC", 5),
)


class Fit(NamedTuple):
    """Result of the estimation.

    Attributes
    ----------
    estimates : by the names of `CIRCUITS`
    comparison : of the first cycle, with `plant` (Fig. 7)
    idle_drive : of the car
    """

    estimates: dict[str, Estimate]
    comparison: Comparison
    idle_drive: str

    def text(self) -> str:
        """The result in lines for a terminal."""

        def rmse_on(name: str) -> Column[tuple[str, Estimate]]:
            return Column(name, lambda row: 100.0 * row[1].rmse_by_cycle[name], "% SoC", 5, "RMSE on")

        columns = [*COLUMNS, *map(rmse_on, self.estimates["file"].rmse_by_cycle)]
        table = plain_table(list(self.estimates.items()), columns)
        return f"{table}\nthe paper's estimate: {PAPER_RESISTANCE_OHM} ohm"

    def to_json(self) -> dict[str, Any]:
        """The estimates, with the paper's beside them."""
        return {**self.estimates, "paper_resistance_ohm": PAPER_RESISTANCE_OHM}


def soc_of_model(
    power_w: FloatArray, dt_s: float, resistance_ohm: float, voltage_v: float, capacity_ah: float, soc: float
) -> FloatArray:
    """State of charge of the static circuit at the start of each step, for the terminal power in it (eq. 21, 22)."""
    root = np.maximum(voltage_v * voltage_v - 4.0 * resistance_ohm * power_w, 0.0)
    current = 2.0 * power_w / (voltage_v + np.sqrt(root))
    return soc - np.concatenate(([0.0], np.cumsum(current[:-1]))) * dt_s / (3600.0 * capacity_ah)


def fit(
    vehicle: str, idle_drive: str = "", cycles: Sequence[str] = CYCLES, friction: float = 0.9, soc: float = 0.8
) -> Fit:
    """Drive the cycles with the plant and equal split, and fit the static circuit to it."""
    driven = [Case(cycle, vehicle, idle_drive, friction, "equal", soc=soc) for cycle in cycles]
    runs = {}
    for case in driven:
        cases.check(case)
        runs[cases.cycle_of(case.cycle).name] = cases.drive(case)
    car = cases.vehicle_of(vehicle, idle_drive)
    battery = car.params.battery
    nominal_v = nominal_voltage_v(battery)

    def estimate(resistance_ohm: float, voltage_v: float) -> Estimate:
        circuit = (resistance_ohm, voltage_v, battery.capacity_ah)
        squares = {
            name: (soc_of_model(run["electrical_power_w"], run.dt_s, *circuit, run["soc"][0]) - run["soc"]) ** 2
            for name, run in runs.items()
        }
        return Estimate(
            float(resistance_ohm),
            float(voltage_v),
            float(np.sqrt(np.mean(np.concatenate(list(squares.values()))))),
            {name: float(np.sqrt(np.mean(errors))) for name, errors in squares.items()},
        )

    def fitted_at(voltage_v: float) -> Estimate:
        found = minimize_scalar(
            lambda ohm: estimate(ohm, voltage_v).rmse,
            bounds=(0.0, _HIGHEST_OHM),
            method="bounded",
            options={"xatol": 1e-6},
        )
        return estimate(found.x, voltage_v)

    both = minimize(
        lambda x: 1e6 * estimate(x[0], x[1] * nominal_v).rmse,
        x0=(battery.resistance_ohm, 1.01),
        bounds=((0.0, _HIGHEST_OHM), (0.8, 1.2)),
        method="Nelder-Mead",
        options={"xatol": 1e-6, "fatol": 1e-6},
    )
    cells_v = np.interp(np.concatenate([run["soc"] for run in runs.values()]), battery.ocv_soc, battery.ocv_cell_v)
    plant = fitted_at(battery.cells_in_series * float(np.mean(cells_v)))
    return Fit(
        estimates={
            "nominal": fitted_at(nominal_v),
            "plant": plant,
            "free": estimate(both.x[0], both.x[1] * nominal_v),
            "file": estimate(battery.resistance_ohm, nominal_v),
        },
        comparison=_comparison(driven[0], next(iter(runs.values())), plant, car),
        idle_drive=car.idle_drive,
    )


def _comparison(case: Case, plant: closed_loop.Run, circuit: Estimate, car: Vehicle) -> Comparison:
    """The plant beside the control model: the same car with the static circuit and motors that do not heat up."""
    battery = car.params.battery
    cell_v = circuit.voltage_v / battery.cells_in_series
    static = battery._replace(
        ocv_cell_v=np.full_like(battery.ocv_cell_v, cell_v),
        ohmic_resistance_ohm=max(circuit.resistance_ohm, 1e-9),
        ohmic_factor_at_10_percent=1.0,
        polarisation_resistance_ohm=0.0,
    )
    motor = car.params.front.motor
    cold = motor._replace(continuous_torque_nm=motor.peak_torque_nm)
    model = closed_loop.run(
        cases.cycle_of(case.cycle),
        with_params(car, "control model", car.params._replace(battery=static).with_axles(motor=cold)),
        default_settings("equal"),
        empty_table(),
        case.friction,
        soc=case.soc,
    )
    return Comparison(plant["time_s"], plant["speed_mps"], model["speed_mps"], plant["soc"], model["soc"])
