# SPDX-License-Identifier: Apache-2.0
"""Files: atomic writes, strict YAML, and checks that name file, key, value and range."""

from __future__ import annotations

import hashlib
import math
import os

import pytest

from iwm_power_manager import files
from iwm_power_manager.errors import ConfigError, PolicyError


def test_a_write_replaces_the_file_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "data.bin"
    path.write_bytes(b"old")
    path.chmod(0o640)
    files.atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["data.bin"]
    assert files.sha256_of(path) == hashlib.sha256(b"new").hexdigest()


def test_what_is_no_file_is_written_to_and_stays_what_it_is(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    files.atomic_write(tmp_path / "pipe", b"new")
    assert os.read(reader, 10) == b"new"
    os.close(reader)
    assert (tmp_path / "pipe").is_fifo()
    with pytest.raises(ConfigError, match="cannot be written: Is a directory"):
        files.atomic_write(tmp_path, b"new")


def test_the_hash_of_a_folder_changes_with_each_name_and_each_content_in_it(tmp_path):
    hashes = set()
    for name, content in (("a", b"1"), ("a", b"2"), ("b", b"2")):
        (tmp_path / name).write_bytes(content)
        hashes.add(files.content_sha256(tmp_path))
    assert len(hashes) == 3
    assert files.content_sha256(tmp_path / "b") == files.sha256_of(tmp_path / "b")


def test_a_new_file_gets_what_the_umask_allows(tmp_path):
    before = os.umask(0o027)
    try:
        files.atomic_write(tmp_path / "data.bin", b"x")
    finally:
        os.umask(before)
    assert (tmp_path / "data.bin").stat().st_mode & 0o777 == 0o640


def test_a_write_that_fails_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "data.bin"
    path.write_bytes(b"old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigError, match=r"data\.bin: cannot be written: No space left"):
        files.atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["data.bin"]


def test_a_symbolic_link_stays_a_link(tmp_path):
    (tmp_path / "real.bin").write_bytes(b"old")
    (tmp_path / "link.bin").symlink_to("real.bin")
    files.atomic_write(tmp_path / "link.bin", b"new")
    assert (tmp_path / "link.bin").is_symlink()
    assert (tmp_path / "real.bin").read_bytes() == b"new"


def test_a_missing_folder_is_a_clear_error(tmp_path):
    with pytest.raises(ConfigError, match="cannot be written: No such file"):
        files.atomic_write(tmp_path / "none" / "data.bin", b"x")
    with pytest.raises(ConfigError, match="cannot be read"):
        files.sha256_of(tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: {c: 1, c: 2}\n", "line 2: key 'c' stands twice"),
        ("a: 1\na: 1\n", "line 2: key 'a' stands twice"),
        ("a: [1, 2\n", "expected ',' or ']'"),
        ("\ta: 1\n", "line 1: found character"),
        ("- 1\n", "holds no mapping"),
        ("", "holds no mapping"),
        ("1: 2\n", "1: is no text key"),
        ("a: 2020-13-45\n", "line 1: '2020-13-45' is no timestamp"),
        ("a:\n\tb: 1\n", "line 2: found character '\\t' that cannot start any token; write spaces for tabs"),
        ("a: 1\nb: {topic: x, field: data[2]}\n", "line 2: expected ',' or '}', but got '['; quote a text with [ ]"),
        ("a: !!python/object/apply:os.system [ls]\n", "could not determine a constructor"),
    ],
)
def test_yaml_that_is_not_right_is_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        files.read_yaml(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_numbers_are_read_as_yaml_1_2_writes_them(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("values: [1e-3, 2E4, -1e3, .5e1, 3, 0.5, 1.e+2]\n")
    assert files.read_yaml(path)["values"] == [0.001, 20000.0, -1000.0, 5.0, 3, 0.5, 100.0]


def test_keys_are_checked_against_what_is_known():
    assert files.check_keys("f", {"a": 1}, ("a",), ("b",)) == {"a": 1}
    with pytest.raises(ConfigError, match=r"unknown key; allowed: speed, torque; did you mean speed\?$"):
        files.check_keys("f", {"sped": 1}, ["speed"], ["torque"])
    with pytest.raises(ConfigError, match=r"^f: top\.c: is an unknown key; allowed: a, b$"):
        files.check_keys("f", {"a": 1, "c": 2}, ("a",), ("b",), "top")
    with pytest.raises(ConfigError, match=r"^f: a: is missing$"):
        files.check_keys("f", {}, ("a",))
    with pytest.raises(ConfigError, match=r"^f: top: 3 is no mapping; allowed: the keys a$"):
        files.check_keys("f", 3, ("a",), parent="top")


@pytest.mark.parametrize(
    ("value", "options", "words"),
    [
        (True, {}, "True is no number; allowed: a finite number"),
        ("1", {"unit": "m"}, "'1' is no number; allowed: a finite number m"),
        (None, {}, "None is no number"),
        (math.nan, {"low": 0}, "nan is not finite; allowed: >= 0"),
        (math.inf, {"high": 3, "below": True}, "inf is not finite; allowed: < 3"),
        (-1, {"low": 0, "high": 1, "unit": "m"}, "-1 is out of range; allowed: 0 to 1 m"),
        (0, {"low": 0, "above": True}, "0 is out of range; allowed: > 0"),
        (1, {"low": 0, "high": 1, "below": True}, "1 is out of range; allowed: 0 <= value < 1"),
        (5, {"high": 3}, "5 is out of range; allowed: <= 3"),
    ],
)
def test_a_number_out_of_its_range_is_refused_with_the_range(value, options, words):
    with pytest.raises(ConfigError) as caught:
        files.check_number("f", "k", value, **options)
    assert str(caught.value) == f"f: k: {words}" or str(caught.value).startswith(f"f: k: {words}")


def test_what_is_right_passes_every_check():
    assert files.check_number("f", "k", 1, 0, 1) == 1.0
    assert files.check_integer("f", "k", 3, 0, 5) == 3
    assert files.check_choice("f", "k", "a", {"a": 1}) == "a"
    assert files.check_bool("f", "k", False) is False
    assert files.dotted("", "k") == "k"


def test_integers_choices_and_switches_are_checked():
    with pytest.raises(ConfigError, match=r"1\.5 is no integer; allowed: 0 to 5"):
        files.check_integer("f", "k", 1.5, 0, 5)
    with pytest.raises(ConfigError, match="9 is out of range; allowed: 0 to 5 s"):
        files.check_integer("f", "k", 9, 0, 5, unit="s")
    with pytest.raises(ConfigError, match=r"'equall' is unknown; allowed: equal \| rule; did you mean equal\?"):
        files.check_choice("f", "k", "equall", ("equal", "rule"))
    with pytest.raises(ConfigError, match=r"'c' is unknown; allowed: a \| b$"):
        files.check_choice("f", "k", "c", ("a", "b"))
    with pytest.raises(ConfigError, match=r"\['a'\] is unknown"):
        files.check_choice("f", "k", ["a"], ("a", "b"))
    with pytest.raises(ConfigError, match="'yes' is neither true nor false"):
        files.check_bool("f", "k", "yes")


# --- What strangers send ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/null", "/proc/self", "."])
def test_only_regular_files_are_read(name):
    with pytest.raises(ConfigError, match="cannot be read"):
        files.read_bytes(name)
    with pytest.raises(ConfigError, match="cannot be read"):
        files.sha256_of(name)


def test_a_pipe_without_a_writer_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="it is no regular file"):
        files.read_text(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="cannot be read"):
        files.read_text("null\0character")


def test_a_file_beyond_its_limit_is_refused_and_one_at_it_is_read(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"x" * 100)
    assert len(files.read_bytes(path, 100)) == 100
    with pytest.raises(ConfigError, match="is too large; allowed: 99 bytes"):
        files.read_text(path, 99)
    path.write_bytes(b"#" * (files.MAX_YAML_BYTES + 1))
    with pytest.raises(ConfigError, match="is too large"):
        files.read_yaml(path)


BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + before] * 10)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
CHAIN = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 60))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "holds more than 20000 values"),
        (CHAIN, "nests more than 32 levels"),
        ("a: " + "[" * 5000 + "]" * 5000, "nests more than 32 levels"),
        ("a: " + "{b: " * 5000 + "1" + "}" * 5000, "nests more than 32 levels"),
        ("a: &a [*a]\n", "'*a' stands in itself"),
        ("a: &a {b: *a}\n", "'*a' stands in itself"),
        ("a: *b\n", "undefined alias"),
        ("a: 1\nb: !!bool maybe\n", "line 2: 'maybe' is no bool"),
        ("a: !!int maybe\n", "'maybe' is no number"),
        ("a: !!int 1_0\n", "'1_0' is no number"),
        ("a: !!float ''\n", "'' is no number"),
        ("a: !!timestamp now\n", "line 1: 'now' is no timestamp"),
        ("a: " + "9" * 400, "a number has 400 characters, more than 40"),
        ("a: 1" + "0" * 5000, "a number has 5001 characters"),
        ("? [a, b]\n: 1\n", ""),
        ("a: \x07\n", "unacceptable character"),
    ],
)
def test_hostile_yaml_is_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "car.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        files.read_yaml(path)
    assert words in str(caught.value)
    assert str(caught.value).isprintable()


def test_aliases_may_be_used_with_measure(tmp_path):
    path = tmp_path / "car.yaml"
    path.write_text("a: &a {x: 1, y: [2, 3]}\nb: *a\nc: {<<: *a, x: 4}\n")
    assert files.read_yaml(path) == {"a": {"x": 1, "y": [2, 3]}, "b": {"x": 1, "y": [2, 3]}, "c": {"x": 4, "y": [2, 3]}}


@pytest.mark.parametrize("text", ["1_0", "017", "0x10", "0b1", "1:30", "1,5", "\u0661\u0660", "--1", "+-1"])
def test_what_yaml_1_1_or_python_would_take_for_a_number_is_text(tmp_path, text):
    path = tmp_path / "car.yaml"
    path.write_text(f"a: {text}\n")
    assert files.read_yaml(path) == {"a": text}


@pytest.mark.parametrize(
    ("text", "value"), [("0", 0), ("-12", -12), ("+.5", 0.5), (".inf", math.inf), ("-.inf", -math.inf)]
)
def test_numbers_of_yaml_keep_their_kind(tmp_path, text, value):
    path = tmp_path / "car.yaml"
    path.write_text(f"a: {text}\n")
    found = files.read_yaml(path)["a"]
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize(
    "text", ["1", "-1.5", " .5 ", "+2.", "0", "-0.0", "00.5", "1e-3", "1E5", "nan", "-inf", "Infinity"]
)
def test_numbers_of_a_table_are_read(text):
    assert repr(files.to_number(text)) == repr(float(text))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "'' is no number"),
        ("fast", "'fast' is no number"),
        ("1_0", "'1_0' is no number: write it without separators"),
        ("1 000", "write it without separators"),
        ("0,5", "a decimal comma? write a point"),
        ("\u22125", "its sign is a dash; write -"),
        ("\u0661\u0660", "write the digits 0 to 9"),
        ("50 km/h", "write it without a unit"),
        ("0x10", "write it in decimal digits, without leading zeros"),
        ("-017", "write it in decimal digits, without leading zeros"),
        ("1\u2009000", "write it without separators"),
        ("1" * 41, "it has 41 characters, more than 40"),
    ],
)
def test_what_is_no_number_is_refused_with_a_hint(text, words):
    with pytest.raises(ValueError) as caught:
        files.to_number(text)
    assert words in str(caught.value)


def test_a_huge_integer_is_out_of_range_and_no_traceback():
    with pytest.raises(ConfigError, match="f: k: -inf is not finite"):
        files.check_number("f", "k", -(10**400))


def test_a_message_is_one_printable_line_of_bounded_length():
    error = ConfigError("a\nb.yaml", "key\x1b[31m", "x" * 10_000 + "\u202e", "1\r2")
    assert str(error).isprintable()
    assert str(error).startswith(r"a\nb.yaml: key\x1b[31m: xxx")
    assert str(error).endswith(r"...; allowed: 1\r2")
    assert len(str(PolicyError("y" * 10_000))) == 1000
