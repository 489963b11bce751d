# SPDX-License-Identifier: Apache-2.0
"""Parameters: what is refused, with which words, and what documentation says about them."""

from __future__ import annotations

import math

import pytest
import rclpy
import yaml
from member import anchored
from rclpy.parameter import Parameter

from iwm_power_manager.control.thresholds import input_limits
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.ros.arguments import check_arguments, check_parameter_files
from iwm_power_manager.ros.parameters import Change, Spec, check_change, descriptor
from iwm_power_manager.ros.specs import ParameterError
from parameter_pages import markdown_table, yaml_text

SPECS = {
    spec.name: spec
    for spec in (
        Spec("flag", True, "A flag."),
        Spec("count", 3, "A count.", 1, 9, change=Change.ALWAYS),
        Spec("gain", 0.5, "A gain, 1.", 0.0, 1.0, change=Change.ALWAYS),
        Spec("file", "", "A file."),
        Spec("mode", "a", "A mode.", choices=("a", "b"), change=Change.ALWAYS),
        Spec("names", ["x", "y"], "Names.", length=2),
        Spec("topics", ["x"], "Topics.", change=Change.ALWAYS),
        Spec("numbers", [1.0, 2.0], "Numbers.", 0.0, 5.0, length=2, change=Change.ALWAYS),
        Spec("group.big", 1e6, "A large number.", 0.0, 1e9, change=Change.NEVER),
    )
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("flag", False),
        ("count", 1),
        ("count", 9),
        ("gain", 0.0),
        ("gain", 1.0),
        ("file", "any/path"),
        ("mode", "b"),
        ("names", ["left", "right"]),
        ("topics", []),
        ("topics", ["x", "x", ""]),
        ("numbers", [0.0, 5.0]),
    ],
)
def test_what_is_allowed_is_no_problem(name, value) -> None:
    assert SPECS[name].problem(value) == ""


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("count", 0, "1 to 9"),
        ("count", 10, "1 to 9"),
        ("gain", -1e-9, "0 to 1"),
        ("gain", math.nan, "0 to 1"),
        ("gain", math.inf, "0 to 1"),
        ("mode", "c", "a | b"),
        ("mode", "", "a | b"),
        ("names", ["left"], "2 different names"),
        ("names", ["left", "left"], "2 different names"),
        ("names", ["left", ""], "2 different names"),
        ("numbers", [1.0], "2 numbers from 0 to 5"),
        ("numbers", [1.0, 6.0], "2 numbers from 0 to 5"),
        ("numbers", [math.nan, 1.0], "2 numbers from 0 to 5"),
    ],
)
def test_what_is_not_allowed_is_named_with_what_would_be(name, value, allowed) -> None:
    assert SPECS[name].problem(value) == f"{name}: {value!r} is not allowed; allowed: {allowed}"


@pytest.mark.parametrize(
    ("name", "value", "configured", "reason"),
    [
        ("gain", 0.7, True, ""),
        ("gain", 0.7, False, ""),
        ("gain", 2.0, False, "gain: 2.0 is not allowed; allowed: 0 to 1"),
        ("file", "x", False, ""),
        ("file", "x", True, "file changes only while unconfigured"),
        ("use_sim_time", True, True, ""),
        ("mode", "b", False, "not together"),
    ],
)
def test_a_change_is_judged_by_value_by_state_and_together_with_others(name, value, configured, reason) -> None:
    result = check_change(
        SPECS,
        [Parameter(name, value=value)],
        configured,
        lambda new: "not together" if new.get("mode") == "b" else "",
    )
    assert result.successful == (reason == "")
    assert result.reason == reason


def test_descriptors_carry_range_choices_and_when_it_may_change() -> None:
    gain = descriptor(SPECS["gain"])
    assert (gain.floating_point_range[0].from_value, gain.floating_point_range[0].to_value) == (0.0, 1.0)
    assert gain.description == "A gain, 1. Changes at any time."
    count = descriptor(SPECS["count"])
    assert (count.integer_range[0].from_value, count.integer_range[0].to_value) == (1, 9)
    assert descriptor(SPECS["mode"]).additional_constraints == "a | b"
    assert descriptor(SPECS["group.big"]).read_only
    assert not descriptor(SPECS["flag"]).read_only
    assert not descriptor(SPECS["flag"]).integer_range


def test_a_written_parameter_file_reads_back_as_the_defaults() -> None:
    text = yaml_text(SPECS.values(), "All parameters.")
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    big = values.pop("group")["big"]
    assert big == 1e6
    assert isinstance(big, float)
    assert values == {name: spec.default for name, spec in SPECS.items() if name != "group.big"}
    assert text.startswith("# All parameters.\n/**:\n")


def test_the_table_has_a_row_for_each_parameter() -> None:
    rows = markdown_table(SPECS.values()).splitlines()
    assert len(rows) == 2 + len(SPECS)
    assert rows[6] == "| `mode` | `a` | a \\| b | at any time | A mode. |"


VALUES = {spec.name: spec.default for spec in config.SPECS}


class TestPowerManager:
    def test_every_default_is_allowed(self) -> None:
        assert [spec.name for spec in config.SPECS if spec.problem(spec.default)] == []
        assert config.check_together(VALUES) == ""
        assert len(config.BY_NAME) == len(config.SPECS)

    @pytest.mark.parametrize(
        ("name", "value", "problem"),
        [
            ("slip_target", 0.21, "slip_target: 0.21 is not allowed; allowed: at most critical_slip = 0.2"),
            ("gate_hysteresis", 0.25, "gate_hysteresis: 0.25 is not allowed; allowed: at most critical_slip = 0.2"),
            (
                "execution_warn_us",
                3000.0,
                "execution_warn_us: 3000 is not allowed; allowed: at most execution_error_us",
            ),
            ("periodicity_warn_hz", 11.0, "periodicity_warn_hz: 11 is not allowed; allowed: at most periodicity_error"),
        ],
    )
    def test_values_that_contradict_each_other_are_refused(self, name, value, problem) -> None:
        assert config.check_together(VALUES | {name: value}).startswith(problem)
        assert config.check_together(VALUES | {name: 0.05}) == ""

    def test_an_input_is_missing_after_three_periods(self) -> None:
        assert config.age_limits_s(VALUES) == pytest.approx((0.03, 0.03, 0.03, 0.3))
        assert config.age_limits_s(VALUES | {"missed_periods": 1}) == (0.01, 0.01, 0.01, 0.1)

    def test_the_laws_settings_are_the_defaults_of_the_law(self) -> None:
        from iwm_power_manager.control.settings import default_settings

        assert config.law_settings(VALUES, "sdp") == default_settings("sdp")

    def test_in_lockstep_stamps_are_not_judged_by_the_clock(self) -> None:
        thresholds = config.thresholds_of(VALUES)
        assert input_limits(thresholds, 0.33, by_clock=True).stamp == (0.1, 0.02)
        limits = input_limits(thresholds, 0.33, by_clock=False)
        assert limits.stamp is None
        assert math.isinf(limits.demand_delay_s)


@pytest.mark.parametrize(
    "key",
    [
        "/**",
        "/*",
        "/*/*",
        "pm",
        "/car_1/pm",
        "car_1/pm",
        "/*/pm",
        "/**/pm",
        "/**/p",
        "/car_1/**",
        "/car_1",
        "/pm",
        "other",
    ],
)
def test_a_parameter_file_is_refused_exactly_where_ros_passes_over_it(tmp_path, key: str) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(f"{key}:\n  ros__parameters:\n    seen: 1\n")
    arguments = ["--ros-args", "--params-file", str(path)]
    context, _ = anchored()
    node = rclpy.create_node(
        "pm",
        context=context,
        namespace="/car_1",
        cli_args=arguments,
        automatically_declare_parameters_from_overrides=True,
        start_parameter_services=False,
        enable_rosout=False,
    )
    seen = node.has_parameter("seen")
    node.destroy_node()
    if seen:
        check_parameter_files(arguments, "/car_1/pm")
    else:
        with pytest.raises(ConfigError, match="is not this node, which is /car_1/pm"):
            check_parameter_files(arguments, "/car_1/pm")


def test_parameter_files_on_the_command_line_are_read_before_ros_does(tmp_path) -> None:
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    good.write_text("a: 1\n")
    bad.write_text("a: [\n")
    check_parameter_files(["node", "--ros-args", "--params-file", str(good), "-p", "x:=1"])
    check_parameter_files(["node"])
    with pytest.raises(ConfigError, match=r"bad\.yaml: line"):
        check_parameter_files(["--ros-args", "--params-file", str(good), "--params-file", str(bad)])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["-p", "vehicle_file=van.yaml"], "-p 'vehicle_file=van.yaml' is not allowed; allowed: PARAMETER:=VALUE"),
        (["-r", "/a:/b"], "-r '/a:/b' is not allowed; allowed: FROM:=TO"),
        (
            ["-p", "x:=1", "--param", "policy_file:="],
            "PARAMETER:=VALUE; an empty text is \"policy_file:=''\": the shell takes quotes away",
        ),
    ],
)
def test_a_setting_that_ros_cannot_read_is_answered_with_how_it_is_written(given, words) -> None:
    with pytest.raises(ParameterError) as caught:
        check_arguments("node", "", [], ["node", "--ros-args", *given], examples="")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("given", "right"),
    [
        (["-p", "mode:=b"], "-p mode:=b"),
        (["mode:=b", "--ros-args", "-r", "a:=b"], "-p mode:=b -r a:=b"),
        (["__ns:=/car_1"], "-r __ns:=/car_1"),
        (["--params-file", "my car.yaml"], "--params-file 'my car.yaml'"),
    ],
)
def test_what_is_for_ros_without_its_mark_is_answered_with_how_it_is_written(given, right, capsys) -> None:
    with pytest.raises(SystemExit):
        check_arguments("node", "", list(SPECS.values()), ["node", *given], examples="")
    assert f"has to stand behind --ros-args: node --ros-args {right} (see" in capsys.readouterr().err


def test_settings_that_ros_can_read_are_left_to_it() -> None:
    right = ["-p", "policy_file:=''", "-r", "__ns:=/car_1", "--remap", "a:=b"]
    check_arguments("node", "", [], ["node", "--ros-args", *right], examples="")
