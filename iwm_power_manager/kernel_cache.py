# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept, and under which name: the name says everything they were made from.

Numba's own cache watches only the file that a function stands in: after an edit to a function it calls, or to a
constant it imports, it would go on running the old code; and a damaged or unwritable folder ends the program. Here a
kernel's name carries a hash of its module and of every module of ours that this one imports, directly or not, of the
types it was compiled for, and of compiler, Python and processor. So a kernel that is found is the right one, wherever
the package stands (checkout, worktree, installation, zip archive), and an edit elsewhere recompiles nothing.

Nothing that is wrong with a folder is more than one line on stderr: the next folder is used, or none.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import importlib.util
import marshal
import os
import platform
import re
import secrets
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from iwm_power_manager.jit import STARTED_NS

#: Packages whose sources always count, wherever they are installed.
PACKAGES = frozenset({"iwm_power_manager", "iwm_sim"})
#: Folders of installed libraries: their versions count, not their sources.
_LIBRARIES = frozenset({"site-packages", "dist-packages"})
#: Changed when the layout of a file changes.
_FORMAT = "2"
_SHA256_BYTES = 32
#: Subfolder that kernels stand in.
KERNELS = "kernels"

_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+(?P<module>[.\w]+)[ \t]+import[ \t]*(?P<names>\([^)]*\)|[^\n]*)"
    r"|import[ \t]+(?P<modules>[^\n]*))",
    re.MULTILINE,
)


def imported_names(source: str, package: str) -> set[str]:
    """Every name that a module's source may import as a module, wherever in it the import stands.

    Parameters
    ----------
    source : Python source
    package : what relative imports are relative to

    Returns
    -------
    set of str
        Full names; of `from a import b` both `a` and `a.b`.
    """
    found = set()
    for match in _IMPORT.finditer(source):
        listed = re.sub(r"#[^\n]*", "", match["names"] or match["modules"] or "").strip("()\\ \t\r\n")
        names = [words[0] for part in listed.split(",") if (words := part.split())]
        if match["module"] is None:
            found.update(names)
            continue
        module = match["module"]
        if module.startswith("."):
            try:
                module = importlib.util.resolve_name(module, package)
            except ImportError:
                continue
        found.add(module)
        found.update(f"{module}.{name}" for name in names)
    return found


@functools.cache
def _spec(name: str) -> ModuleSpec | None:
    try:
        module = sys.modules.get(name)
        return module.__spec__ if module is not None and module.__spec__ else importlib.util.find_spec(name)
    except (ImportError, AttributeError, ValueError):
        return None


@functools.cache
def _counts(top: str) -> bool:
    """Whether the sources below a top-level name are part of the key: ours and the user's, not libraries'."""
    if top in PACKAGES:
        return True
    if top in sys.stdlib_module_names:
        return False
    spec = _spec(top)
    origin = (spec.origin or "") if spec else ""
    return origin.endswith(".py") and _LIBRARIES.isdisjoint(Path(origin).parts)


class UnknownSourceError(Exception):
    """The sources of a module cannot be read, or changed after this process had started."""


@functools.cache
def _source(name: str) -> tuple[str, frozenset[str]]:
    """Hash of a module's source and the modules it imports."""
    spec = _spec(name)
    if spec is None or spec.loader is None:
        module = sys.modules.get(name)  # a script: `__main__` has no spec
        path = getattr(module, "__file__", None)
        if not path:
            raise UnknownSourceError(name)
        _check_age(path, name)
        text: str | None = Path(path).read_text(encoding="utf-8")
        package = ""
    else:
        _check_age(getattr(spec.loader, "archive", None) or spec.origin, name)
        get_source = getattr(spec.loader, "get_source", None)
        text = get_source(name) if get_source else None
        package = name if spec.submodule_search_locations is not None else name.rpartition(".")[0]
    if text is None:  # installed without sources
        get_code = getattr(spec.loader, "get_code", None) if spec else None
        code = get_code(name) if get_code else None
        if code is None:
            raise UnknownSourceError(name)
        names = frozenset(name for name in sys.modules if name.split(".")[0] in PACKAGES)
        return hashlib.sha256(marshal.dumps(code)).hexdigest(), names
    return hashlib.sha256(text.encode()).hexdigest(), frozenset(imported_names(text, package))


def _check_age(path: str | None, name: str) -> None:
    # What runs is what was imported, what is read now may be newer. The inode's change time cannot be set back.
    try:
        if path and os.stat(path).st_ctime_ns > STARTED_NS:
            raise UnknownSourceError(name)
    except OSError:
        raise UnknownSourceError(name) from None


def import_closure(modules: Sequence[str]) -> dict[str, str]:
    """Hash of the source of each module that `modules` import, directly or not; themselves included.

    Raises
    ------
    UnknownSourceError
        One of them cannot be read, or changed since this process started.
    """
    closure: dict[str, str] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in closure:
            continue
        closure[name], imported = _source(name)
        parents = [name.rsplit(".", depth)[0] for depth in range(1, name.count(".") + 1)]
        waiting += [other for other in (*imported, *parents) if _counts(other.split(".")[0]) and _spec(other)]
    return closure


@functools.cache
def sources_hash(*modules: str) -> str:
    """Hash over the import closure of modules, 16 hex digits; without sources, one that no other process has."""
    try:
        closure = import_closure(modules)
    except (UnknownSourceError, OSError, SyntaxError, UnicodeDecodeError):
        return secrets.token_hex(8)
    return hashlib.sha256("".join(f"{name} {closure[name]}\n" for name in sorted(closure)).encode()).hexdigest()[:16]


class Reach(NamedTuple):
    """What a kernel can call: the modules that hold it, and the code itself, also where it was made at run time."""

    modules: frozenset[str]
    code: str


def reach(function: Callable[..., Any], is_kernel: Callable[[Any], bool]) -> Reach:
    """Every kernel that one reaches by its globals and cells, itself included.

    Parameters
    ----------
    function : in plain Python
    is_kernel : tells kernels, which have a `py_func`, from other values
    """
    code: dict[str, str] = {}
    waiting: list[Any] = [function]
    seen: set[int] = set()
    while waiting:
        value = waiting.pop()
        value = value.py_func if is_kernel(value) else value
        if isinstance(value, tuple):
            waiting += value
        if not hasattr(value, "__code__") or id(value) in seen:
            continue
        seen.add(id(value))
        made = value.__code__
        constants = [constant for constant in made.co_consts if not hasattr(constant, "co_code")]
        code[f"{value.__module__} {value.__qualname__}"] = f"{made.co_code.hex()} {constants!r} {made.co_names!r}"
        waiting += (cell.cell_contents for cell in value.__closure__ or ())
        for name in made.co_names:
            named = value.__globals__.get(name)
            if isinstance(named, tuple) or is_kernel(named):
                waiting.append(named)
            elif isinstance(named, ModuleType):
                waiting += (item for item in map(vars(named).get, made.co_names) if is_kernel(item))
    listed = "\n".join(f"{name} {code[name]}" for name in sorted(code))
    return Reach(frozenset(name.split()[0] for name in code), listed)


class Place(NamedTuple):
    """A folder for kernels; in a shared one nobody else may have put anything in it."""

    folder: Path
    shared: bool = False


def places() -> Iterator[Place]:
    """Where kernels are looked for and kept, in this order."""
    yield Place(cache_folder())
    if numbas := os.environ.get("NUMBA_CACHE_DIR"):
        yield Place(Path(numbas) / "iwm_power_manager")
    try:
        yield Place(Path(tempfile.gettempdir()) / f"iwm_power_manager-{os.getuid()}", shared=True)
    except OSError:  # no temporary folder can be written
        return


def cache_folder() -> Path:
    """Folder of what this user need not compute twice; `IWM_CACHE_DIR` moves it."""
    chosen = os.environ.get("IWM_CACHE_DIR")
    if chosen:
        return Path(chosen)
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(home) / "iwm_power_manager"


def _is_private(folder: Path) -> bool:
    """Whether nobody else can put anything into a folder below the shared temporary one."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022


class Store:
    """Files by name in the first folder that takes them; what is wrong is said once and never raised."""

    def __init__(self, where: Iterable[Place] | None = None, say: Callable[[str], None] | None = None) -> None:
        self._places = list(places() if where is None else where)
        self._refused: set[Place] = set()
        self._said: set[str] = set()
        self._say = say or (lambda text: print(f"kernel cache: {text}", file=sys.stderr, flush=True))

    def _say_once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(text)

    def load(self, name: str) -> bytes | None:
        """What was saved under a name, whole, or None."""
        for place in self._places:
            if place.shared and not _is_private(place.folder):
                continue
            try:
                data = (place.folder / KERNELS / name).read_bytes()
            except OSError:
                continue
            digest, content = data[:_SHA256_BYTES], data[_SHA256_BYTES:]
            if hashlib.sha256(content).digest() == digest:
                return content
            self.say_damaged(name)
        return None

    def say_damaged(self, name: str) -> None:
        """A file turned out to be of no use: its kernel is compiled again and written anew."""
        self._say_once(f"{name} is damaged; compiling it again")

    def save(self, name: str, content: bytes) -> None:
        """Keep something under a name, in the first folder that takes it."""
        for place in self._places:
            if place in self._refused:
                continue
            try:
                _write(place, name, hashlib.sha256(content).digest() + content)
                return
            except OSError as error:
                self._refused.add(place)
                self._say_once(f"{place.folder} cannot be written: {error.strerror or error}")
        self._say_once("no folder takes it: kernels are compiled at every start; IWM_CACHE_DIR names another folder")

    def takes(self) -> bool:
        """Whether what is saved is kept in any of the folders."""
        self.save("writable", b"")
        return len(self._refused) < len(self._places)


def _write(place: Place, name: str, data: bytes) -> None:
    if place.shared:
        place.folder.mkdir(mode=0o700, exist_ok=True)
        if not _is_private(place.folder):
            raise PermissionError(errno.EACCES, "it is not this user's alone")
    folder = place.folder / KERNELS
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{secrets.token_hex(8)}.tmp"
    try:
        temporary.write_bytes(data)
        temporary.replace(folder / name)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def prune(unused_for_s: float) -> int:
    """Remove this user's kernels that nobody has read for so long; returns how many."""
    removed = 0
    now = time.time()
    for path in (cache_folder() / KERNELS).glob("*"):
        try:
            status = path.stat()
            if now - max(status.st_atime, status.st_mtime) > unused_for_s:
                path.unlink()
                removed += 1
        except OSError:
            continue
    return removed


def environment() -> str:
    """What compiled code depends on beside its sources: Python and the machine."""
    return f"{_FORMAT} {sys.implementation.cache_tag} {platform.python_version()} {platform.machine()}"
