# SPDX-License-Identifier: Apache-2.0
"""What the power manager needs before it can drive: car, policies, controller, signals. In a thread of its own.

Loading takes a moment, compiling the law much longer where the cache is empty. Meanwhile the node answers its services
and says what it does.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.execution import COMPILED, Execution, plain_python
from iwm_power_manager.control.inputs import ValueLimits
from iwm_power_manager.control.monitor import DEMAND
from iwm_power_manager.control.thresholds import actuator_limits, for_car, input_limits, supervision_limits
from iwm_power_manager.errors import BagError, ConfigError, IwmError, did_you_mean, of_parameter, spelled_like
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.nodes.policy_choice import Policies, choose_policies
from iwm_power_manager.ros import messages
from iwm_power_manager.share import resolve
from iwm_power_manager.signals.commands import CommandWriter
from iwm_power_manager.signals.mapping import DEFAULT_MAPPING, DEMANDS, PEDALS, SignalMapping, load_mapping
from iwm_power_manager.signals.readings import Assembly, TopicReader, topic_readers
from iwm_power_manager.signals.types import standard_types, types_of
from iwm_power_manager.vehicle import Vehicle, load_vehicle

#: Preparing that takes longer than this is said.
SLOW_S = 3.0
#: A step in plain Python may take this part of the period, the median of so many; the longest take three times as long.
PYTHONS_PART, _TRIED_STEPS = 0.1, 20


class Prepared(NamedTuple):
    """Everything `prepare` makes.

    Attributes
    ----------
    values : the parameters it was made from
    vehicle, policies, controller : as loaded; the law is warm
    mapping : the signals file
    readers : by topic
    commands : writer of each command
    remarks : what is odd about the pedals (`Assembly.remarks`)
    elapsed_s : time it took
    compiled : kernels that the cache did not hold
    load : reads the compiled law from the cache, once it is there; None if it is in use already
    """

    values: Mapping[str, Any]
    vehicle: Vehicle
    policies: Policies
    controller: Controller
    mapping: SignalMapping
    readers: dict[str, TopicReader]
    commands: dict[str, CommandWriter]
    remarks: Callable[[], dict[str, tuple[bool, str]]]
    elapsed_s: float
    compiled: int
    load: Callable[[], None] | None = None


def prepare(values: Mapping[str, Any], at_once: bool = True) -> Prepared:
    """Load and verify everything the parameters name, and warm the compiled law.

    Parameters
    ----------
    values : of the parameters
    at_once : where the cache does not hold the compiled law, go without, if plain Python is fast enough and there will
        be a cache to read it from; not in lock-step, which waits for it, and where runs are compared

    Raises
    ------
    IwmError
        A file is missing or wrong, or a policy is of another car.
    """
    started_s = time.monotonic()
    mapping, vehicle, policies = _loaded(values)  # first: what is wrong is not to wait for compiled code
    names = tuple(values["wheel_names"])
    if values["signals_file"] == DEFAULT_MAPPING:
        mapping = mapping.with_wheel_names(names)
    thresholds = for_car(config.thresholds_of(values), vehicle.params)
    limits = ControllerLimits(
        input_limits(thresholds, vehicle.params.front.wheel.radius_m, by_clock=not values["lockstep"]),
        None if values["lockstep"] else config.age_limits_s(values),
        supervision_limits(thresholds),
        actuator_limits(thresholds),
    )
    settings = config.law_settings(values, policies.strategy)
    estimated = values["friction_source"] == config.ESTIMATED
    friction = settings.friction_prior if estimated else values["friction"]
    table = policies.table(friction)
    period_s = 1.0 / values["rate_hz"]

    def made(execution: Execution) -> Controller:
        return Controller(mapping.car(vehicle.params), names, limits, settings, table, friction, execution)

    def warm(controller: Controller) -> None:
        # The first call compiles the law or reads it from the cache: seconds that no control step may take.
        for warmed in policies.tables():
            controller.policy = warmed
            controller.step(0, period_s)
        controller.policy = table
        controller.reset()

    def load() -> None:
        with kept_only():
            warm(made(COMPILED))

    controller = made(plain_python())
    with of_parameter("signals_file"):
        readers, commands, assembly = _interface(mapping, controller, vehicle, values, limits.inputs.demand)
    from iwm_power_manager.compilation import STORE, USES, NotKeptError, kept_only  # only now: it takes a moment

    used, can_wait = len(USES), False
    try:
        load()
    except NotKeptError as error:
        warm(controller)
        can_wait = at_once and error.can_be_kept and not values["lockstep"]
        can_wait = can_wait and STORE.takes() and _keeps_up(controller, period_s)
        if not can_wait:
            warm(made(COMPILED))
    if not can_wait:
        controller.run_by(COMPILED)
    controller.table_of = policies.table if estimated else None
    return Prepared(
        values,
        vehicle,
        policies,
        controller,
        mapping,
        readers,
        commands,
        assembly.remarks,
        time.monotonic() - started_s,
        sum(not use.found for use in USES[used:]),
        load if can_wait else None,
    )


def _loaded(values: Mapping[str, Any]) -> tuple[SignalMapping, Vehicle, Policies]:
    """What stands in the files that the parameters name."""
    with of_parameter("signals_file"):
        mapping = load_mapping(resolve(values["signals_file"]))
        mapping.check_live()
    with of_parameter("vehicle_file"):
        vehicle = load_vehicle(resolve(values["vehicle_file"]), values["idle_drive"] or None)
    with of_parameter("policy_file"):
        how = values["strategy"], values["fallback"], values["rule"]
        policies = choose_policies(values["policy_file"], *how, vehicle)
    return mapping, vehicle, policies


def _keeps_up(controller: Controller, period_s: float) -> bool:
    """Whether steps take no more than their part of the period."""
    took_s = []
    for _ in range(_TRIED_STEPS):
        started_s = time.perf_counter()
        controller.step(0, period_s)
        took_s.append(time.perf_counter() - started_s)
    controller.reset()
    return statistics.median(took_s) <= PYTHONS_PART * period_s


def _interface(
    mapping: SignalMapping, controller: Controller, vehicle: Vehicle, values: Mapping[str, Any], demand: ValueLimits
) -> tuple[dict[str, TopicReader], dict[str, CommandWriter], Assembly]:
    demands = {source.topic for signal in (*DEMANDS, *PEDALS) for source in mapping.sources.get(signal, ())}
    if values["lockstep"] and len(demands) > 1:
        problem = "the demand closes a set of inputs in lock-step, and comes on two topics"
        raise ConfigError(mapping.path, "signals", problem, "one topic, or lockstep false")
    monitor = controller.monitor
    assembly = Assembly(tuple(values["wheel_names"]), vehicle.params, lambda: controller.believed_speed_mps)
    types = {}
    for source in (source for sources in mapping.sources.values() for source in sources):
        _check_installed(mapping.path, source.key, source.type)
        types[source.topic] = types_of(source.type)
    for sink in (sink for sinks in mapping.commands.values() for sink in sinks):
        _check_installed(mapping.path, sink.key, sink.type)
    axles = (vehicle.params.front, vehicle.params.rear)
    most_nm = max(max(axle.motor.peak_torque_nm, axle.friction_brake.max_torque_nm) for axle in axles)
    commands = {kind: CommandWriter(mapping.path, sinks, most_nm) for kind, sinks in mapping.commands.items()}
    readers = topic_readers(mapping, types, assembly)
    limits = f"demand_min_w {demand.minimum:g} to demand_max_w {demand.maximum:g}"
    monitor.tallies[DEMAND].describe = lambda: f"{assembly.wanted_in_words()}; allowed: {limits}"
    return readers, commands, assembly


def _check_installed(file: Path, key: str, msgtype: str) -> None:
    """DDS needs a type's support library, its definition needs the `.msg`: both come with the package."""
    try:
        messages.message_class(msgtype)
        types_of(msgtype)
    except (ImportError, BagError, ValueError):
        problem = f"{msgtype} is not installed here"
        known = standard_types().fielddefs  # by the last word: most types have "_msgs/msg/" in common
        words = spelled_like(msgtype.rpartition("/")[2], (name.rpartition("/")[2] for name in known))
        near = did_you_mean([name for word in words for name in known if name.endswith(f"/{word}")][:3])
        allowed = "a type of a sourced workspace, such as std_msgs/msg/Float64" + near
        raise ConfigError(file, f"{key}.type", problem, allowed) from None


class Preparation:
    """`prepare` in a thread.

    Parameters
    ----------
    values : of the parameters
    done : called in that thread when it has ended

    Attributes
    ----------
    values : as given
    """

    def __init__(self, values: Mapping[str, Any], done: Callable[[], None]) -> None:
        self.values = values
        self._started_s = time.monotonic()
        self._prepared: Prepared | None = None
        self._error: IwmError | None = None
        self._done = done
        self._thread = threading.Thread(target=self._run, name="preparation", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._prepared = prepare(self.values)
        except IwmError as error:
            self._error = error
        except Exception as error:  # noqa: BLE001 - whatever stood behind it, the node says so and stays unconfigured
            self._error = IwmError(f"{type(error).__name__}: {' '.join(str(error).split())}")
        finally:
            self._done()

    @property
    def running(self) -> bool:
        """It has not ended."""
        return self._thread.is_alive()

    @property
    def elapsed_s(self) -> float:
        """Time since it began."""
        return time.monotonic() - self._started_s

    def result(self) -> Prepared:
        """Wait for the end; what was prepared, or the `IwmError` that stood against it."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        assert self._prepared is not None
        return self._prepared
