# SPDX-License-Identifier: Apache-2.0
"""Replay of other cars' and other recorders' bags: the right steps, or one line that says why not."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zstandard

import foreign_bags as foreign
from bags_helpers import joint_state_writer
from foreign_bags import CHANNELS, COUNT, DEMAND, JOINTS, LINE, SPEED, drive, write_bag, write_mcap, write_sqlite
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.errors import BagError, NoAnswerError
from iwm_power_manager.exit_codes import BAD_INPUT, CANNOT_TELL, DONE
from iwm_power_manager.replay.plan import Choice, make_plan
from iwm_power_manager.replay.recorded import read_drives, read_signal
from iwm_power_manager.replay.run import Replay
from iwm_power_manager.replay.what_if import what_if
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.tools.replay import main
from iwm_power_manager.vehicle import load_vehicle

FORKED = f"geometry_msgs/Twist twist\n{LINE}\nMSG: geometry_msgs/Twist\nfloat64 x\n"


@pytest.fixture
def mapping(tmp_path: Path) -> Path:
    path = tmp_path / "mapping.yaml"
    path.write_text(foreign.MAPPING)
    return path


def replayed(bag: Path, mapping: Path) -> tuple[Any, list[float]]:
    """Report of a replay with equal split, and the speeds the law took."""
    with BagReader(bag) as reader:
        replay = Replay(reader, make_plan(Choice(strategy="equal", mapping=str(mapping)), {}))
        speeds = [step.values[0] for _, steps in replay.steps() for step in steps]
        return replay.report(), speeds


def with_speed(**changes: str) -> list[foreign.Channel]:
    return [SPEED._replace(**changes), DEMAND, JOINTS]


@pytest.mark.parametrize(
    "channels",
    [
        with_speed(),
        with_speed(type="my_msgs/Speed"),
        with_speed(text=SPEED.text.replace("\n", "\r\n")),
        with_speed(text="\ufeff" + SPEED.text.replace(" ", "\t")),
        with_speed(text=SPEED.text.replace("\n", "\r\r\n")),
        with_speed(text="\n \n" + SPEED.text.replace("\n", " \n\n").replace("MSG: ", "MSG:   ") + "\f\0"),
        with_speed(text=foreign.IDL_TEXT, encoding="ros2idl"),
        with_speed(text=foreign.ROSIDL_TEXT, encoding="ros2idl"),
        with_speed(text=foreign.ROSIDL_TEXT.replace("\n", "\r\n"), encoding="ros2idl"),
        with_speed(text=foreign.IDL_TEXT, encoding="omgidl", type="my_msgs::msg::Speed"),
        with_speed(
            text=foreign.IDL_TEXT.replace("my_msgs { module msg", "my_msgs { module dds_"),
            encoding="omgidl",
            type="my_msgs::dds_::Speed",
        ),
        with_speed(text=SPEED.text.replace("float64 value", "float64\u00a0value"), type="my_msgs::msg::Speed"),
        with_speed(type="my_msgs::msg::dds_::Speed_"),
        with_speed(encoding="ROS2MSG"),
        with_speed(encoding=""),
    ],
    ids=[
        "as written",
        "two-part name",
        "CRLF",
        "BOM and tabs",
        "CRCRLF",
        "blanks",
        "IDL",
        "rosidl's",
        "rosidl's, CRLF",
        "name as in IDL",
        "module of its own",
        "hard blank",
        "name as in DDS",
        "capitals",
        "encoding not told",
    ],
)
def test_a_type_of_another_package_is_read_by_the_definition_in_the_bag(
    tmp_path: Path, mapping: Path, channels: list[foreign.Channel]
) -> None:
    report, speeds = replayed(write_bag(tmp_path / "bag", drive(), channels), mapping)
    assert (report.steps, report.bad_messages, report.damage) == (COUNT, 0, [])
    assert max(speeds) == pytest.approx(9.5, abs=0.01)


def test_a_topic_of_two_definitions_in_one_bag_is_read_by_each(tmp_path: Path, mapping: Path) -> None:
    head, rest = SPEED.text.split("float64 value\n")
    texts = [f"{head}float64 value\nfloat64 age\n{rest}", f"{head}float64 age\nfloat64 value\n{rest}"]
    age = struct.pack("<d", 0.5)
    halves = [
        [(t, n, data + age if n == 0 else data) for t, n, data in drive()[:150]],
        [(t, n, data[:-8] + age + data[-8:] if n == 0 else data) for t, n, data in drive()[150:]],
    ]
    folder = tmp_path / "bag"
    for i, (text, half) in enumerate(zip(texts, halves, strict=True)):
        write_mcap(folder / f"a_{i}.mcap", half, with_speed(text=text))
    foreign.write_metadata(folder, relative_file_paths=["a_0.mcap", "a_1.mcap"])
    report, speeds = replayed(folder, mapping)
    assert (report.steps, report.bad_messages) == (COUNT, 0)
    assert min(speeds) >= 8.0
    assert report.damage == []
    assert report.notes == ["/car/speed has more than one definition: each message is read by its own"]


def test_an_input_that_stays_away_is_said(tmp_path: Path, mapping: Path) -> None:
    entries = [entry for i, entry in enumerate(drive()) if entry[1] != 0 or i < 150]
    report, _ = replayed(write_bag(tmp_path / "bag", entries), mapping)
    assert report.steps == COUNT
    assert "vehicle_speed had not come for 0.5 s at 26 wheel speeds: taken as it was last" in report.notes


def test_an_estimate_says_what_a_replay_says_of_the_bag(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = [
        (t, n, data[:-8] + struct.pack("<d", 3.6 * 8.0) if n == 0 else data) for t, n, data in drive(stamp=lambda _: 0)
    ]
    bag = write_bag(tmp_path / "bag", entries)
    arguments = [str(bag), "--mapping", str(mapping), "--strategy", "equal", "--what-if", "jalalmaab_2015"]
    assert main(arguments) == DONE
    said = capsys.readouterr().out
    assert "do not advance: log times are used" in said
    assert "times what wheel_speed and a radius of 0.33 m give" in said


def test_a_drive_whose_clock_was_set_back_is_replayed_and_learned_from_as_it_was_driven(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hour_ns = 3600 * 10**9
    entries = drive(COUNT // 2, start_ns=foreign.START_NS)
    entries += drive(COUNT // 2, start_ns=foreign.START_NS + COUNT // 2 * foreign.PERIOD_NS - hour_ns)
    bag = write_bag(tmp_path / "bag", entries)
    report, speeds = replayed(bag, mapping)
    assert report.steps == COUNT - 1  # the first after the jump has no step before it
    assert speeds[:10] == pytest.approx([8.0 + 1.5 * math.sin(math.pi * i / (COUNT // 2)) for i in range(10)])
    found = read_signal(bag, load_mapping(mapping))
    assert found.time_s == pytest.approx([0.02 * i for i in range(COUNT)], abs=1e-4)
    assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal"]) == DONE
    said = capsys.readouterr().out
    assert "the clock was set back meanwhile: it is read in the order of recording" in said
    assert "damaged" not in said


def test_a_step_whose_stamp_comes_again_has_its_own_force(tmp_path: Path, mapping: Path) -> None:
    """A simulator that is started over stamps its second drive as its first: both add up to both alone."""
    gentle = [(t, n, data[:4] + struct.pack("<d", 500.0) if n == 1 else data) for t, n, data in drive()]
    plan = make_plan(Choice(strategy="equal", mapping=str(mapping)), {})

    def consumed_wh(name: str, entries: list[foreign.Entry]) -> float:
        with BagReader(write_bag(tmp_path / name, entries)) as reader:
            (row,), _ = what_if(reader, [("equal", plan)])
            return row.chemical_wh

    alone = consumed_wh("first", drive()) + consumed_wh("second", gentle)
    assert consumed_wh("both", drive() + gentle) == pytest.approx(alone, rel=0.05)


def test_demands_whose_stamps_go_back_are_not_left_out_in_silence(tmp_path: Path, mapping: Path) -> None:
    half_ns = COUNT // 2 * foreign.PERIOD_NS
    late = foreign.START_NS + half_ns
    entries = drive(stamp=lambda log_ns: log_ns - half_ns * (log_ns >= late))
    found = read_signal(write_bag(tmp_path / "bag", entries), load_mapping(mapping))
    assert any("demands are left out: their stamps are behind those before them" in line for line in found.damage)


@pytest.mark.parametrize("starts", [1, 2])
def test_what_follows_a_simulator_that_was_started_again_is_learned_from(
    tmp_path: Path, mapping: Path, starts: int
) -> None:
    lasts_ns = COUNT * foreign.PERIOD_NS
    entries = drive((starts + 1) * COUNT, stamp=lambda log_ns: 10**9 + (log_ns - foreign.START_NS) % lasts_ns)
    found = read_signal(write_bag(tmp_path / "bag", entries), load_mapping(mapping))
    assert found.time_s == pytest.approx([0.02 * i for i in range((starts + 1) * COUNT)])
    assert found.damage == [
        f"the stamps start again {starts} time(s), as of a simulator that was restarted: the time goes on there"
    ]


def test_stamps_of_two_clocks_are_not_taken_for_restarts(tmp_path: Path, mapping: Path) -> None:
    entries = drive(stamp=lambda log_ns: log_ns - 5 * 10**9 * (log_ns // foreign.PERIOD_NS % 5 == 3))
    found = read_signal(write_bag(tmp_path / "bag", entries), load_mapping(mapping))
    assert found.time_s[-1] == pytest.approx((COUNT - 1) * 0.02)
    assert found.damage == [f"20 of {COUNT} demands are left out: their stamps are behind those before them"]


@pytest.mark.parametrize("stands", [(0.3, 0.55), (0.5, 1.0)], ids=["in between", "to the end"])
def test_a_drive_whose_stamps_stand_for_a_while_is_learned_from_at_log_times(
    tmp_path: Path, mapping: Path, stands: tuple[float, float]
) -> None:
    first, behind = (foreign.START_NS + int(share * 300) * foreign.PERIOD_NS for share in stands)
    entries = drive(300, stamp=lambda log_ns: first if first < log_ns < behind else log_ns)
    found = read_signal(write_bag(tmp_path / "bag", entries), load_mapping(mapping))
    assert found.time_s == pytest.approx([0.02 * i for i in range(300)])
    (line,) = found.damage
    assert line.endswith("s: log times are used")
    assert "the stamps of the speed stand still for" in line


def test_where_simulated_time_stood_while_nothing_changed_stamps_count(tmp_path: Path, mapping: Path) -> None:
    """A lock-step drive that waited: the same set was sent again and again."""
    entries = drive()
    (_, _, speed), (_, _, demand), (_, _, wheels) = entries[:3]
    waited = [
        (foreign.START_NS - i * foreign.PERIOD_NS, number, data)
        for i in range(100, 0, -1)
        for number, data in enumerate((speed, demand, wheels))
    ]
    found = read_signal(write_bag(tmp_path / "bag", waited + entries), load_mapping(mapping))
    assert found.time_s == pytest.approx([0.02 * i for i in range(COUNT)])
    assert found.damage == []


def test_demands_of_one_time_are_not_left_out_in_silence(tmp_path: Path, mapping: Path) -> None:
    entries = [(foreign.START_NS, n, data) for _, n, data in drive(stamp=lambda _: 0)]
    found = read_signal(write_bag(tmp_path / "bag", entries), load_mapping(mapping))
    assert f"only 1 of {COUNT} demands have a time of their own: the others are left out" in found.damage


def test_a_speed_against_the_wheels_is_said(tmp_path: Path, mapping: Path) -> None:
    entries = [(t, n, data[:-8] + struct.pack("<d", -8.0) if n == 0 else data) for t, n, data in drive()]
    report, _ = replayed(write_bag(tmp_path / "bag", entries), mapping)
    assert (
        "speed and wheel_speed are of opposite signs in most steps: is the sign of one of them wrong?" in report.notes
    )


@pytest.mark.parametrize(
    ("times", "line"),
    [
        (1e-3, "energy that power_demand asks for: is it in kW?"),
        (-1.0, "the car slows down where power_demand drives, and speeds up where it brakes: is its sign wrong?"),
        (0.1, "energy that power_demand asks for: another unit, or another car?"),
        (1.0, ""),
        (0.5, ""),
        (0.0, "power_demand does not change, and yet the car speeds up: is it another signal?"),
    ],
)
def test_a_demand_that_cannot_have_moved_the_car_is_said(
    tmp_path: Path, mapping: Path, times: float, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The car of 850 kg is pushed and braked by turns of four seconds, and asks for that and its road load."""
    entries: list[foreign.Entry] = []
    speed = 8.0
    for i in range(1000):
        acceleration = 1.0 if i // 200 % 2 == 0 else -1.0
        log_ns = foreign.START_NS + i * foreign.PERIOD_NS
        watts = times * (850.0 * acceleration + 90.0 + 0.4 * speed**2) * speed
        entries += [
            (log_ns, 0, foreign.speed(log_ns, speed)),
            (log_ns + 1, 1, b"\0\1\0\0" + struct.pack("<d", watts)),
            (log_ns + 2, 2, foreign.joints(log_ns, [speed / 0.33] * 4)),
        ]
        speed += acceleration * foreign.PERIOD_NS * 1e-9
    bag = write_bag(tmp_path / "bag", entries)
    report, _ = replayed(bag, mapping)
    assert report.notes == [] if not line else report.notes[0].endswith(line)
    assert len(report.notes) == bool(line)
    read_drives([str(bag)], str(mapping), load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")), "learn")
    said = capsys.readouterr().err
    assert said == "" if not line else said.startswith("learn: warning: ") and said.endswith(f"{line}\n")


def test_why_wheel_speeds_are_not_believed_is_said(tmp_path: Path, mapping: Path) -> None:
    mapping.write_text(foreign.MAPPING.replace(", names: [fl, fr, rl, rr]", ""))
    three = joint_state_writer(("fl", "fr", "rl"), "velocity")
    short = [(t, n, three(t, [24.0] * 3) if n == 2 else data) for t, n, data in drive()]
    with BagReader(write_bag(tmp_path / "bag", short)) as reader:
        replay = Replay(reader, make_plan(Choice(strategy="equal", mapping=str(mapping)), {}))
        assert not [step for _, steps in replay.steps() for step in steps]
        assert "wheel_states not believed: 100 length (the last: length: 3 values for 4 wheels)" in replay.why_no_step()


def test_a_definition_in_another_language_is_said(tmp_path: Path, mapping: Path) -> None:
    bag = write_bag(tmp_path / "bag", drive(), with_speed(encoding="ros1msg"))
    with pytest.raises(BagError, match=r"its definition is written in 'ros1msg'; allowed: ros2msg, ros2idl"):
        replayed(bag, mapping)


def test_a_fork_of_a_standard_type_is_read_as_the_bag_has_it(tmp_path: Path, mapping: Path) -> None:
    mapping.write_text(foreign.MAPPING.replace("field: value", "field: twist.x"))
    channels = with_speed(type="geometry_msgs/msg/TwistStamped", text=FORKED)
    entries = [(t, n, data[:4] + data[-8:] if n == 0 else data) for t, n, data in drive()]
    report, speeds = replayed(write_bag(tmp_path / "bag", entries, channels), mapping)
    assert (report.steps, report.bad_messages) == (COUNT, 0)
    assert max(speeds) == pytest.approx(9.5, abs=0.01)


def test_a_type_that_changed_between_two_drives_is_read_as_each_bag_has_it(tmp_path: Path, mapping: Path) -> None:
    new = SPEED.text.replace("float64 value\n", "int32 quality\nfloat64 value\n")
    entries = [(t, n, data[:-8] + bytes(8) + data[-8:] if n == 0 else data) for t, n, data in drive()]
    write_bag(tmp_path / "old", drive())
    write_bag(tmp_path / "new", entries, with_speed(text=new))
    drives = [read_signal(tmp_path / name, load_mapping(mapping)) for name in ("old", "new", "old")]
    assert all(found.speed_mps.max() == pytest.approx(9.5, abs=0.01) for found in drives)


@pytest.mark.parametrize(
    ("stamp", "said"),
    [
        (lambda log_ns: (2**31 - 1) * 10**9 if log_ns == foreign.START_NS + 10 * foreign.PERIOD_NS else log_ns, 1),
        (lambda log_ns: (log_ns - foreign.START_NS) // 10**9, 1),
        (lambda log_ns: log_ns, 0),
    ],
    ids=["one far off", "seconds for nanoseconds", "as it should be"],
)
def test_a_drive_is_learned_from_at_log_times_where_its_stamps_do_not_advance(
    tmp_path: Path, mapping: Path, stamp: Callable[[int], int], said: int
) -> None:
    found = read_signal(write_bag(tmp_path / "bag", drive(stamp=stamp)), load_mapping(mapping))
    assert found.time_s[-1] == pytest.approx((COUNT - 1) * foreign.PERIOD_NS * 1e-9, abs=1e-4)
    assert len(found.time_s) == COUNT
    assert [line for line in found.damage if "do not advance: log times are used" in line] == found.damage
    assert len(found.damage) == said


def test_what_no_car_has_is_not_learned_from(tmp_path: Path, mapping: Path) -> None:
    wrong = {0: struct.pack("<d", 900.0), 1: struct.pack("<d", 1e12)}
    entries = [(t, n, data[:-8] + wrong[n] if n < 2 and i % 30 < 2 else data) for i, (t, n, data) in enumerate(drive())]
    found = read_signal(write_bag(tmp_path / "bag", entries), load_mapping(mapping))
    assert found.bad_messages == 2 * len(range(0, COUNT, 10))
    assert found.power_demand_w.tolist() == [3000.0] * (COUNT - COUNT // 10)
    assert found.speed_mps.max() < 9.6


def test_a_missing_nested_definition_is_one_line_with_topic_and_type(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / "bag", drive(), with_speed(text="other_msgs/Thing thing\nfloat64 value\n"))
    assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal"]) == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "/car/speed: type my_msgs/msg/Speed: its definition names other_msgs/msg/Thing" in line
    with BagReader(bag) as reader:  # the others are read
        assert sum(message.topic != "/car/speed" for message in reader.messages()) == 2 * COUNT


@pytest.mark.parametrize(
    "stamp",
    [
        lambda _: 0,
        lambda _: 1_234_567_890,
        lambda log_ns: log_ns // 10**6,
        lambda log_ns: 2 * foreign.START_NS - log_ns,
        lambda log_ns: log_ns * (log_ns >= foreign.START_NS + 10**9),
        lambda log_ns: (log_ns - foreign.START_NS) * (log_ns >= foreign.START_NS + 10**9),
        lambda log_ns: log_ns - foreign.START_NS * (log_ns < foreign.START_NS + 10**9),
    ],
    ids=["zero", "standing", "milliseconds", "backwards", "zero at first", "zero at first of 0 s", "set in between"],
)
def test_stamps_that_do_not_advance_are_said_once_and_log_times_are_used(
    tmp_path: Path, mapping: Path, stamp: Callable[[int], int], capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / "bag", drive(stamp=stamp))
    arguments = [str(bag), "--mapping", str(mapping), "--strategy", "equal"]
    assert main(arguments) == DONE
    out = capsys.readouterr().out
    assert f"{COUNT} steps over {(COUNT - 1) * 0.02:.2f} s" in out
    assert out.count("the header stamps of /car/speed, /joint_states do not advance: log times are used") == 1
    assert main([*arguments, "--what-if", "jalalmaab_2015"]) == DONE
    assert "nan" not in capsys.readouterr().out


def test_a_wheel_without_a_number_is_lost_as_in_the_node_and_the_replay_drives_on(
    tmp_path: Path, mapping: Path
) -> None:
    bag = write_bag(tmp_path / "bag", drive(velocity=lambda _, w: (w, foreign.NAN, w, w)))
    report, _ = replayed(bag, mapping)
    assert (report.steps, report.bad_messages) == (COUNT, 0)
    assert report.notes == [f"/joint_states: front_right has no number in {COUNT} messages: lost, as in the node"]


@pytest.mark.parametrize(
    ("value", "why"), [(1e300, "out_of_range"), (-90.0, "opposite")], ids=["beyond any wheel", "backwards"]
)
def test_a_wheel_that_is_not_believed_is_said_with_how_often(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str], value: float, why: str
) -> None:
    bag = write_bag(tmp_path / "bag", drive(velocity=lambda _, w: (w, w, value, w)))
    assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal"]) == DONE
    out = capsys.readouterr().out
    assert f"  wheel rear_left: not believed: {COUNT} {why}\n" in out
    assert "Wh" not in out
    report, _ = replayed(bag, mapping)
    assert report.dropped == {"wheel rear_left": {why: COUNT}}
    out_path = tmp_path / "out"
    assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal", "--output", str(out_path)]) == DONE
    report, _ = replayed(out_path, mapping)  # repeated from the state it wrote
    assert (report.exact, report.dropped) == (True, {"wheel rear_left": {"steps": COUNT}})


@pytest.mark.parametrize(
    ("speed", "wheels", "hint"),
    [
        (3.6, 1.0, "speed is 3.6 times what wheel_speed and a radius of 0.33 m give: speed in km/h?"),
        (2.237, 1.0, "speed is 2.24 times what wheel_speed and a radius of 0.33 m give: speed in mph?"),
        (
            1.0 / 3.6,
            1.0,
            "speed is 0.278 times what wheel_speed and a radius of 0.33 m give: speed in m/s, read as km/h?",
        ),
        (1.0, 0.33, "speed is 3.03 times what wheel_speed and a radius of 0.33 m give: wheel_speed in m/s?"),
        (0.0, 1.0, "speed is 0 times"),
        (1.0, 0.0, "speed is inf times"),
        (1.0, 0.6, "another unit, or another wheel radius?"),
        (1.0, 1.1, ""),
    ],
)
def test_speed_and_wheels_that_are_not_in_the_units_they_are_read_in_are_said(
    tmp_path: Path, mapping: Path, speed: float, wheels: float, hint: str
) -> None:
    entries = drive(velocity=lambda _, w: (w * wheels,) * 4)
    found = [
        (t, n, data[:-8] + struct.pack("<d", speed * struct.unpack("<d", data[-8:])[0]))
        for t, n, data in entries
        if n == 0
    ]
    report, _ = replayed(write_bag(tmp_path / "bag", sorted([*found, *(e for e in entries if e[1])])), mapping)
    assert len(report.notes) == bool(hint)
    assert all(hint in note for note in report.notes)


@pytest.mark.parametrize("silent", [True, False])
def test_a_wheel_of_its_own_topic_that_says_nothing_is_named_with_that_topic(
    tmp_path: Path, mapping: Path, silent: bool
) -> None:
    wheels = [DEMAND._replace(topic=f"/w{i}") for i in range(4)]
    entries = [entry for entry in drive() if entry[1] != 2]
    for t, _, data in [entry for entry in drive() if entry[1] == 2]:
        speeds = struct.unpack("<4d", data[-36:-4])
        entries += [
            (t + i, 2 + i, b"\0\1\0\0" + struct.pack("<d", foreign.NAN if i == 2 else speeds[i]))
            for i in range(4)
            if not (silent and i == 2)
        ]
    topics = "".join(f"    - {{topic: /w{i}, field: data, unit: rad/s}}\n" for i in range(4))
    lines = foreign.MAPPING.splitlines(keepends=True)
    mapping.write_text("".join(f"  wheel_speed:\n{topics}" if "wheel_speed" in line else line for line in lines))
    report, _ = replayed(write_bag(tmp_path / "bag", sorted(entries), [SPEED, DEMAND, *wheels]), mapping)
    (note,) = report.notes
    assert note.startswith("/w2: rear_left has no number in ")


def test_compressed_messages_are_read_without_any_metadata(tmp_path: Path, mapping: Path) -> None:
    entries = [(t, n, zstandard.compress(data)) for t, n, data in drive()]
    path = write_mcap(tmp_path / "a_0.mcap", entries)
    report, speeds = replayed(path, mapping)
    assert (report.steps, report.bad_messages) == (COUNT, 0)
    assert max(speeds) == pytest.approx(9.5, abs=0.01)


def test_a_sqlite_bag_of_before_foxy_is_read(tmp_path: Path, mapping: Path) -> None:
    mapping.write_text(foreign.MAPPING.replace("field: value", "field: twist.linear.x"))
    channels = with_speed(type="geometry_msgs/msg/TwistStamped")
    entries = [(t, n, data + bytes(40) if n == 0 else data) for t, n, data in drive()]
    report, speeds = replayed(write_sqlite(tmp_path / "bag", entries, channels), mapping)
    assert (report.steps, report.bad_messages, report.damage) == (COUNT, 0, [])
    assert max(speeds) == pytest.approx(9.5, abs=0.01)


def test_a_bag_that_gives_no_step_says_why_topic_by_topic(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = [(t, n, data[:7] if n == 2 else data) for t, n, data in drive()]
    bag = write_bag(tmp_path / "bag", entries)
    for more in ([], ["--what-if", "jalalmaab_2015"]):
        assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal", *more]) == BAD_INPUT
        (line,) = capsys.readouterr().err.splitlines()
        assert "gave no control step: " in line
        assert f"/joint_states: {COUNT} messages, {COUNT} of them bad (is no sensor_msgs/msg/JointState: " in line
        assert f"/demand: {COUNT} messages" in line


def test_a_bag_that_gives_no_step_because_it_cannot_be_read_says_that(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "bag"
    packed = foreign.chunk(foreign.message_records(drive(3)), "bz2")
    foreign.write_metadata(foreign.write_records(bag / "a_0.mcap", foreign.announced(), packed).parent)
    assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal"]) == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "gave no control step: " in line
    assert "is compressed with 'bz2'; known: zstd, lz4" in line


def test_messages_that_are_no_cdr_are_not_read_as_such(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / "bag", drive(), with_speed(serialization="json"))
    assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal"]) == BAD_INPUT
    assert "/car/speed: its messages are 'json', not CDR" in capsys.readouterr().err


def test_stamps_that_stand_still_from_some_time_on_are_said(tmp_path: Path, mapping: Path) -> None:
    last = foreign.START_NS + COUNT // 2 * foreign.PERIOD_NS
    report, _ = replayed(write_bag(tmp_path / "bag", drive(stamp=lambda log_ns: min(log_ns, last))), mapping)
    (note,) = report.notes
    assert note.startswith(f"only {COUNT // 2 + 1} steps of {COUNT} wheel speeds")
    assert f"{COUNT // 2 - 1} wheel speeds with the stamp of the one before" in note


def test_where_a_clock_was_set_back_by_less_than_a_second_lost_steps_are_said(tmp_path: Path, mapping: Path) -> None:
    entries = drive(stamp=lambda ns: ns) + drive(5, start_ns=foreign.START_NS + (COUNT - 5) * foreign.PERIOD_NS)
    report, _ = replayed(write_bag(tmp_path / "bag", entries), mapping)
    assert "5 wheel speeds have the stamp of the one before, and no step of their own" in report.notes


def test_far_fewer_steps_than_messages_are_said(tmp_path: Path, mapping: Path) -> None:
    entries = [entry for i, entry in enumerate(drive()) if entry[1] != 2 or i < 15]
    report, _ = replayed(write_bag(tmp_path / "bag", entries), mapping)
    assert report.steps == 5
    assert any(note.startswith(f"only 5 steps of {COUNT} messages") for note in report.notes)


def test_why_nothing_moves_is_said(tmp_path: Path, mapping: Path) -> None:
    backwards = drive(velocity=lambda i, w: (w if i < 3 else -w,) * 4)
    plan = make_plan(Choice(strategy="equal", mapping=str(mapping)), {})
    with BagReader(write_bag(tmp_path / "bag", backwards)) as reader, pytest.raises(NoAnswerError) as caught:
        what_if(reader, [("equal", plan)])
    assert "does not move" in str(caught.value)
    assert "wheel front_left not believed: 97 opposite" in str(caught.value)


def test_a_car_that_stands_gives_no_zero_for_an_answer(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = drive(velocity=lambda _, w: (0.0 * w,) * 4)
    entries = [(t, n, foreign.speed(t, 0.0) if n == 0 else data) for t, n, data in entries]
    bag = write_bag(tmp_path / "bag", [(t, n, b"\0\1\0\0" + bytes(8) if n == 1 else data) for t, n, data in entries])
    arguments = [str(bag), "--mapping", str(mapping), "--what-if", "jalalmaab_2015", "--strategy", "equal"]
    assert main(arguments) == CANNOT_TELL
    assert "the car does not move" in capsys.readouterr().err


def test_the_schema_of_a_copied_topic_stays_what_it_was(tmp_path: Path, mapping: Path) -> None:
    channels = [*with_speed(text=foreign.IDL_TEXT, encoding="ros2idl"), foreign.log_channel()[0]]
    entries = [*drive(), (foreign.START_NS + 10**12, 3, foreign.log_channel()[1])]
    bag = write_bag(tmp_path / "bag", entries, channels)
    out = tmp_path / "out"
    assert main([str(bag), "--mapping", str(mapping), "--strategy", "equal", "--output", str(out)]) == DONE
    with BagReader(out) as reader:
        for channel in (channels[0], channels[3]):
            topic = reader.topics[channel.topic]
            assert (topic.encoding, topic.definition, topic.serialization) == (
                channel.encoding,
                channel.text,
                channel.serialization,
            )


@pytest.mark.parametrize(
    "parameters",
    [
        '{"vehicle_file": "/dev/zero"}',
        '{"vehicle_file": "/etc/passwd"}',
        '{"vehicle_file": "../../etc/passwd"}',
        '{"vehicle_file": "~nobody-at-all/x"}',
        '{"vehicle_file": {"a": 1}}',
        '{"idle_drive": "/dev/zero"}',
        '{"critical_slip": "a lot"}',
        '{"strategy": ["equal"]}',
        '{"rate_hz": ' + "9" * 400 + ', "vehicle_file": "/dev/zero"}',
    ],
)
def test_parameters_in_a_bag_name_no_file_and_bring_nothing_down(
    tmp_path: Path, mapping: Path, parameters: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bag(tmp_path / "bag", drive(5))
    foreign.write_metadata(tmp_path / "bag", CHANNELS, custom_data={"parameters /power_manager": parameters})
    assert main([str(tmp_path / "bag"), "--mapping", str(mapping)]) == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("replay: error: ")


@pytest.mark.parametrize(
    "parameters", ["[" * 100_000, '{"rate_hz": 0, "friction": "x", "rule": 3, "wheel_names": [1]}', "x"]
)
def test_parameters_in_a_bag_that_make_no_sense_leave_the_defaults(parameters: str) -> None:
    recorded = {"parameters /power_manager": parameters}
    plan, default = (make_plan(Choice(strategy="equal"), custom) for custom in (recorded, {}))
    assert plan.vehicle.hash == default.vehicle.hash
    assert plan[2:] == default[2:]
