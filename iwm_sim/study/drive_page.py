# SPDX-License-Identifier: Apache-2.0
"""The page of one drive: result beside a reference, everything over time, settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.types import GATE_NAMES
from iwm_sim.closed_loop import Run
from iwm_sim.metrics import MOVING_MPS, Metrics
from iwm_sim.study.report import Block, Chart, Column, Page, Panel, Series, Settings, Table, Text, Tile, Tiles, Verdict
from iwm_sim.study.report import format_value as shown
from iwm_sim.study.rows import saving_percent

BLUE, VERMILION, GREEN, PURPLE, OCHRE, SKY, GREY, BLACK = range(8)
#: Below it a car stands.
STANDING_MPS = 0.1


class Driven(NamedTuple):
    """A run with what it amounts to.

    Attributes
    ----------
    strategy : its name
    made : how the run was made
    run, metrics : the numbers
    """

    strategy: str
    made: str
    run: Run
    metrics: Metrics


@dataclass(frozen=True)
class DriveRow:
    """A run as tables show it, and as the JSON result has it.

    Attributes
    ----------
    strategy, made : as in `Driven`
    metrics : what was measured
    saving_percent : against the reference; None for itself, and as `rows.saving_percent` says
    share_changes_per_min : None where the law's decisions are not known
    """

    strategy: str
    made: str
    metrics: Metrics
    saving_percent: float | None
    share_changes_per_min: float | None

    def to_json(self) -> dict[str, Any]:
        """The row as a flat mapping."""
        return {
            "strategy": self.strategy,
            "made": self.made,
            **self.metrics._asdict(),
            "distance_km": self.metrics.distance_m / 1000.0,
            "saving_percent": self.saving_percent,
            "share_changes_per_min": self.share_changes_per_min,
        }


COLUMNS: tuple[Column[DriveRow], ...] = (
    Column("Strategy", lambda row: row.strategy),
    Column("Saving", lambda row: row.saving_percent, "%", 2),
    Column("Energy", lambda row: row.metrics.wh_per_km, "Wh/km", 2, best="low"),
    Column("ΔSoC", lambda row: row.metrics.delta_soc_percent, "%", 3, best="low"),
    Column("Driven", lambda row: row.metrics.distance_m / 1000.0, "km", 3),
    Column("error", lambda row: row.metrics.rms_speed_error_mps, "m/s RMS", 3, group="Speed"),
    Column("min", lambda row: row.metrics.min_slip, decimals=3, group="Slip"),
    Column("max", lambda row: row.metrics.max_slip, decimals=3, group="Slip"),
    Column("changes", lambda row: row.share_changes_per_min, "1/min", 1, group="Split"),
    Column("Trace", lambda row: Verdict(row.metrics.trace_held, "held" if row.metrics.trace_held else "lost")),
    Column("Run", lambda row: row.made),
)


def row(driven: Driven, reference: Driven) -> DriveRow:
    """A run beside the reference; energies are compared only between runs over the same distance (0.1 %)."""
    known = not np.isnan(driven.run["decided_share"]).all()
    return DriveRow(
        strategy=driven.strategy,
        made=driven.made,
        metrics=driven.metrics,
        saving_percent=None if driven is reference else saving_percent(driven.metrics, reference.metrics),
        share_changes_per_min=driven.metrics.share_changes_per_min if known else None,
    )


def drive_page(
    driven: Driven,
    reference: Driven,
    *,
    cycle: str,
    idle_drive: str,
    critical_slip: float,
    settings: Mapping[str, Any],
    remarks: Sequence[str],
) -> Page:
    """The page of a drive.

    Parameters
    ----------
    driven, reference : the drive shown and the one it is compared with
    cycle : name of the cycle
    idle_drive : the vehicle's, on which the saving depends most
    critical_slip : drawn beside the slips
    settings : what the runs were made with
    remarks : sentences below the table
    """
    rows = [row(driven, reference), row(reference, reference)]
    metrics = driven.metrics
    saving = rows[0].saving_percent
    if driven.strategy == reference.strategy:
        lead = f"{metrics.distance_m / 1000:.2f} km with {driven.strategy} distribution"
    elif saving is None:
        lead = f"{driven.strategy} and {reference.strategy} did not cover the same distance: compare Wh/km only"
    else:
        word = "less" if saving >= 0.0 else "more"
        lead = (
            f"{driven.strategy} took {abs(saving):.2f} % {word} energy than {reference.strategy} distribution over the "
            f"same {metrics.distance_m / 1000:.2f} km"
        )
    lead += f"; idle drive: {idle_drive}."
    held = "the car kept within 2 mph of the cycle's speed, inside 1 s (EPA tolerance)"
    lost = f"the car left the EPA tolerance by up to {metrics.trace_excess_mps:.2f} m/s: its energy may not be compared"
    blocks: list[Block] = [
        Tiles(_tiles(rows[0], rows[1])),
        Table("Result", COLUMNS, rows, " ".join(remarks), lambda made: made.metrics.trace_held),
        Chart("The drive", driven.run["time_s"], _panels(driven, reference, critical_slip)),
        Text(
            "Powers are those of the commands at the wheels, braking negative. Slip is the wheel's, drawn above "
            f"{MOVING_MPS:g} m/s. A gate holds an axle at zero torque while its slip is beyond the critical one. "
            "Energy saved is the reference's battery energy up to the same time, less this run's. While the car stands "
            "brakes hold it, no power flows, and the split keeps what it was at the last stop: it is not drawn.",
            "How to read it",
        ),
        Settings("Settings", settings),
    ]
    return Page(f"{driven.strategy} on {cycle}", lead, blocks, metrics.trace_held, held if metrics.trace_held else lost)


def _tiles(row: DriveRow, other: DriveRow) -> list[Tile]:
    name, metrics, beside = other.strategy, row.metrics, other.metrics
    slips = f"{shown(metrics.min_slip, 3)} … {shown(metrics.max_slip, 3)}"
    return [
        Tile("Saving", shown(row.saving_percent, 2), "%", f"against {name}"),
        Tile("Energy", shown(metrics.wh_per_km, 2), "Wh/km", f"{name}: {shown(beside.wh_per_km, 2)}"),
        Tile("ΔSoC", shown(metrics.delta_soc_percent, 3), "%", f"{name}: {shown(beside.delta_soc_percent, 3)}"),
        Tile(
            "Distance", shown(metrics.distance_m / 1000.0, 3), "km", f"{name}: {shown(beside.distance_m / 1000.0, 3)}"
        ),
        Tile("Slip", slips, "", "both axles, above 1 m/s"),
        Tile("Front share", shown(row.share_changes_per_min, 1), "/ min", "changes by more than 0.25"),
    ]


def _panels(driven: Driven, reference: Driven, critical_slip: float) -> list[Panel]:
    run = driven.run
    panels = [
        Panel(
            "Speed", "m/s", [Series("cycle", run["trace_mps"], OCHRE, wide=True), Series("car", run["speed_mps"], BLUE)]
        ),
        Panel(
            "Power",
            "kW",
            [
                Series("demand P_dem", run["power_demand_w"] / 1e3, GREY),
                Series("front P_f", _axle_power_w(run, "front") / 1e3, BLUE, wide=True),
                Series("rear P_r", _axle_power_w(run, "rear") / 1e3, VERMILION),
            ],
        ),
    ]
    if not np.isnan(run["front_share"]).all():
        standing = run["speed_mps"] < STANDING_MPS
        panels.append(
            Panel(
                "Front share",
                "",
                [
                    Series("applied", np.where(standing, np.nan, run["front_share"]), BLUE),
                    Series("decided", np.where(standing, np.nan, run["decided_share"]), GREY, dashed=True, step=True),
                ],
                limits=(0.0, 1.0),
            )
        )
    moving = run["speed_mps"] > MOVING_MPS
    panels += [
        Panel(
            "Slip",
            "",
            [
                Series("front", np.where(moving, run["front_slip"], np.nan), BLUE, wide=True),
                Series("rear", np.where(moving, run["rear_slip"], np.nan), VERMILION),
            ],
            decimals=4,
            references=(
                (-critical_slip, f"critical −{critical_slip:g}"),
                (critical_slip, f"critical {critical_slip:g}"),
            ),
        ),
        Panel(
            "Torque of a wheel",
            "N m",
            [
                Series("front motor", run["front_motor_nm"], BLUE, wide=True),
                Series("rear motor", run["rear_motor_nm"], VERMILION),
                Series("front brake", run["front_friction_nm"], SKY, wide=True),
                Series("rear brake", run["rear_friction_nm"], OCHRE),
            ],
            decimals=1,
        ),
    ]
    if not np.isnan(run["gate"]).all():
        panels.append(
            Panel(
                "Gate",
                "",
                [Series("axles held at zero torque", run["gate"], PURPLE, step=True)],
                ticks=tuple(enumerate(GATE_NAMES)),
                limits=(0.0, 3.0),
            )
        )
    panels.append(Panel("State of charge", "%", [Series("battery", 100.0 * run["soc"], GREEN)], decimals=3))
    if reference.strategy != driven.strategy and len(reference.run.series) >= len(run.series):
        used = reference.run["chemical_j"][: len(run.series)]
        panels.append(
            Panel(
                "Energy saved",
                "Wh",
                [Series(f"against {reference.strategy}", (used - run["chemical_j"]) / 3600.0, GREEN)],
            )
        )
    return panels


def _axle_power_w(run: Run, axle: str) -> NDArray[np.float64]:
    """What the law commanded, or, where that is not known, what motors and brakes did."""
    commanded = run[f"{axle}_power_w"]
    torque = run[f"{axle}_motor_nm"] + run[f"{axle}_friction_nm"]
    return np.where(np.isnan(commanded), 2.0 * torque * run[f"{axle}_wheel_radps"], commanded)
