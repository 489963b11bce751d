# SPDX-License-Identifier: Apache-2.0
"""What results amount to beside each other: a typed row for each, with its saving against equal split."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from iwm_power_manager.control.settings import as_shown
from iwm_sim.metrics import Metrics
from iwm_sim.study.cases import Case, Result, cycle_of, policy_of, vehicle_of
from iwm_sim.study.names import REFERENCE

#: Energies of two runs are compared if the distances differ by no more than this.
SAME_DISTANCE = 1e-3

#: A possible saving below this, %, has no parts.
_LEAST_POSSIBLE_PERCENT = 0.01


class Place(NamedTuple):
    """A cell of a table: where strategies are compared."""

    cycle: str
    friction: float
    idle_drive: str

    def __str__(self) -> str:
        return f"{self.cycle} {self.friction:g} {self.idle_drive}"


@dataclass(frozen=True)
class Row:
    """A driven case beside others.

    Attributes
    ----------
    place : where it was driven
    label : what tables call it
    strategy : name in `STRATEGIES`
    metrics : what was measured
    saving_percent : energy saved against equal split of the same drive; None as `saving_percent` says
    share_of_possible : the saving as a part of the most that `preview` with a budget of changes, or another strategy
        with no more changes, saves, where that was driven and there is anything to save
    same_distance_as_equal : None without equal split to compare with
    made_with : settings, hashes and whatever else the numbers depend on, as plain values
    """

    place: Place
    label: str
    strategy: str
    metrics: Metrics
    saving_percent: float | None
    share_of_possible: float | None
    same_distance_as_equal: bool | None
    made_with: Mapping[str, Any] = field(default_factory=dict)

    @property
    def possible_percent(self) -> float | None:
        """What its saving is a part of, %; None where it is a part of nothing."""
        return self.saving_percent / self.share_of_possible if self.saving_percent and self.share_of_possible else None

    def to_json(self) -> dict[str, Any]:
        """The row as a flat mapping."""
        flat: dict[str, Any] = {}
        for name, value in vars(self).items():
            flat |= (
                value._asdict()
                if isinstance(value, Place | Metrics)
                else value
                if name == "made_with"
                else {name: value}
            )
        return flat


def comparable(one: Metrics, other: Metrics) -> bool:
    """Whether two runs covered the same distance, so that their energies may be compared."""
    return abs(one.distance_m - other.distance_m) <= SAME_DISTANCE * other.distance_m


def saving_percent(one: Metrics, reference: Metrics) -> float | None:
    """Energy saved against a reference, %; None where it stood, the distances differ, or one of both lost the trace."""
    if not (one.trace_held and reference.trace_held and comparable(one, reference)):
        return None
    if reference.distance_m <= 0.0 or reference.energy_wh <= 0.0:
        return None
    return 100.0 * (1.0 - one.energy_wh / reference.energy_wh)


def policy_text(row: Row) -> str:
    """Grid and checksum of a row's policy; "" without one."""
    made = row.made_with
    return f"{made['policy_grid']} {made['policy_checksum'][:8]}" if made.get("policy_checksum") else ""


def by_place(rows: Iterable[Row]) -> dict[Place, dict[str, Row]]:
    """Rows by place, and there by label."""
    result: dict[Place, dict[str, Row]] = {}
    for row in rows:
        result.setdefault(row.place, {})[row.label] = row
    return result


def most_saved(cell: Mapping[str, Row]) -> float | None:
    """The most that any strategy saves in a place, %, however often it changes the split; None if none can be compared.

    The strategies that know the whole cycle are among them.
    """
    return max((row.saving_percent for row in cell.values() if row.saving_percent is not None), default=None)


def rows_of(results: Sequence[Result]) -> list[Row]:
    """A row for each result, with its saving against the equal split of the same drive.

    Results belong together if they differ in nothing but strategy, label, policy and law settings.
    """
    references: dict[tuple[Any, ...], Metrics] = {}
    bounds: dict[tuple[Any, ...], Result] = {}
    for made in results:
        group = _group(made.case)
        if made.case.strategy == REFERENCE:
            references.setdefault(group, made.metrics)
        if made.case.strategy == "preview" and made.case.changes_per_min > 0.0:
            bounds.setdefault(group, made)
    possible = {
        group: _possible(bound, [made for made in results if _group(made.case) == group], references.get(group))
        for group, bound in bounds.items()
    }
    return [_row(made, references.get(_group(made.case)), possible.get(_group(made.case))) for made in results]


def _possible(bound: Result, others: Sequence[Result], reference: Metrics | None) -> float | None:
    """The most that is saved with no more changes than `preview` may make, %.

    What another strategy did could have been known in advance as well.
    """
    if reference is None:
        return None
    most = max(bound.case.changes_per_min, bound.metrics.share_changes_per_min) + 1e-9
    within = [made for made in others if made is bound or made.metrics.share_changes_per_min <= most]
    savings = [saving_percent(made.metrics, reference) for made in within]
    return max((saving for saving in savings if saving is not None), default=None)


def _group(case: Case) -> tuple[Any, ...]:
    return (
        *(case.cycle, case.vehicle, case.idle_drive, case.friction, case.dt_s, case.soc),
        *(case.assumed_friction, case.noise, case.car, case.plant),
    )


def _row(made: Result, reference: Metrics | None, possible: float | None) -> Row:
    case = made.case
    saving = saving_percent(made.metrics, reference) if reference else None
    worth = saving is not None and possible is not None and possible > _LEAST_POSSIBLE_PERCENT
    return Row(
        place=Place(
            cycle_of(case.cycle).name, case.friction, vehicle_of(case.vehicle, case.idle_drive, case.car).idle_drive
        ),
        label=case.name,
        strategy=case.strategy,
        metrics=made.metrics,
        saving_percent=saving,
        share_of_possible=saving / possible if worth and saving is not None and possible else None,
        same_distance_as_equal=comparable(made.metrics, reference) if reference else None,
        made_with=_made_with(case),
    )


def _made_with(case: Case) -> dict[str, Any]:
    policy = policy_of(case.policy) if case.policy else None
    vehicle = vehicle_of(case.vehicle, case.idle_drive, case.car)
    return {
        "assumed_friction": "estimated" if case.policies else case.law_friction,
        "dt_s": case.dt_s,
        "initial_soc": case.soc,
        "noise": case.noise._asdict(),
        "plant_changes": {f"{change.section}.{change.name}": change.value for change in case.plant},
        "settings": as_shown(case.settings) | {"strategy": case.strategy},
        "rule": list(case.rule) or None,
        "preview_switching_cost_j": (
            [case.switching_cost_j, case.switching_fixed_cost_j] if case.strategy == "preview" else None
        ),
        "preview_changes_per_min": case.changes_per_min or None,
        "vehicle": vehicle.name,
        "vehicle_hash": vehicle.hash,
        "cycle_sha256": cycle_of(case.cycle).sha256,
        "policy_grid": policy.problem.name if policy else None,
        "policy_checksum": policy.checksum if policy else None,
        "policy_friction": policy.friction if policy else None,
    }
