"""Files at the edge: hashes, atomic writes, and YAML whose every mistake is named with its place.

YAML is read strictly: a key that stands twice, something other than a mapping at the top, or a syntax error are
refused with the line they stand in. The small checkers below turn a value of a user's file into a number, a name or a
list, or into one `ConfigError` that says file, key, value and what is allowed.
"""

from __future__ import annotations

import errno
import hashlib
import math
import os
import re
import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from iwm_power_manager.errors import ConfigError


def read_bytes(path: Path | str) -> bytes:
    """All bytes of a file; one that is missing or unreadable is a `ConfigError`."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(path, "", f"cannot be read: {error.strerror or error}") from None


def read_text(path: Path | str) -> str:
    """All text of a UTF-8 file (a byte order mark is skipped); anything else is a `ConfigError`."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(path, "", f"is not UTF-8 text (byte {error.start})") from None


def sha256_of(path: Path | str) -> str:
    """SHA-256 of a file's bytes, 64 hex digits; `ConfigError` if it cannot be read."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def content_sha256(path: Path | str) -> str:
    """SHA-256 of a file's bytes; of a folder, over the names and hashes of the files in it."""
    path = Path(path)
    if not path.is_dir():
        return sha256_of(path)
    files = sorted(file for file in path.iterdir() if file.is_file())
    return hashlib.sha256("".join(f"{file.name} {sha256_of(file)}\n" for file in files).encode()).hexdigest()


def atomic_write(path: Path | str, data: bytes) -> None:
    """Write `data` so that a reader sees the old file or the whole new one, even after a power cut.

    The bytes go to a temporary file in the same folder, are forced to disk and renamed over `path`. An existing file
    keeps its permissions; a symbolic link keeps pointing where it did.

    Raises
    ------
    ConfigError
        The folder does not exist or cannot be written.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        mode = target.stat().st_mode & 0o777 if target.exists() else None
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                if mode is not None:
                    os.fchmod(file.fileno(), mode)
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(target.parent)
    except OSError as error:
        raise ConfigError(path, "", f"cannot be written: {error.strerror or error}") from None


def sync_folder(path: Path) -> None:
    """Have the disk take a folder's entries: before, a new or renamed file is not safe from a power cut.

    Where that cannot be asked for (a folder that may be written but not read, a file system that does not know it),
    nothing is done; any other trouble is an `OSError`.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
    finally:
        os.close(descriptor)


class _StrictLoader(yaml.SafeLoader):
    """Safe loading that refuses a repeated key and reads 1e-3 as a number (plain PyYAML takes it for text)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    problem = f"key '{key.value}' stands twice"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"), list("-+0123456789.")
)


def read_yaml(path: Path | str) -> dict[str, Any]:
    """The mapping a YAML file holds.

    Raises
    ------
    ConfigError
        The file is unreadable, is no YAML, repeats a key, or holds something other than a mapping with text keys.
    """
    text = read_text(path)
    try:
        # _StrictLoader is a SafeLoader: it builds plain values only.
        content = yaml.load(text, _StrictLoader)  # noqa: S506
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}" if mark else ""
        raise ConfigError(path, where, " ".join((error.problem or "is no YAML").split())) from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: an impossible date, for instance
        raise ConfigError(path, "", f"is no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise ConfigError(path, "", "holds no mapping", "lines of the form 'key: value'")
    for key in content:
        if not isinstance(key, str):
            raise ConfigError(path, str(key), "is no text key", "names as keys")
    return content


def check_keys(
    file: Path | str, mapping: Any, required: Iterable[str], optional: Iterable[str] = (), parent: str = ""
) -> Mapping[str, Any]:
    """`mapping`, if it is one and holds all the required keys and none that is unknown; else a `ConfigError`.

    `parent` is the dotted path of the mapping, "" for the file's top.
    """
    required, optional = tuple(required), tuple(optional)
    known = (*required, *optional)
    if not isinstance(mapping, Mapping):
        raise ConfigError(file, parent, f"{mapping!r} is no mapping", f"the keys {', '.join(known)}")
    for key in mapping:
        if key not in known:
            raise ConfigError(file, dotted(parent, key), "is an unknown key", ", ".join(known))
    for key in required:
        if key not in mapping:
            raise ConfigError(file, dotted(parent, key), "is missing")
    return mapping


def dotted(parent: str, key: object) -> str:
    """Dotted path of a key below its parent."""
    return f"{parent}.{key}" if parent else str(key)


def check_number(
    file: Path | str,
    key: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: bool = False,
    below: bool = False,
    unit: str = "",
) -> float:
    """`value` as a finite float inside low..high; `above` / `below` exclude the end itself.

    Raises
    ------
    ConfigError
        It is no number (true and false are none), NaN, infinite or outside the range.
    """
    allowed = _range_text(low, high, above, below, unit)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(file, key, f"{value!r} is no number", allowed)
    number = float(value)
    if not math.isfinite(number):
        raise ConfigError(file, key, f"{number} is not finite", allowed)
    if number < low or number > high or (above and number == low) or (below and number == high):
        raise ConfigError(file, key, f"{value} is out of range", allowed)
    return number


def check_integer(file: Path | str, key: str, value: Any, low: int, high: int, unit: str = "") -> int:
    """`value` as an integer inside low..high, else a `ConfigError`."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConfigError(file, key, f"{value!r} is no integer", _range_text(low, high, False, False, unit))
    return int(check_number(file, key, value, low, high, unit=unit))


def check_choice(file: Path | str, key: str, value: Any, choices: Iterable[str]) -> str:
    """`value`, if it is one of `choices`, else a `ConfigError`."""
    choices = tuple(choices)
    if not isinstance(value, str) or value not in choices:
        raise ConfigError(file, key, f"{value!r} is unknown", " | ".join(choices))
    return value


def check_bool(file: Path | str, key: str, value: Any) -> bool:
    """`value`, if it is true or false, else a `ConfigError`."""
    if not isinstance(value, bool):
        raise ConfigError(file, key, f"{value!r} is neither true nor false", "true | false")
    return value


def _range_text(low: float, high: float, above: bool, below: bool, unit: str) -> str:
    suffix = f" {unit}" if unit else ""
    if math.isinf(low) and math.isinf(high):
        return f"a finite number{suffix}"
    if math.isinf(high):
        return f"{'>' if above else '>='} {low:g}{suffix}"
    if math.isinf(low):
        return f"{'<' if below else '<='} {high:g}{suffix}"
    if above or below:
        return f"{low:g} {'<' if above else '<='} value {'<' if below else '<='} {high:g}{suffix}"
    return f"{low:g} to {high:g}{suffix}"
