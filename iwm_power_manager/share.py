# SPDX-License-Identifier: Apache-2.0
"""Where the files that come with the package are: `config/`, `policies/`, `launch/`.

They lie beside the package in a source checkout, below `share/iwm_power_manager` once installed by colcon or pip. No
ROS is needed to find them.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable
from pathlib import Path

from iwm_power_manager import errors
from iwm_power_manager.errors import ConfigError

PACKAGE = "iwm_power_manager"
#: Folders that an installation has, too: what else lies in a checkout is somebody's own.
_SHIPPED = ("config", "launch", "policies")


def roots() -> list[Path]:
    """Folders that may hold `config/` and `policies/`, in order of preference.

    The checkout this module stands in, then the prefix it is installed below, then those that ROS and Python name.
    """
    here = Path(__file__).resolve()
    checkout = here.parents[1]
    found = [checkout] if (checkout / "package.xml").is_file() else []
    prefixes = [*here.parents[2:], *map(Path, filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))]
    found += [prefix / "share" / PACKAGE for prefix in (*prefixes, Path(sys.prefix))]
    return list(dict.fromkeys(root for root in found if root.is_dir()))


def share_path(relative: Path | str) -> Path:
    """Path of a file or folder of the package, such as `config/vehicles/jalalmaab_2015.yaml`.

    Raises
    ------
    ConfigError
        If the package was installed without it.
    """
    for root in roots():
        if os.path.exists(root / relative):
            return root / relative
    searched = ", ".join(map(str, roots())) or "no folder"
    raise ConfigError(relative, "", f"no such file in the package; searched {searched}")


def resolve(path: Path | str) -> Path:
    """Give the file a user means by `path`.

    An absolute path, or one that exists seen from the current folder, is taken as it is; but a folder there hides no
    file of the package with its name, such as `nycc` the cycle. Otherwise it is looked for among the files of the
    package, so that `config/vehicles/jalalmaab_2015.yaml`, and `jalalmaab_2015` alone, work from anywhere. A path that
    is nowhere comes back unchanged: whoever opens it reports it under the name the user gave.

    Raises
    ------
    ConfigError
        If a name alone fits several files of the package, or none but is much like some.
    """
    given = Path(os.path.expanduser(path))
    # Path's own exists() and is_dir() raise for a name that is too long or lies in a folder that may not be entered.
    there = os.path.exists(given)
    if given.is_absolute() or (there and not os.path.isdir(given)):
        return given
    for root in roots():
        if given.parts[:1] and given.parts[0] in _SHIPPED and os.path.exists(root / given) and not there:
            return root / given
        matches = _files_named(root, str(given)) if len(given.parts) == 1 else []
        if len(matches) > 1 and not there:
            names = ", ".join(str(match.relative_to(root)) for match in matches)
            raise ConfigError(given, "", "fits several files of the package", names)
        if len(matches) == 1:
            return matches[0]
    if there:
        return given
    known = {path.name for root in roots() for path in _files(root)} if len(given.parts) == 1 else set()
    near = did_you_mean(given, known)
    if near:
        raise ConfigError(given, "", f"cannot be read: No such file or directory{near}")
    return given


def did_you_mean(given: Path, known: Iterable[str] = ()) -> str:
    """Question that names up to three of `known`, and of what stands beside `given`, spelled much like it; or "".

    A file is answered with files of its kind, as far as there are any.
    Where a folder above `given` is missing, its name may be the one that is misspelled.
    """
    folder = next((folder for folder in reversed(given.parents) if not os.path.exists(folder)), given)
    names = set(known)
    with contextlib.suppress(OSError):
        names |= {path.name for path in folder.parent.iterdir()}
    names.discard(given.name)  # there, but a link to nowhere
    if folder == given and given.suffix:
        kind = [name for name in names if _kind(Path(name)) == _kind(given)]
        names = set(kind) or names
    by_stem = {Path(name).stem: name for name in sorted(names)}
    near = errors.spelled_like(folder.stem, by_stem)
    if folder != given:
        meant = [folder.with_name(by_stem[stem]) / given.relative_to(folder) for stem in near]
        return errors.did_you_mean(str(path) for path in meant if os.path.exists(path))
    return errors.did_you_mean(str(given.with_name(by_stem[stem] if given.suffix else stem)) for stem in near)


def _kind(path: Path) -> str:
    return path.suffix.lower().replace(".yml", ".yaml")


def _files(root: Path) -> list[Path]:
    """Files below config/ and policies/."""
    return [path for folder in ("config", "policies") for path in (root / folder).rglob("*") if path.is_file()]


def _files_named(root: Path, name: str) -> list[Path]:
    """Files below config/ and policies/ that are called `name`, with or without their suffix."""
    return sorted(path for path in _files(root) if name in (path.name, path.stem))
