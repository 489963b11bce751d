# SPDX-License-Identifier: Apache-2.0
"""The page of a running car: what the topics said stands in it, in a real browser where there is one."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.tools import watch_car
from iwm_power_manager.tools.watch_car import CHARTS, EVERY, Feed, heading_html, in_words, statuses_html

ROOT = Path(__file__).resolve().parents[2]
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def values(**given: float) -> dict[str, float]:
    return dict.fromkeys(SIGNAL_NAMES, 0.0) | given


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--port", "99999"], "99999 is out of range; allowed: 0 to 65535"),
        (["--node", "car 1"], "car 1 is no full name of a node; allowed: such as /car_1/power_manager"),
    ],
)
def test_an_argument_that_cannot_be_is_one_line(arguments: list[str], words: str, capsys: Any) -> None:
    with pytest.raises(SystemExit) as ended:
        watch_car.main(arguments)
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (2, 1)
    assert words in error


def test_a_page_gets_each_drawn_step_once_and_in_order() -> None:
    feed = Feed()
    for i in range(10 * EVERY):
        feed.state(i * 10_000_000, values(speed_mps=float(i)))
    rows = feed.since(0)
    assert [row.number for row in rows] == list(range(1, 11))
    assert rows[1].values["time_s"] == pytest.approx(EVERY * 0.01)
    assert feed.since(8) == rows[8:]
    assert feed.since(10) == []


def test_mode_gate_limits_and_missing_inputs_stand_in_words() -> None:
    text = " ".join(
        in_words(values(mode=2.0, gate=1.0, limits=66.0, stale=9.0, speed_mps=3.0, power_demand_w=1500.0, soc=0.5))
    )
    for part in ("mode: degraded", "gate: front", "regeneration, slip", "vehicle_speed, battery_state", "1.50 kW"):
        assert part in text
    assert "speed not known (last 3.00 m/s)" in text
    assert "limits that bind: none" in in_words(values())


def test_a_faded_motor_is_not_put_down_to_the_battery() -> None:
    assert "limits that bind: motors faded out" in in_words(values(limits=4.0, motor_factor=0.0))
    assert "limits that bind: battery_discharge" in in_words(values(limits=4.0, motor_factor=1.0))


def test_where_the_sensor_is_not_believed_the_speed_is_the_believed_one() -> None:
    given = {"speed_mps": 36.0, "estimated_speed_mps": 10.0}
    assert "speed 36.00 m/s" in in_words(values(**given))
    assert "speed 10.00 m/s (sensor not believed: 36.00 m/s)" in in_words(values(**given, doubted=16.0))


def test_the_page_names_node_and_car_and_colours_what_is_not_well() -> None:
    feed = Feed()
    feed.topic = "/a/power_manager/state"
    feed.status("/a/power_manager: control", 2, "<b>bad", {"vehicle": "van", "friction brakes": "another system"})
    feed.status("/b/power_manager: control", 0, "well", {"vehicle": "other", "friction brakes": "commanded"})
    assert (feed.car, feed.foreign_brakes) == ("van", True)
    assert "<b>/a/power_manager · van</b>" in heading_html(feed)
    bad, well = statuses_html(feed).split("<tr")[2:]
    assert "#" in bad and "&lt;b&gt;bad" in bad
    assert "transparent" in well


def test_the_terminal_gets_the_last_step_and_what_is_not_ok() -> None:
    feed = Feed()
    assert watch_car.report(feed) == "waiting for /power_manager/state (0 s)"
    for _ in range(EVERY):
        feed.state(0, values(mode=1.0, speed_mps=2.0))
    feed.status("/a: control", 0, "normal")
    feed.status("/a: inputs", 2, "battery_state is missing")
    first, second = watch_car.report(feed).splitlines()
    assert first.startswith("mode: normal | gate: none")
    assert second.split(maxsplit=1) == ["error", "/a: inputs: battery_state is missing"]


def test_a_node_that_has_fallen_silent_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = Feed()
    for _ in range(EVERY):
        feed.state(0, values())
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 7.0)
    assert watch_car.report(feed).startswith("nothing new on /power_manager/state for 7 s | mode: waiting")


def test_every_line_of_the_charts_is_a_signal_of_the_state() -> None:
    assert {line.signal for chart in CHARTS for line in chart.lines} <= set(SIGNAL_NAMES)


def test_without_bokeh_each_way_to_it_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert watch_car.main([]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for way in ("make setup", "python3-bokeh-pip", "pip install bokeh", "--terminal"):
        assert way in said


def test_a_port_that_is_taken_is_one_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("bokeh")
    monkeypatch.setattr(watch_car, "listen", lambda *_: (_Nothing(), _Nothing()))
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert watch_car.main(["--no-browser", "--port", str(taken.getsockname()[1])]) == 1
    assert "watch_car: --port" in capsys.readouterr().err


class _Nothing:
    def __getattr__(self, _: str) -> Any:
        return lambda *_, **__: None


@pytest.mark.skipif(BROWSER is None, reason="there is no browser here")
def test_the_page_shows_a_running_car(tmp_path: Path) -> None:
    """A stand-in speaks the topics; the page is read through the browser's own debugger."""
    pytest.importorskip("bokeh")
    environment = {**os.environ, "ROS_LOG_DIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    name = f"/watch_{os.getpid()}"
    car = subprocess.Popen([sys.executable, "-c", _CAR, name], env=environment)
    command = [sys.executable, "-m", "iwm_power_manager.tools.watch_car", "--no-browser", "--port", "0"]
    page = subprocess.Popen(
        [*command, "--node", f"{name}/power_manager", "--ros-args", "-r", f"/diagnostics:={name}/diagnostics"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert page.stdout is not None and page.stderr is not None
        url = re.search(r"http://localhost:\d+/", page.stdout.readline())
        assert url is not None
        found = _read_page(url[0], tmp_path)
        assert found["speed"] == pytest.approx(12.5)
        assert "mode: normal" in found["words"]
        assert found["words"].startswith(f"<b>{name}/power_manager · a van</b>")
        assert f"<td>warn<td>{name}/power_manager: control<td>a word" in found["statuses"]
        assert found["title"] == f"{name}/power_manager · a van"
        assert "friction brakes: another system has them" in found["titles"]
        assert len(found["titles"]) == len(CHARTS)
        assert found["foreign"] == []
        page.send_signal(2)
        assert page.wait(30) == 0
        assert page.stderr.read() == ""  # also of the tab that was closed
    finally:
        for process in (page, car):
            process.kill()
            process.wait()


_CAR = """
import sys, time, rclpy
from rclpy.node import Node
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import JointState
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.ros import messages
rclpy.init()
node = Node("power_manager", namespace=sys.argv[1])
state = node.create_publisher(JointState, "~/state", 10)
diagnostics = node.create_publisher(DiagnosticArray, sys.argv[1] + "/diagnostics", 10)
values = dict.fromkeys(SIGNAL_NAMES, 0.0) | {"speed_mps": 12.5, "mode": 1.0}
car = [KeyValue(key="vehicle", value="a van"), KeyValue(key="friction brakes", value="another system")]
status = DiagnosticStatus(level=b"\\x01", name=node.get_fully_qualified_name() + ": control", message="a word")
status.values = car
other = DiagnosticStatus(level=b"\\x02", name="/another_car/power_manager: control", message="not of this car")
for i in range(10**9):
    state.publish(messages.joint_message(i * 10**7, list(values), position=list(values.values())))
    if i % 20 == 0:
        diagnostics.publish(DiagnosticArray(status=[other, status]))
    time.sleep(0.01)
"""

_ASK = """(() => {
  const document_ = window.Bokeh && Bokeh.documents[0]; if (!document_) return null;
  const state = document_.get_model_by_name("state"), words = document_.get_model_by_name("words");
  const table = document_.get_model_by_name("diagnostics");
  if (!state || !state.data.speed_mps.length || !table.text.includes("a word")) return null;
  const all = [...document_._all_models.values()];
  return JSON.stringify({speed: state.data.speed_mps[state.data.speed_mps.length - 1], words: words.text,
    statuses: table.text, title: document.title,
    titles: all.filter(model => model.type === "Figure").map(model => model.title.text),
    foreign: performance.getEntriesByType("resource").map(r => r.name).filter(n => !n.startsWith(location.origin)
      && !n.startsWith("data:") && !n.startsWith("blob:"))});
})()"""


def _read_page(url: str, folder: Path) -> dict[str, Any]:
    """What the page's own script knows, asked by way of the DevTools protocol."""
    assert BROWSER is not None
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
    browser = subprocess.Popen(
        [BROWSER, *options, "--remote-allow-origins=*", f"--user-data-dir={folder / 'browser'}", url],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port_file = folder / "browser" / "DevToolsActivePort"
        _until(lambda: port_file.exists() and port_file.read_text().count("\n") >= 1)
        port = int(port_file.read_text().splitlines()[0])
        answer = _until(lambda: _evaluate(port, url))
        return dict(json.loads(answer))
    finally:
        browser.kill()
        browser.wait()


def _until(condition: Any) -> Any:
    end = time.monotonic() + 90.0
    while not (found := condition()):
        assert time.monotonic() < end, "the page shows nothing"
        time.sleep(0.2)
    return found


def _evaluate(port: int, url: str) -> str | None:
    import asyncio
    import urllib.request

    from tornado.websocket import websocket_connect

    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
        pages = [page for page in json.load(answer) if page.get("url") == url]
    if not pages:
        return None

    async def ask() -> Any:
        socket = await websocket_connect(pages[0]["webSocketDebuggerUrl"])
        await socket.write_message(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": {"expression": _ASK}}))
        message = json.loads(await socket.read_message() or "{}")
        socket.close()
        return message["result"]["result"].get("value")

    return asyncio.run(ask())
