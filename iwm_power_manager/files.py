# SPDX-License-Identifier: Apache-2.0
"""Files at the edge: hashes, atomic writes, and YAML whose every mistake is named with its place.

YAML is read strictly: a key that stands twice, something other than a mapping at the top, or a syntax error are
refused with the line they stand in. The small checkers below turn a value of a user's file into a number, a name or a
list, or into one `ConfigError` that says file, key, value and what is allowed.

Files come from strangers: what they may take is bounded here, once for all loaders (docs/files.md).
"""

from __future__ import annotations

import errno
import hashlib
import math
import os
import re
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import yaml

from iwm_power_manager import share
from iwm_power_manager.errors import ConfigError, did_you_mean, spelled_like

#: Bytes of a file that is read whole (a policy, counted transitions).
MAX_FILE_BYTES = 256 * 2**20
#: Bytes of a CSV or another text.
MAX_TEXT_BYTES = 64 * 2**20
#: Bytes of a YAML file, nodes in it with every alias written out, and how deep they may be nested.
MAX_YAML_BYTES = 256 * 2**10
MAX_YAML_NODES = 20_000
MAX_YAML_DEPTH = 32
#: Characters of a number, in CSV and YAML.
MAX_NUMBER_LENGTH = 40
#: Characters of the name of a car or a grid.
MAX_NAME_LENGTH = 100
#: Characters of a line of a CSV.
MAX_LINE_LENGTH = 4096

_BLOCK = 2**20
_NUMBER = re.compile(r"[-+]?(?!0[0-9]+$)([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?", re.ASCII)
_BARE_INDEX = re.compile(r"[^\W\d]\w*\[\d+\](?![\w.]*[\"'])")
_NOT_FINITE = re.compile(r"[-+]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)


def _blocks(path: Path | str) -> Iterator[bytes]:
    """The bytes of a regular file; a folder, device, pipe or socket is refused before it is read."""
    try:
        # A pipe without a writer would block here, and a terminal take the process over.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        with os.fdopen(descriptor, "rb", buffering=0) as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise ConfigError(path, "", "cannot be read: it is no regular file")
            while block := file.read(_BLOCK):
                yield block
    except OSError as error:
        near = share.did_you_mean(Path(path)) or _from(path) if isinstance(error, FileNotFoundError) else ""
        raise ConfigError(path, "", f"cannot be read: {error.strerror or error}{near}") from None
    except ValueError as error:  # a null character in the path
        raise ConfigError(path, "", f"cannot be read: {error}") from None


def _from(path: Path | str) -> str:
    """Where a relative path begins: a file that names others, and a service, may be read from another folder."""
    try:
        return "" if os.path.isabs(path) else f" (looked for from {os.getcwd()})"
    except OSError:  # the folder is gone
        return ""


def read_bytes(path: Path | str, limit: int = MAX_FILE_BYTES) -> bytes:
    """All bytes of a regular file; one that is missing, unreadable or too large is a `ConfigError`."""
    content = bytearray()
    for block in _blocks(path):
        content += block
        if len(content) > limit:
            raise ConfigError(path, "", "is too large", f"{limit:,} bytes")
    return bytes(content)


def read_text(path: Path | str, limit: int = MAX_TEXT_BYTES) -> str:
    """All text of a UTF-8 file (a byte order mark is skipped); anything else is a `ConfigError`."""
    content = read_bytes(path, limit)
    if content[:2] in (b"\xff\xfe", b"\xfe\xff") or 0 in content[:2]:
        raise ConfigError(path, "", "is not UTF-8 text: looks like UTF-16; save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(
            path, "", f"is not UTF-8 text (byte {error.start}): save it as UTF-8, or iconv -f latin1 -t utf-8"
        ) from None


def sha256_of(path: Path | str) -> str:
    """SHA-256 of a file's bytes, 64 hex digits; `ConfigError` if it cannot be read."""
    digest = hashlib.sha256()
    for block in _blocks(path):
        digest.update(block)
    return digest.hexdigest()


def content_sha256(path: Path | str) -> str:
    """SHA-256 of a file's bytes; of a folder, over the names and hashes of the files in it."""
    path = Path(path)
    if not os.path.isdir(path):
        return sha256_of(path)
    files = sorted(file for file in path.iterdir() if file.is_file())
    return hashlib.sha256("".join(f"{file.name} {sha256_of(file)}\n" for file in files).encode()).hexdigest()


def atomic_write(path: Path | str, data: bytes) -> None:
    """Write `data` so that a reader sees the old file or the whole new one, even after a power cut.

    The bytes go to a temporary file in the same folder, are forced to disk and renamed over `path`. An existing file
    keeps its permissions; a symbolic link keeps pointing where it did. To what is no file (a device, a pipe) they are
    written as to any other.

    Raises
    ------
    ConfigError
        The folder does not exist or cannot be written.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            Path(path).write_bytes(data)
            return
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


def make_folder(path: Path | str, *, new: bool = False) -> Path:
    """Create a folder with those above it; `ConfigError` if that cannot be, or if it was to be new and is there."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=not new)
    except OSError as error:
        allowed = f"a folder{' that is not there yet' if new else ''}"
        raise ConfigError(path, "", f"cannot be created: {error.strerror}", allowed) from None
    return folder


def friction_in_name(friction: float) -> str:
    """A friction as it stands in names of files: in hundredths, 050 for 0.5, with as many digits as tell it."""
    return f"{100.0 * friction:.6g}".zfill(3)


@contextmanager
def no_empty_remains(folder: Path | str) -> Iterator[None]:
    """Whatever ends what is done meanwhile, a folder that was not there before is not left without a file in it."""
    missing = [path for path in (Path(folder), *Path(folder).parents) if not os.path.lexists(path)]
    try:
        yield
    except BaseException:
        for path, _, _ in os.walk(missing[-1], topdown=False) if missing else ():
            with suppress(OSError):  # it holds a result
                os.rmdir(path)
        raise


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
    """Safe loading that refuses repeated keys and what unfolds without end, and reads numbers as YAML 1.2 writes them.

    Plain PyYAML takes 1e-3 for text, 017 for fifteen, 1_0 for ten and 1:30 for ninety.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._open: list[list[int]] = []  # of each node being read: nodes in it so far, depth below it
        self._sizes: dict[int, tuple[int, int]] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            node = super().compose_node(parent, index)
            if id(node) not in self._sizes:
                problem = f"'*{event.anchor}' stands in itself"
                mark: Any = event.start_mark
                raise yaml.composer.ComposerError(None, None, problem, mark)
        else:
            self._open.append([1, 0])
            self._bound(0, len(self._open), event)
            node = super().compose_node(parent, index)
            nodes, below = self._open.pop()
            self._sizes[id(node)] = nodes, below + 1
        nodes, depth = self._sizes[id(node)]
        if self._open:
            self._open[-1][0] += nodes
            self._open[-1][1] = max(self._open[-1][1], depth)
            nodes = self._open[-1][0]
        self._bound(nodes, depth + len(self._open), event)
        return node

    @staticmethod
    def _bound(nodes: int, depth: int, event: Any) -> None:
        for value, limit, words in ((nodes, MAX_YAML_NODES, "holds"), (depth, MAX_YAML_DEPTH, "nests")):
            if value > limit:
                problem = f"{words} more than {limit} {'values' if words == 'holds' else 'levels'}"
                raise yaml.composer.ComposerError(None, None, problem, event.start_mark)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    problem = f"key '{key.value}' stands twice"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except yaml.YAMLError:
            raise
        except Exception:  # noqa: BLE001 - PyYAML's constructors fail in many ways: !!bool maybe is a KeyError
            problem = f"{str(node.value)[:MAX_NUMBER_LENGTH]!r} is no {node.tag.rpartition(':')[2]}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None

    def number(self, node: yaml.ScalarNode) -> float | int:
        """A number of decimal digits."""
        text = str(self.construct_scalar(node))
        if len(text) > MAX_NUMBER_LENGTH:
            problem = f"a number has {len(text)} characters, more than {MAX_NUMBER_LENGTH}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        plain = text.lower().replace(".inf", "inf").replace(".nan", "nan")
        if not (_NUMBER.fullmatch(plain) or _NOT_FINITE.fullmatch(plain)):
            raise yaml.constructor.ConstructorError(None, None, f"'{text}' is no number", node.start_mark)
        return int(plain) if node.tag == _INTEGER_TAG and plain.lstrip("+-").isdigit() else float(plain)


_INTEGER_TAG, _FLOAT_TAG = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_StrictLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in (_INTEGER_TAG, _FLOAT_TAG)]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_StrictLoader.add_implicit_resolver(_INTEGER_TAG, re.compile(r"[-+]?(0|[1-9][0-9]*)$"), list("-+0123456789"))
_StrictLoader.add_implicit_resolver(
    _FLOAT_TAG,
    re.compile(
        r"([-+]?(\.[0-9]+|[0-9]+\.[0-9]*)([eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$"
    ),
    list("-+0123456789."),
)
for _tag in (_INTEGER_TAG, _FLOAT_TAG):
    _StrictLoader.add_constructor(_tag, _StrictLoader.number)


def read_yaml(path: Path | str) -> dict[str, Any]:
    """The mapping a YAML file holds.

    Raises
    ------
    ConfigError
        The file is unreadable or too large, is no YAML, repeats a key, or holds something other than a mapping with
        text keys.
    """
    text = read_text(path, MAX_YAML_BYTES)
    try:
        # _StrictLoader is a SafeLoader: it builds plain values only.
        content = yaml.load(text, _StrictLoader)  # noqa: S506
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}" if mark else ""
        line = "".join(text.split("\n")[mark.line : mark.line + 1]) if mark else ""
        hint = (
            "; quote a text with [ ]" if _BARE_INDEX.search(line) else "; write spaces for tabs" if "\t" in line else ""
        )
        raise ConfigError(path, where, " ".join((error.problem or "is no YAML").split()) + hint) from None
    except Exception as error:  # noqa: BLE001 - characters that no YAML has, and what else PyYAML fails at
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(path, "", f"is no YAML: {reason}") from None
    if not isinstance(content, dict):
        raise ConfigError(path, "", "holds no mapping", "lines of the form 'key: value'")
    for key in content:
        if not isinstance(key, str):
            raise ConfigError(path, str(key), "is no text key", "names as keys")
    return content


def to_number(text: str) -> float:
    """A number of a table: decimal digits with sign, point and exponent, or nan, inf.

    Raises
    ------
    ValueError
        It is something else (`1_0`, digits of another script, more than `MAX_NUMBER_LENGTH` characters); the message
        is what is wrong, with a hint where the mistake is a common one.
    """
    plain = text.strip()
    if len(plain) <= MAX_NUMBER_LENGTH and (_NUMBER.fullmatch(plain) or _NOT_FINITE.fullmatch(plain)):
        return float(plain)
    shown = plain if len(plain) <= MAX_NUMBER_LENGTH else f"{plain[:MAX_NUMBER_LENGTH]}..."
    raise ValueError(f"'{shown}' is no number" + _hint(plain))


def _hint(text: str) -> str:
    """What is probably meant by a text that is no number."""
    if len(text) > MAX_NUMBER_LENGTH:
        return f": it has {len(text)} characters, more than {MAX_NUMBER_LENGTH}"
    if re.fullmatch(r"[-+]?[0-9.]*,[0-9]+([eE][-+]?[0-9]+)?", text, re.ASCII):
        return ": a decimal comma? write a point"
    if any(c in "\u2212\u2010\u2011\u2012\u2013\u2014" for c in text):
        return ": its sign is a dash; write -"
    if any(c.isdigit() and not c.isascii() for c in text):
        return ": write the digits 0 to 9"
    if re.fullmatch(r"[-+]?0[0-9xXoObB].*", text):
        return ": write it in decimal digits, without leading zeros"
    if re.fullmatch(r"[-+]?[0-9]{1,3}(,[0-9]{3})+\.[0-9]+", text):
        return ": write it without separators"
    if re.fullmatch(r"[-+]?[0-9]{1,3}([ '\u00a0\u2009\u202f_][0-9]+)+([.,][0-9]+)?", text):
        return ": write it without separators"
    if re.match(r"[-+]?[0-9.]+\s*[^\W\d_]", text):
        return ": write it without a unit"
    return ""


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
            near = did_you_mean(spelled_like(str(key), known))
            raise ConfigError(file, dotted(parent, key), "is an unknown key", ", ".join(known) + near)
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
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf if value > 0 else -math.inf
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
        near = did_you_mean(spelled_like(value, choices)) if isinstance(value, str) else ""
        raise ConfigError(file, key, f"{value!r} is unknown", " | ".join(choices) + near)
    return value


def check_name(file: Path | str, key: str, value: Any) -> str:
    """`value` without space around it, if it is a text for tables and logs: printable, not empty, not long."""
    if not (isinstance(value, str) and value.strip() and value.isprintable() and len(value) <= MAX_NAME_LENGTH):
        allowed = f"a printable text that is not empty, {MAX_NAME_LENGTH} characters at most"
        raise ConfigError(file, key, f"{value!r} is no name", allowed)
    return value.strip()


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
