"""All tables and figures of the paper, and what beats them."""

from __future__ import annotations

from pathlib import Path

from iwm_power_manager.errors import IwmError


def study(output: Path, *, vehicle: str, policy: str, jobs: int, quiet: bool) -> None:
    """Make the whole study."""
    raise IwmError(f"the study for {output} is not part of this version yet")
