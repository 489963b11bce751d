# SPDX-License-Identifier: Apache-2.0
"""What every command has in common: its parser, how it ends, and the files it leaves."""

from __future__ import annotations

import argparse
import dataclasses
import io
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from iwm_power_manager import __version__
from iwm_power_manager.command_line import CommandParser, Written
from iwm_power_manager.errors import IwmError
from iwm_power_manager.exit_codes import DONE, INTERRUPTED
from iwm_power_manager.files import atomic_write, no_empty_remains

if TYPE_CHECKING:
    from iwm_power_manager.cycle import Cycle
    from iwm_power_manager.vehicle import Vehicle


def described(name: str, description: str, examples: str) -> CommandParser:
    """Parser of a command, with `--version` and examples as typed."""
    parser = CommandParser(name, description=description, epilog=examples)
    parser.add_argument("--version", action="version", version=f"{name} {__version__}")
    return parser


def made_with(
    friction: str, idle_drive: str, rate_hz: float, period_s: float = 0.0, policies: Iterable[str] = ()
) -> str:
    """What a result depends on, as every result says it: road, car, control rate, decision period, policies if any."""
    parts = [f"friction {friction}, idle drive {idle_drive}, control at {rate_hz:.4g} Hz"]
    parts += [f"split decided every {period_s:g} s"] if period_s else []
    named = list(dict.fromkeys(filter(None, policies)))
    parts += [f"polic{'ies' if len(named) > 1 else 'y'} {', '.join(named)}"] if named else []
    return ", ".join(parts)


def ended(name: str, work: Callable[[], int | None], output: Path | str | None = None, *, quiet: bool = False) -> int:
    """Exit code of a command's work; what is wrong with the user's input is one line, and compiling is shown.

    A folder for its results, `output`, does not stay empty where there are none.
    """
    from iwm_power_manager.tools.progress import show_compiling

    show_compiling(quiet=quiet)
    try:
        with no_empty_remains(output or "."):
            return work() or DONE
    except IwmError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print(f"{name}: interrupted; nothing half-written is left", file=sys.stderr)
        return INTERRUPTED


def doubts(vehicle: Vehicle, cycles: Iterable[Cycle], frictions: Sequence[float]) -> list[str]:
    """What a reader should know of a car and of the cycles it is to drive on these roads, each once."""
    from iwm_power_manager.model.feasible import trace_warnings

    lines = [f"note: {note}" for note in vehicle.notes]
    for cycle in cycles:
        lines += [f"warning: {cycle.gap}"] if cycle.gap else []
        for friction in frictions:
            lines += [f"warning: {vehicle.name}: {words}" for words in trace_warnings(cycle, vehicle.params, friction)]
    return list(dict.fromkeys(lines))


def plain(value: Any, digits: int = 17) -> Any:
    """A value as JSON has it: what has fields or names as a mapping, arrays as lists, what is not finite as null.

    Numbers have that many significant digits; 17 are all there are.
    """
    if hasattr(value, "to_json"):
        value = value.to_json()
    elif dataclasses.is_dataclass(value):
        value = vars(value)
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    elif hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(entry, digits) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry, digits) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def note_replaced(*paths: Path | str) -> None:
    """Say which of these files are there already, and will not be any more."""
    there = [str(path) for path in paths if os.path.isfile(path)]
    if there:
        print(f"note: replaces {', '.join(there)}", file=sys.stderr)


def write_result(path: Path | str, data: bytes) -> None:
    """Write a file that the user has named, atomically; that it replaces another one is said."""
    note_replaced(path)
    atomic_write(path, data)


def write_json(path: Path | str, value: Any) -> None:
    """Write a value as JSON (`plain`), atomically; to standard output, where the file is called -."""
    text = json.dumps(plain(value), indent=1)
    if str(path) == "-":
        print(text)
    else:
        write_result(path, (text + "\n").encode())


#: Endings of a picture's name, and what would make its bytes differ from run to run or say who drew it.
PICTURES = {".pdf": {"CreationDate": None}, ".png": {"Software": None}, ".svg": {"Date": None}}


def beside_json(json: str | None) -> redirect_stdout[TextIO]:
    """Where results are printed for people: where JSON goes to standard output, nothing else does."""
    return redirect_stdout(sys.stderr if json == "-" else sys.stdout)


def output_file(text: str) -> Written:
    """Argument type of a file's name to write to; what cannot be one is refused before anything is computed for it."""
    if not text:
        raise argparse.ArgumentTypeError("an empty name cannot be written")
    if text != "-" and not Path(text).absolute().parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text} cannot be written: no such folder")
    if os.path.isdir(text):
        raise argparse.ArgumentTypeError(f"{text} cannot be written: it is a folder")
    replaced = os.path.isfile(text) or not os.path.exists(text)  # not a pipe or a device, which is written to
    if text != "-" and replaced and not os.access(Path(os.path.realpath(text)).parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text} cannot be written: its folder may not be written to")
    return Written(text)


def picture(text: str) -> Written:
    """Argument type of a picture's file name."""
    if Path(output_file(text)).suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(f"{text} is no picture's name; allowed: ending in {', '.join(PICTURES)}")
    return Written(text)


def write_picture(path: Path | str, figure: Any, dpi: int = 150) -> None:
    """Write a matplotlib figure, atomically, as what the file's name ends in: PDF, PNG or SVG."""
    kind = Path(path).suffix.lower()
    stream = io.BytesIO()
    figure.savefig(stream, format=kind[1:], dpi=dpi, facecolor="white", metadata=PICTURES[kind])
    write_result(path, stream.getvalue())
