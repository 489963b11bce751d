"""The one numba decorator of the project.

Numba's on-disk cache only watches the file a function stands in: after an edit to a function it calls, or to a
constant it imports, it would go on running the old code. So the cache folder carries a hash of every source file of
both packages: any edit starts a new cache. Arithmetic stays IEEE (no `fastmath`), so that the same step gives the same
bits whether it is called from Python or inlined into a loop.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config as numba_config

F = TypeVar("F", bound=Callable[..., Any])


#: Folders at the edges, which hold no kernel: editing them need not recompile anything.
KERNEL_FREE = frozenset({"ros", "nodes", "tools", "bags", "study"})


def source_hash() -> str:
    """Hash of every Python source that a kernel can stand in or read a constant from (16 hex digits)."""
    root = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for package in (root, root.parent / "iwm_sim"):
        for path in sorted(package.rglob("*.py")):
            relative = path.relative_to(package.parent)
            if KERNEL_FREE.isdisjoint(relative.parts):
                digest.update(str(relative).encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Folder of this version's compiled kernels; `IWM_CACHE_DIR` moves it."""
    base = os.environ.get("IWM_CACHE_DIR") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache"), "iwm_power_manager"
    )
    return Path(base) / f"numba-{numba.__version__}-{source_hash()}"


_CACHE = str(cache_folder())


def _compile(function: F, **options: Any) -> F:
    if not KERNEL_FREE.isdisjoint(function.__module__.split(".")):
        raise RuntimeError(f"{function.__module__} may hold no kernel: its sources are not part of the cache's key")
    before = numba_config.CACHE_DIR
    numba_config.CACHE_DIR = _CACHE
    try:
        return numba.njit(cache=True, error_model="numpy", **options)(function)
    finally:
        numba_config.CACHE_DIR = before


def kernel(function: F) -> F:
    """Compile `function` with numba, cached on disk for exactly this version of the sources."""
    return _compile(function)


def parallel_kernel(function: F) -> F:
    """As `kernel`, but it runs without the interpreter's lock: threads can work on separate parts of its output.

    Not for the control law, which would have to wait for the lock after every step.
    """
    return _compile(function, nogil=True)
