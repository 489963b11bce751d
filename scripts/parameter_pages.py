# SPDX-License-Identifier: Apache-2.0
"""A node's parameters as a parameter file and as a table of docs/interface.md."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable

from iwm_power_manager.nodes.power_manager_config import SPECS
from iwm_power_manager.ros.specs import Spec, Value

_WIDTH = 118


def yaml_text(specs: Iterable[Spec], introduction: str) -> str:
    """A parameter file with every parameter at its default, each below its description.

    Parameters
    ----------
    specs : the parameters of a node, whatever its name; those with a dot in their names have to stand together
    introduction : first lines, without the comment signs
    """
    lines = [f"# {line}" for line in textwrap.wrap(introduction, _WIDTH)]
    lines += ["/**:", "  ros__parameters:"]
    group = ""
    for spec in specs:
        parent, _, name = spec.name.rpartition(".")
        if parent and parent != group:
            lines.append(f"    {parent}:")
        group = parent
        indent = "      " if parent else "    "
        lines += [f"{indent}# {line}" for line in textwrap.wrap(spec.description, _WIDTH - len(indent))]
        lines.append(f"{indent}{name}: {_yaml_value(spec.default)}")
    return "\n".join(lines) + "\n"


def markdown_table(specs: Iterable[Spec]) -> str:
    """All parameters as a table for the documentation."""
    lines = ["| parameter | default | allowed | changes | meaning |", "|---|---|---|---|---|"]
    for spec in specs:
        allowed = spec.allowed().replace("|", "\\|")
        default = _yaml_value(spec.default)
        lines.append(f"| `{spec.name}` | `{default}` | {allowed} | {spec.change.value} | {spec.description} |")
    return "\n".join(lines) + "\n"


def _yaml_value(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(_yaml_value(item) for item in value)}]"
    if isinstance(value, float):
        # YAML takes 1e6 for a text: a number needs its point.
        mantissa, _, exponent = repr(value).partition("e")
        return (mantissa if "." in mantissa else f"{mantissa}.0") + (f"e{exponent}" if exponent else "")
    return json.dumps(value) if value in ("", "none") else str(value)


def parameter_file() -> str:
    """Content of `config/nodes/power_manager.yaml`."""
    return yaml_text(
        SPECS,
        "Parameters of the power manager, all of them, with their defaults. Ranges: docs/interface.md, or "
        "`ros2 param describe`. Written by scripts/update_interface.",
    )
