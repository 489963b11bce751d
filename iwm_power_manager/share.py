"""Where the files that come with the package are: `config/`, `policies/`.

They lie beside the package in a source checkout, below `share/iwm_power_manager` once installed by colcon or pip. No
ROS is needed to find them.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

PACKAGE = "iwm_power_manager"


def roots() -> list[Path]:
    """Folders that may hold `config/` and `policies/`, in order of preference."""
    checkout = Path(__file__).resolve().parent.parent
    prefixes = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    prefixes.append(Path(sys.prefix))
    return [checkout, *(prefix / "share" / PACKAGE for prefix in prefixes)]


def resolve(path: Path | str) -> Path:
    """The file a user means by `path`.

    An absolute path, or one that exists seen from the current folder, is taken as it is. Otherwise it is looked for
    among the files of the package, so that `config/vehicles/jalalmaab_2015.yaml` works from anywhere. A path that is
    nowhere comes back unchanged: whoever opens it reports it under the name the user gave.
    """
    given = Path(path).expanduser()
    if given.is_absolute() or given.exists():
        return given
    for root in roots():
        if (root / given).exists():
            return root / given
    return given
