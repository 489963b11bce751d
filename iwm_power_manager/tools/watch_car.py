# SPDX-License-Identifier: Apache-2.0
"""See a running car: one page in the browser, served on this machine only, or lines in the terminal; from topics alone.

Charts and server are Bokeh's, whose scripts come from the same server: no network is needed.
"""

from __future__ import annotations

import argparse
import html
import importlib.util
import itertools
import logging
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.control.supervision import MODE_NAMES, MODE_NORMAL, STALE_NAMES, binding_limits
from iwm_power_manager.control.types import GATE_NAMES, WHEEL_NAMES
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
_NAN = float("nan")
_TEMPLATE = """\
{% block preamble %}<meta name="viewport" content="width=device-width, initial-scale=1">{% endblock %}
"""
_NO_BOKEH = (
    "watch_car: the page needs the package bokeh: in a checkout `make setup`, with ROS the rosdep key "
    "python3-bokeh-pip, else pip install bokeh; --terminal needs none"
)
#: Without a step for so long, it is said.
QUIET_S = 1.0
LEVELS = ("ok", "warn", "error", "stale")
_LEVEL_COLORS = {"ok": "transparent", "warn": "#ffe08a", "error": "#f4a6a6", "stale": "#d0d0d0"}
_FRONT, _REAR = "#4477aa", "#ee6677"
#: Left and right wheels mostly do the same: the right one is dashes of another colour upon the left one's line.
_WHEEL_LINES = dict(
    zip(
        WHEEL_NAMES,
        ((_FRONT, "solid"), ("#002255", "dashed"), (_REAR, "solid"), ("#881122", "dashed")),
        strict=True,
    )
)


class Line(NamedTuple):
    """A signal of the state in a chart."""

    label: str
    signal: str
    color: str
    dash: str = "solid"
    width: float = 2.0


class Chart(NamedTuple):
    """A chart: its title with the unit, its lines, and what its axis shows at least."""

    title: str
    lines: tuple[Line, ...]
    least: tuple[float, float]


def _wheels(signal: str) -> tuple[Line, ...]:
    return tuple(Line(wheel.replace("_", " "), f"{wheel}_{signal}", *look) for wheel, look in _WHEEL_LINES.items())


BRAKES = Chart("friction brake torque, N m", _wheels("friction_torque_nm"), (-10.0, 0.0))
CHARTS = (
    Chart(
        "speed, m/s",
        (Line("sensor", "speed_mps", _REAR, width=0.8), Line("believed", "estimated_speed_mps", _FRONT)),
        (0.0, 1.0),
    ),
    Chart(
        "power demand, W",
        (Line("asked", "requested_power_w", _REAR, width=0.8), Line("used", "power_demand_w", _FRONT)),
        (-100.0, 100.0),
    ),
    Chart(
        "front share",
        (Line("decided", "decided_share", _REAR, width=0.8), Line("applied", "front_share", _FRONT)),
        (0.0, 1.0),
    ),
    Chart("motor torque, N m", _wheels("motor_torque_nm"), (-10.0, 10.0)),
    BRAKES,
    Chart("slip", (Line("front", "front_slip", _FRONT), Line("rear", "rear_slip", _REAR)), (-0.05, 0.05)),
    Chart("motor torque allowed, 0..1", (Line("factor", "motor_factor", _FRONT),), (0.0, 1.0)),
)
_SIGNALS = sorted({line.signal for chart in CHARTS for line in chart.lines})


class Row(NamedTuple):
    """One step, numbered from the first that was heard."""

    number: int
    values: dict[str, float]


class Feed:
    """What the topics have said last; filled by the executor's thread, read by the pages.

    Attributes
    ----------
    topic : full name of the state's topic
    car : the vehicle's name; "" as long as the node has not said it
    foreign_brakes : the node says that another system has the friction brakes
    others : what there is to say of nodes with other names
    """

    def __init__(self) -> None:
        self.rows: deque[Row] = deque(maxlen=KEPT)
        self.statuses: dict[str, tuple[str, str]] = {}
        self.topic = f"/{POWER_MANAGER_STATE}"
        self.car = ""
        self.foreign_brakes = False
        self.others = ""
        self._heard = 0
        self._heard_s = time.monotonic()
        self._first_s: float | None = None

    def state(self, stamp_ns: int, values: Mapping[str, float]) -> None:
        """Take one step of the power manager."""
        self._heard += 1
        self._heard_s = time.monotonic()
        if self._heard % EVERY:
            return
        time_s = stamp_ns * 1e-9
        if self._first_s is None:
            self._first_s = time_s
        self.rows.append(Row(self._heard // EVERY, {"time_s": time_s - self._first_s, **values}))

    def status(self, name: str, level: int, message: str, values: Mapping[str, str] | None = None) -> None:
        """Take one status of `/diagnostics`."""
        self.statuses[name] = (LEVELS[min(level, len(LEVELS) - 1)], message)
        if values and name == f"{self.node}: control":
            self.car = values.get("vehicle", "")
            self.foreign_brakes = values.get("friction brakes") == "another system"

    @property
    def node(self) -> str:
        """Full name of the node."""
        return self.topic.rpartition("/")[0]

    def silence(self) -> str:
        """What is waited for; "" while steps come."""
        silent_s = time.monotonic() - self._heard_s
        if not self.rows:
            return f"waiting for {self.topic} ({silent_s:.0f} s){self.others}"
        return f"nothing new on {self.topic} for {silent_s:.0f} s" if silent_s > QUIET_S else ""

    def since(self, number: int) -> list[Row]:
        """Steps after that one, oldest first."""
        newer = itertools.takewhile(lambda row: row.number > number, reversed(list(self.rows)))
        return list(newer)[::-1]


def in_words(values: Mapping[str, float]) -> list[str]:
    """Mode, gate, limits and missing inputs of a step, and its main numbers."""
    limits = binding_limits(int(values["limits"]), values["motor_factor"])
    nothing = "nothing" if int(values["mode"]) == MODE_NORMAL else "nothing now"
    missing = [name for bit, name in STALE_NAMES.items() if int(values["stale"]) & bit]
    speed = f"speed {values['speed_mps']:.2f} m/s"
    if "vehicle_speed" in missing:
        speed = f"speed not known (last {values['speed_mps']:.2f} m/s)"
    elif int(values.get("doubted", 0.0)) & 1 << len(WHEEL_NAMES):
        speed = f"speed {values['estimated_speed_mps']:.2f} m/s (sensor not believed: {values['speed_mps']:.2f} m/s)"
    return [
        f"mode: {MODE_NAMES[int(values['mode'])]}",
        f"gate: {GATE_NAMES[int(values['gate'])]}",
        f"limits that bind: {', '.join(limits) or 'none'}",
        f"missing: {', '.join(missing) or nothing}",
        speed,
        f"demand {values['power_demand_w'] / 1e3:.2f} kW",
        f"front share {values['front_share']:.2f}",
        f"charge {100.0 * values['soc']:.1f} %",
    ]


def last_words(feed: Feed) -> list[str]:
    """The last step in words, and before it that there is none, or has been none for long."""
    rows = list(feed.rows)
    return [*filter(None, [feed.silence()]), *(in_words(rows[-1].values) if rows else [])]


def heading_html(feed: Feed) -> str:
    """Node and car, and the last step in words; coloured where it is not normal."""
    rows = list(feed.rows)
    normal = rows and int(rows[-1].values["mode"]) == MODE_NORMAL and not feed.silence()
    color = _LEVEL_COLORS["ok" if normal else "warn"]
    words = " &nbsp;·&nbsp; ".join(map(html.escape, last_words(feed)))
    title = " · ".join(filter(None, [feed.node, feed.car]))
    return f'<b>{html.escape(title)}</b><div style="background:{color}; padding:2px">{words}</div>'


def statuses_html(feed: Feed) -> str:
    """The diagnostics as a table; a row has the colour of its level."""
    rows = "".join(
        f'<tr style="background:{_LEVEL_COLORS[level]}"><td>{level}<td>{html.escape(name)}<td>{html.escape(message)}'
        for name, (level, message) in sorted(feed.statuses.items())
    )
    return f'<table style="text-align:left; overflow-wrap:break-word"><tr><th>level<th>name<th>message{rows}</table>'


def _figure(chart: Chart, state: Any, x_range: Any) -> Any:
    """A chart whose legend stands above it, not upon the curves."""
    from bokeh.models import DataRange1d
    from bokeh.plotting import figure

    y_range = DataRange1d()
    drawn = figure(
        title=chart.title,
        x_axis_label="time (s)",
        height=240,
        sizing_mode="stretch_width",
        tools="pan,wheel_zoom,reset",
        toolbar_location="above",
        x_range=x_range,
        y_range=y_range,
    )
    drawn.toolbar.logo = None
    for label, signal, color, dash, width in chart.lines:
        drawn.line("time_s", signal, source=state, legend_label=label, color=color, line_dash=dash, line_width=width)
    if isinstance(x_range.renderers, str):  # the curves make the range, not what holds the other axis open
        x_range.renderers = list(drawn.renderers)
    drawn.line([0.0, 0.0], list(chart.least), line_alpha=0.0)
    legend = drawn.legend[0]
    legend.orientation, legend.label_text_font_size = "horizontal", "9pt"
    legend.margin, legend.spacing = 0, 12
    legend.border_line_alpha, legend.visible = 0.0, len(chart.lines) > 1
    drawn.add_layout(legend, "above")
    return drawn


def make_page(document: Any, feed: Feed) -> None:
    """Fill a browser's document, and keep it filled."""
    from bokeh.layouts import column, row
    from bokeh.models import DataRange1d
    from bokeh.models.sources import ColumnDataSource
    from bokeh.models.widgets import Div

    state = ColumnDataSource({name: [] for name in ("time_s", *_SIGNALS)}, name="state")
    words = Div(name="words", sizing_mode="stretch_width")
    table = Div(name="diagnostics", sizing_mode="stretch_width")
    x_range = DataRange1d()
    figures = {chart: _figure(chart, state, x_range) for chart in CHARTS}
    columns = {"display": "grid", "grid-template-columns": "repeat(auto-fit, minmax(340px, 1fr))"}
    charts = row(*figures.values(), sizing_mode="stretch_width", styles=columns)
    document.template = _TEMPLATE
    document.add_root(column(words, table, charts, sizing_mode="stretch_width"))
    seen = 0

    def refresh() -> None:
        nonlocal seen
        rows = feed.since(seen)
        if rows:
            seen = rows[-1].number
            found: dict[str, Any] = {
                name: [row.values.get(name, _NAN) for row in rows] for name in ("time_s", *_SIGNALS)
            }
            state.stream(found, rollover=POINTS)
        document.title = " · ".join(filter(None, [feed.node, feed.car]))
        words.text, table.text = heading_html(feed), statuses_html(feed)
        brakes = figures[BRAKES]
        brakes.title.text = "friction brakes: another system has them" if feed.foreign_brakes else BRAKES.title
        for shown in (*brakes.renderers, *brakes.legend):
            shown.visible = not feed.foreign_brakes

    refresh()
    document.add_periodic_callback(refresh, REFRESH_MS)


def listen(feed: Feed, arguments: Sequence[str]) -> tuple[Any, Any]:
    """Subscribe to state and diagnostics: the node, and an executor that is to be served in a thread."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import JointState

    from iwm_power_manager.ros import messages, qos
    from iwm_power_manager.ros.asking import others_there

    rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    node = Node("watch_car", enable_rosout=False, start_parameter_services=False)
    feed.topic = node.resolve_topic_name(POWER_MANAGER_STATE)
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
            values = {entry.key: entry.value for entry in status.values}
            feed.status(status.name, status.level[0], status.message, values)

    def looked() -> None:
        if not feed.rows:
            feed.others = others_there(node, feed.node)

    node.create_subscription(DiagnosticArray, DIAGNOSTICS, diagnosed, asked)
    node.create_timer(QUIET_S, looked)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    return node, executor


def serve(feed: Feed, port: int, *, open_browser: bool) -> None:
    """Serve pages until Ctrl-C or SIGTERM."""
    import signal

    from bokeh.application import Application
    from bokeh.application.handlers import FunctionHandler
    from bokeh.server.server import Server

    # A closed tab is no news.
    logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)
    logging.getLogger("tornado.application").addFilter(lambda record: "GET /ws" not in record.getMessage())
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
    lines = [" | ".join(last_words(feed))]
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
    parser.check(options, dict.fromkeys(("--port", "--no-browser"), (not options.terminal, "--terminal has no page")))
    if not options.terminal and importlib.util.find_spec("bokeh") is None:
        print(_NO_BOKEH, file=sys.stderr)
        return FAILED
    from iwm_power_manager.ros import ending
    from iwm_power_manager.ros.spinning import in_thread

    feed = Feed()
    node, executor = listen(feed, ["watch_car", *(options.node or []), *given[len(own) :]])
    code = FAILED
    try:
        with in_thread(executor, "topics"):
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
            node.destroy_node()
            node = executor = None
    return code


if __name__ == "__main__":
    sys.exit(main())
