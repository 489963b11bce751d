# SPDX-License-Identifier: Apache-2.0
"""What Foxglove and PlotJuggler demand: decodable schemas, stamps, and layouts that name what is recorded."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from bags_helpers import ScriptedDrive
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.share import share_path

SHOWN = {
    "speed_mps", "power_demand_w", "front_power_w", "rear_power_w", "front_share", "front_slip", "rear_slip", "gate",
    "limits", "front_left_motor_torque_nm", "rear_right_friction_torque_nm", "soc",
}  # fmt: skip


def test_every_channel_is_decoded_by_its_own_schema_as_foxglove_does_it(tmp_path: Path) -> None:
    path = ScriptedDrive("equal").write(tmp_path / "bag", 5)
    seen: dict[str, Any] = {}
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            assert schema.encoding == "ros2msg"
            assert re.fullmatch(r"\w+/msg/\w+", schema.name)
            assert channel.message_encoding == "cdr"
            assert message.log_time > 0
            assert message.publish_time > 0
            seen[channel.topic] = decoded
    assert seen["/power_manager/state"].name == SIGNAL_NAMES
    assert seen["/power_manager/state"].header.stamp.nanosec == 50_000_000
    assert seen["/battery_state"].temperature == 25.0


def test_the_foxglove_layout_points_at_the_signals_it_names() -> None:
    layout = json.loads(share_path("config/bags/foxglove_layout.json").read_text())
    shown = set()
    for panel in layout["configById"].values():
        for entry in panel.get("paths", []):
            match = re.fullmatch(r"/power_manager/state\.position\[(\d+)\]", entry["value"])
            assert match is not None
            assert SIGNAL_NAMES[int(match[1])] == entry["label"]
            assert entry["timestampMethod"] == "headerStamp"
            shown.add(entry["label"])
    assert shown >= SHOWN
    text = json.dumps(layout["layout"])
    assert all(panel in text for panel in layout["configById"])


def test_the_plotjuggler_layout_names_existing_signals() -> None:
    root = ElementTree.parse(share_path("config/bags/plotjuggler_layout.xml")).getroot()
    shown = set()
    for curve in root.iter("curve"):
        match = re.fullmatch(r"/power_manager/state/(\w+)/position", curve.attrib["name"])
        assert match is not None
        assert match[1] in SIGNAL_NAMES
        shown.add(match[1])
    assert shown >= SHOWN
