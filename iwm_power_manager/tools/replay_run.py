# SPDX-License-Identifier: Apache-2.0
"""What `replay` does with a bag: recompute and compare, ask what another strategy would take, publish."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from iwm_power_manager import __version__
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.writer import BagWriter, WriterOptions
from iwm_power_manager.control.strategies import name_of
from iwm_power_manager.errors import BagError, ConfigError, IwmError, one_line
from iwm_power_manager.exit_codes import CANNOT_TELL, DONE, FAILED
from iwm_power_manager.replay.commands import command_topics, commands_elsewhere
from iwm_power_manager.replay.compare import ReplayReport
from iwm_power_manager.replay.plan import Choice, Plan, make_plan, recorded_mapping, unknown_mapping
from iwm_power_manager.replay.run import Replay, ReplayOutput, exceeds, report_topics
from iwm_power_manager.replay.what_if import Consumption, what_if
from iwm_power_manager.signals.mapping import SignalMapping
from iwm_power_manager.tools.command import made_with, write_json
from iwm_power_manager.tools.progress import Bar

#: A mean of the steps that is so near to the period is the period.
_STEADY = 0.005


def run(options: argparse.Namespace) -> int:
    """Do what the options ask for; returns the exit code."""
    if options.publish:
        return _publish(options)
    with BagReader(options.bag) as bag:
        return _replay(bag, options) if options.what_if is None else _what_if(bag, options)


def _plan(bag: BagReader, options: argparse.Namespace, vehicle: str | None, strategy: str | None) -> Plan:
    choice = Choice(vehicle, options.policy, strategy, options.friction, options.settings, options.mapping)
    return make_plan(choice, bag.custom_data)


def _replay(bag: BagReader, options: argparse.Namespace) -> int:
    plan = _plan(bag, options, options.vehicle, options.strategy[0] if options.strategy else None)
    replay = Replay(bag, plan, options.tolerance)
    started_s = time.perf_counter()
    writer = None
    if options.output:
        writer = BagWriter(options.output, WriterOptions(), _custom_data(bag, plan))
    try:
        output = ReplayOutput(writer, bag, plan) if writer is not None else None
        with _progress(bag, options, 1) as progress:
            for message, steps in replay.steps(progress):
                if output is not None:
                    output.write(message, steps)
        if not replay.report().steps:
            raise BagError(f"{bag.path}: gave no control step: {replay.why_no_step()}")
    except (IwmError, KeyboardInterrupt):
        if writer is not None:  # what there is of it is of no use, and would be in the way of the next attempt
            writer.abandon()
            shutil.rmtree(writer.path, ignore_errors=True)
        raise
    finally:
        if writer is not None:
            writer.close()
    report = replay.report()
    elapsed_s = time.perf_counter() - started_s
    result = _result(bag, plan, report)
    lines = _report_lines(bag, report, elapsed_s)
    if options.mapping and report.exact:
        lines.append(
            f"  of {options.mapping} only the commands count: its inputs are not read where steps are recorded"
        )
    if writer is not None:
        lines.append(f"written: {writer.path}, {writer.message_count} messages")
    if options.compare:
        if result["other_policy"]:
            lines.append("  the policy is not the one that was recorded: its file or folder has another SHA-256")
        lines += _comparison_lines(report)
    code, verdict = _verdict(report, options.tolerance) if options.compare else (DONE, [])
    lines += verdict
    _show(lines, result, options)
    return code


def _verdict(report: ReplayReport, tolerance: float) -> tuple[int, list[str]]:
    """Exit code of a comparison, and a line that explains it."""
    if not any(topic.compared for topic in report.comparison):
        return CANNOT_TELL, []
    if not exceeds(report.comparison, tolerance):
        return DONE, []
    if report.several:
        why = "two nodes seem to have published the state: its steps' numbers go back and forth"
        return CANNOT_TELL, [f"  cannot tell: {why}"]
    if report.gaps and not report.changed:
        why = "the recording lacks steps whose memory may explain it; start the recorder first"
        return CANNOT_TELL, [f"  cannot tell: {why}"]
    found = f"  {report.changed} step(s) differ whatever the law remembered of those the recording lacks"
    return FAILED, [found] if report.gaps else []


def _what_if(bag: BagReader, options: argparse.Namespace) -> int:
    car = options.what_if or options.vehicle
    names = options.strategy or ["equal", name_of(_plan(bag, options, car, None).settings.strategy)]
    plans = [(name, _plan(bag, options, car, name)) for name in dict.fromkeys(names)]
    with _progress(bag, options, len(plans)) as progress:
        rows, report = what_if(bag, plans, progress)
    savings = [row.saving_percent(rows[0]) for row in rows]
    lines = [
        f"{bag.path}: open-loop estimate for {plans[0][1].vehicle.name}",
        f"  {'':20} {'Wh':>9} {'Wh/km':>8} {'at wheels':>10} {'brakes':>8} {'idle drag':>9} {'saving':>8}",
        *(_consumption_line(row, saving) for row, saving in zip(rows, savings, strict=True)),
        f"  at the force of {rows[0].label}, step by step; it tells losses, not how slip or the driver would differ",
    ]
    lines += [f"  {text}" for text in _made_with(rows, plans)]
    lines.append("  settings as recorded, unless --set or --strategy says otherwise")
    if None in savings:
        lines.append("  no saving where the motors could not give that force: the work at the wheels is another")
    lines += _remarks(report)
    found = [{**vars(row), "saving_percent": saving} for row, saving in zip(rows, savings, strict=True)]
    _show(lines, {"bag": str(bag.path), "rows": found, "notes": report.notes, "damage": bag.damage}, options)
    return DONE


def _made_with(rows: Sequence[Consumption], plans: Sequence[tuple[str, Plan]]) -> list[str]:
    """What the rows depend on; strategies that differ in nothing but their name share a line."""
    found: dict[str, list[str]] = {}
    by_label = {row.label: row for row in rows}
    for label, plan in plans:
        low, high = (f"{value:.3g}" for value in by_label[label].friction)
        friction = low if low == high else f"{low}..{high}"
        period_s = plan.settings.decision_period_s
        step_s = by_label[label].step_s
        made = made_with(friction, plan.vehicle.idle_drive, 1.0 / step_s, period_s, plan.policies.used)
        if not math.isclose(step_s, plan.period_s, rel_tol=_STEADY):
            made += "; the rate is the mean of the recorded steps"
        found.setdefault(made, []).append(label)
    return [f"{', '.join(labels)}: {text}" for text, labels in found.items()]


def _consumption_line(row: Consumption, saving: float | None) -> str:
    return (
        f"  {row.label:20} {row.chemical_wh:z9.2f} {row.wh_per_km:z8.2f} {row.wheel_work_wh:z10.2f} "
        f"{row.friction_wh:z8.2f} {row.idle_drag_wh:z9.2f} " + ("       –" if saving is None else f"{saving:z7.2f}%")
    )


def _check_commands_are_known(
    bag: BagReader, mapping: SignalMapping, reports: Sequence[str], options: argparse.Namespace
) -> None:
    """Refuse to send a drive of which nobody knows what were commands: they would go to the motors."""
    text = "does not say which topics are the car's commands, which a replay must not send"
    unknown = unknown_mapping(bag.custom_data)
    if unknown and not options.mapping:
        raise ConfigError(bag.path, "", text, f"with --mapping {unknown[:200]!r}, or by name with --topics")
    likely = {name for names in commands_elsewhere(bag, mapping, reports).values() for name in names}
    if likely and reports:
        text += f": perhaps {', '.join(sorted(likely)[:5])}"
        raise ConfigError(bag.path, "", text, "with --mapping and their recorded names, or by name with --topics")


def _publish(options: argparse.Namespace) -> int:
    from iwm_power_manager.ros.player import PlayOptions, play

    with BagReader(options.bag) as bag:
        mapping = recorded_mapping(options.mapping, bag.custom_data)
        reports = report_topics(bag)
        if not options.topics:
            _check_commands_are_known(bag, mapping, reports, options)
        return play(
            bag,
            PlayOptions(
                options.rate,
                options.step,
                options.start,
                options.end,
                options.loop,
                tuple(options.topics or ()),
                {*command_topics(bag, mapping), *reports},
                options.listeners,
            ),
        )


def _custom_data(bag: BagReader, plan: Plan) -> dict[str, str]:
    """What the new bag says about its making; no time and no path, so that the same replay gives the same bytes."""
    return {
        **bag.custom_data,
        "package_version": __version__,
        "replay_of": bag.path.name,
        "replay_vehicle_hash": plan.vehicle.hash,
        "replay_strategy": name_of(plan.settings.strategy),
        "replay_changes": json.dumps(plan.changes, sort_keys=True),
    }


def _result(bag: BagReader, plan: Plan, report: ReplayReport) -> dict[str, Any]:
    return {
        "bag": str(bag.path),
        "vehicle": plan.vehicle.name,
        "vehicle_hash": plan.vehicle.hash,
        "policies": plan.policies.checksums,
        "other_policy": _is_other_policy(bag, plan),
        **vars(report),
    }


def _is_other_policy(bag: BagReader, plan: Plan) -> bool:
    """Whether the bag names a policy by its hash and this replay used another: its commands may agree by chance."""
    recorded, used = bag.custom_data.get("policy_sha256", ""), plan.policies.content_sha256
    return bool(recorded and used and recorded != used)


def _report_lines(bag: BagReader, report: ReplayReport, elapsed_s: float) -> list[str]:
    span_s = report.span_ns * 1e-9
    how = "repeated from the recorded state" if report.exact else "made from the recorded inputs"
    first = (
        f"{bag.path}: {report.messages} messages, {report.steps} steps over {span_s:.2f} s, {how}, "
        f"in {elapsed_s:.2f} s ({report.messages / max(elapsed_s, 1e-9):.0f} messages/s)"
    )
    return [first, *_remarks(report)]


def _remarks(report: ReplayReport) -> list[str]:
    lines = [f"  {note}" for note in report.notes]
    if report.gaps:
        lines.append(f"  {report.gaps} time(s) steps before are not in the bag: the law's memory there is unknown")
    if report.restarts:
        lines.append(f"  {report.restarts} pause(s) or jump(s) back in the inputs: the law started anew")
    if report.bad_messages:
        lines.append(f"  {report.bad_messages} bad messages skipped")
    for topic, reasons in report.dropped.items():
        lines.append(f"  {topic}: not believed: " + ", ".join(f"{count} {name}" for name, count in reasons.items()))
    for reason, count in report.faults.items():
        lines.append(f"  {count} step(s) without a command: {reason}")
    return lines + [f"  damaged: {line}" for line in report.damage]


def _comparison_lines(report: ReplayReport) -> list[str]:
    lines = [f"  {'topic':32} {'compared':>9} {'differ':>8} {'largest':>11} {'rms':>11}"]
    for topic in report.comparison:
        lines.append(
            f"  {topic.topic:32} {topic.compared:9} {topic.differing:8} {topic.largest:11.4g} {topic.rms:11.4g}"
            + (f"  {topic.worst}" if topic.worst else "")
        )
        if topic.only_recorded or topic.only_recomputed:
            lines.append(f"    without counterpart: {topic.only_recorded} recorded, {topic.only_recomputed} recomputed")
        if topic.first is not None:
            first = topic.first
            lines.append(
                f"    first at message {first.message}, stamp {first.stamp_ns * 1e-9:.9f} s: {first.name} "
                f"recorded {first.recorded!r}, recomputed {first.recomputed!r}"
            )
    lines += [f"  not compared: {line}" for line in report.not_compared]
    if not any(topic.compared for topic in report.comparison):
        lines.append("  nothing to compare: no recorded command has the stamp of a recomputed one")
    return lines


def _show(lines: list[str], result: dict[str, Any], options: argparse.Namespace) -> None:
    if options.json != "-":
        print("\n".join(map(one_line, lines)))
    if options.json:
        write_json(options.json, result)


@contextmanager
def _progress(bag: BagReader, options: argparse.Namespace, passes: int) -> Iterator[Callable[[int, int], None]]:
    """Progress by the recorded time, because a damaged bag does not know its number of messages."""
    span_s = max((bag.end_ns - bag.start_ns) * 1e-9, 1e-9)
    with Bar(round(passes * span_s, 1), "s", bag.path.name, quiet=options.quiet) as bar:
        done_s = 0.0
        last = 0

        def show(messages: int, log_time_ns: int) -> None:
            nonlocal done_s, last
            if messages < last:
                done_s += span_s
            last = messages
            bar.update(done_s + (log_time_ns - bag.start_ns) * 1e-9 - bar.n)

        yield show
