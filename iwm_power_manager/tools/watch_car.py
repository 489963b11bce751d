# SPDX-License-Identifier: Apache-2.0
"""See a running car: one page in the browser, served on this machine only, or lines in the terminal; from topics alone.

Charts and server are Bokeh's, whose scripts come from the same server: no network is needed.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import re
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.control.supervision import MODE_NAMES, STALE_NAMES
from iwm_power_manager.control.types import GATE_NAMES, LIMIT_NAMES, WHEEL_NAMES
from iwm_power_manager.errors import FailedError, IwmError
from iwm_power_manager.exit_codes import DONE, FAILED
from iwm_power_manager.signals.contract import DIAGNOSTICS, POWER_MANAGER_STATE
from iwm_power_manager.tools.options import whole

#: Steps that are kept for a page that has just been opened, and points a chart shows.
KEPT = 3000
POINTS = 1500
#: One step of so many is drawn; the page takes what is new this often.
EVERY = 5
REFRESH_MS = 200
LEVELS = ("ok", "warn", "error", "stale")
_NAN = float("nan")
_COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")


class Row(NamedTuple):
    """One step, numbered from the first that was heard."""

    number: int
    values: dict[str, float]


class Feed:
    """What the topics have said last; filled by the executor's thread, read by the pages."""

    def __init__(self) -> None:
        self.rows: deque[Row] = deque(maxlen=KEPT)
        self.names: tuple[str, ...] = ()
        self.statuses: dict[str, tuple[str, str]] = {}
        self._heard = 0
        self._first_s: float | None = None

    def state(self, stamp_ns: int, values: Mapping[str, float]) -> None:
        """Take one step of the power manager."""
        self._heard += 1
        if self._heard % EVERY:
            return
        time_s = stamp_ns * 1e-9
        if self._first_s is None:
            self._first_s = time_s
        self.names = tuple(values)
        self.rows.append(Row(self._heard // EVERY, {"time_s": time_s - self._first_s, **values}))

    def status(self, name: str, level: int, message: str) -> None:
        """Take one status of `/diagnostics`."""
        self.statuses[name] = (LEVELS[level], message)

    def since(self, number: int) -> list[Row]:
        """Steps after that one, oldest first."""
        newer = itertools.takewhile(lambda row: row.number > number, reversed(list(self.rows)))
        return list(newer)[::-1]


def in_words(values: Mapping[str, float]) -> list[str]:
    """Mode, gate, limits and missing inputs of a step, and its main numbers."""
    limits = [name for bit, name in LIMIT_NAMES.items() if int(values["limits"]) & bit]
    missing = [name for bit, name in STALE_NAMES.items() if int(values["stale"]) & bit]
    return [
        f"mode: {MODE_NAMES[int(values['mode'])]}",
        f"gate: {GATE_NAMES[int(values['gate'])]}",
        f"limits that bind: {', '.join(limits) or 'none'}",
        f"missing: {', '.join(missing) or 'nothing'}",
        f"speed {values['speed_mps']:.2f} m/s",
        f"demand {values['power_demand_w'] / 1e3:.2f} kW",
        f"front share {values['front_share']:.2f}",
        f"charge {100.0 * values['soc']:.1f} %",
    ]


def charts(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Title of each chart, and its lines: signal by label."""
    slips = {name.removesuffix("_slip"): name for name in names if name.endswith("_slip") and "." not in name}
    return {
        "speed, m/s": {"car": "speed_mps"},
        "power demand, W": {"asked": "requested_power_w", "used": "power_demand_w"},
        "front share": {"applied": "front_share", "decided": "decided_share"},
        "motor torque, N m": {wheel: f"{wheel}_motor_torque_nm" for wheel in WHEEL_NAMES},
        "friction brake torque, N m": {wheel: f"{wheel}_friction_torque_nm" for wheel in WHEEL_NAMES},
        "slip": slips,
        "motor torque allowed, 0..1": {"factor": "motor_factor"},
    }


def make_page(document: Any, feed: Feed) -> None:
    """Fill a browser's document, and keep it filled."""
    from bokeh.layouts import column, gridplot
    from bokeh.models.sources import ColumnDataSource
    from bokeh.models.widgets import DataTable, Div, TableColumn
    from bokeh.plotting import figure

    lines = charts(feed.names)
    signals = sorted({signal for drawn in lines.values() for signal in drawn.values()})
    state = ColumnDataSource({name: [] for name in ("time_s", *signals)}, name="state")
    words = Div(text="nothing heard yet", name="words")
    table = ColumnDataSource({"level": [], "name": [], "message": []}, name="diagnostics")
    figures: list[Any] = []
    for title, drawn in lines.items():
        shared = {"x_range": figures[0].x_range} if figures else {}
        chart = figure(title=title, height=220, width=560, tools="pan,wheel_zoom,reset", **shared)
        for color, (label, signal) in zip(_COLORS, drawn.items(), strict=False):
            chart.line("time_s", signal, source=state, legend_label=label, color=color)
        chart.legend.label_text_font_size = "8pt"
        chart.legend.visible = len(drawn) > 1
        figures.append(chart)
    widths = {"level": 60, "name": 260, "message": 780}
    columns = [TableColumn(field=field, title=field, width=width) for field, width in widths.items()]
    statuses = DataTable(source=table, columns=columns, width=1120, height=240, index_position=None)
    document.title = "power manager"
    document.add_root(column(words, gridplot(figures, ncols=2, merge_tools=False), statuses))
    seen = 0

    def refresh() -> None:
        nonlocal seen
        rows = feed.since(seen)
        if rows:
            seen = rows[-1].number
            words.text = " &nbsp;·&nbsp; ".join(in_words(rows[-1].values))
            found: dict[str, Any] = {
                name: [row.values.get(name, float("nan")) for row in rows] for name in ("time_s", *signals)
            }
            state.stream(found, rollover=POINTS)
        shown = sorted(feed.statuses.items())
        table.data = {
            "level": [level for _, (level, _) in shown],
            "name": [name for name, _ in shown],
            "message": [message for _, (_, message) in shown],
        }

    document.add_periodic_callback(refresh, REFRESH_MS)


def listen(feed: Feed, arguments: Sequence[str]) -> tuple[Any, threading.Thread, Any]:
    """Hear state and diagnostics in a thread: the node, the thread, and its executor."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import ExternalShutdownException, InvalidHandle, SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import JointState

    from iwm_power_manager.ros import messages, qos

    rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    node = Node("watch_car", enable_rosout=False, start_parameter_services=False)
    asked = qos.profile(lockstep=False, depth=100, reliability="best_effort")
    node.create_subscription(
        JointState, POWER_MANAGER_STATE, lambda message: feed.state(*messages.read_named_numbers(message)), asked
    )

    namespace = node.get_namespace()
    of_this_car = "" if namespace == "/" else f"{namespace}/"

    def diagnosed(message: DiagnosticArray) -> None:
        for status in message.status:
            if not status.name.startswith(of_this_car):
                continue
            feed.status(status.name, status.level[0], status.message)

    node.create_subscription(DiagnosticArray, DIAGNOSTICS, diagnosed, asked)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        with suppress(ExternalShutdownException, InvalidHandle):  # the end may come while it waits
            executor.spin()

    thread = threading.Thread(target=spin, name="topics", daemon=True)
    thread.start()
    return node, thread, executor


def serve(feed: Feed, port: int, *, open_browser: bool) -> None:
    """Serve pages until Ctrl-C or SIGTERM."""
    import signal

    from bokeh.application import Application
    from bokeh.application.handlers import FunctionHandler
    from bokeh.server.server import Server

    application = Application(FunctionHandler(lambda document: make_page(document, feed)))
    try:
        server = Server({"/": application}, address="127.0.0.1", port=port)
    except OSError as error:
        raise FailedError(f"--port {port}: {error.strerror or error}") from None
    url = f"http://localhost:{server.port}/"
    loop = server.io_loop
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: loop.add_callback_from_signal(loop.stop))
    server.start()
    print(f"watch_car: {url}", flush=True)
    if open_browser:
        loop.add_callback(server.show, "/")
    loop.start()
    server.stop()


def report(feed: Feed) -> str:
    """What there is to say in a terminal: one line of the last step, one for each status that is not ok."""
    rows = list(feed.rows)
    lines = [" | ".join(in_words(rows[-1].values)) if rows else "nothing heard yet"]
    lines += [
        f"  {level:5} {name}: {text}" for name, (level, text) in sorted(feed.statuses.items()) if level != LEVELS[0]
    ]
    return "\n".join(lines)


def print_reports(feed: Feed) -> None:
    """Print a report a second until Ctrl-C or SIGTERM."""
    import signal

    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    while not ended.wait(1.0):
        print(report(feed), flush=True)


def _full_name(text: str) -> list[str]:
    """Argument type of a node's full name: the ROS arguments with which its topics are heard."""
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text} is no full name of a node; allowed: such as /car_1/power_manager")
    namespace, _, name = text.rpartition("/")
    return ["--ros-args", "-r", f"__ns:={namespace or '/'}", "-r", f"{POWER_MANAGER_STATE}:={name}/state", "--"]


_EXAMPLES = """\
examples:
  The car on this machine's domain, in the browser:
    watch_car
  Over ssh, without a browser:
    watch_car --terminal
  A power manager in a namespace, or under another name:
    watch_car --node /car_1/power_manager
  ROS arguments stand last:
    watch_car --ros-args -r __ns:=/car_1 -r power_manager/state:=my_node/state

exit codes: 0 ended with Ctrl-C, 1 could not serve, 2 bad arguments
"""


def main(args: Sequence[str] | None = None) -> int:
    """Run the page; returns the exit code."""
    parser = CommandParser(
        "watch_car",
        description="Show a running car in the browser, from the power manager's topics alone; Ctrl-C ends it.",
        epilog=_EXAMPLES,
    )
    parser.add_argument(
        "--node", type=_full_name, metavar="NAME", help="full name of the node, as /car_1/power_manager"
    )
    parser.add_argument(
        "--port", type=whole(0, 65535), default=8321, help="port on this machine (default 8321; 0: any)"
    )
    parser.add_argument("--terminal", action="store_true", help="no page: print state and diagnostics once a second")
    parser.add_argument("--no-browser", action="store_true", help="only serve, and print the address")
    given = list(sys.argv[1:] if args is None else args)
    own = given[: given.index("--ros-args")] if "--ros-args" in given else given
    options = parser.parse_args(own)
    if not options.terminal and importlib.util.find_spec("bokeh") is None:
        print("watch_car: needs the package bokeh (python3-bokeh-pip, or pip install bokeh)", file=sys.stderr)
        return FAILED
    from iwm_power_manager.ros import ending

    feed = Feed()
    node, thread, executor = listen(feed, ["watch_car", *(options.node or []), *given[len(own) :]])
    code = FAILED
    try:
        if options.terminal:
            print_reports(feed)
        else:
            serve(feed, options.port, open_browser=not options.no_browser)
        code = DONE
    except IwmError as error:
        code = error.exit_code
        print(f"watch_car: {error}", file=sys.stderr)
    finally:
        with ending.bounded(code):
            executor.shutdown()
            thread.join(1.0)
            node.destroy_node()
            node = executor = None
    return code


if __name__ == "__main__":
    sys.exit(main())
