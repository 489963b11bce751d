# SPDX-License-Identifier: Apache-2.0
"""One self-contained HTML page: tables, charts over time, figures and settings of a run.

A page is a list of blocks, each a small frozen dataclass; `assets/report.html.jinja` knows how each looks, and escapes
whatever it is given. The page makes no request of any kind: style, script and data stand in the file, and its content
security policy forbids the browser to fetch anything. Charts over time are drawn in the browser from data thinned here
(`thin`), so that a finger or a mouse can read values and zoom; figures are matplotlib SVG whose colours follow the page
from light to dark.
"""

from __future__ import annotations

import functools
import html
import io
import itertools
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import ArrayLike, NDArray

from iwm_power_manager import __version__
from iwm_power_manager.files import atomic_write
from iwm_power_manager.tools.command import plain
from iwm_sim.study.palette import COLOURS, INK

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Points a chart keeps of each series: two (smallest and largest) for each of half as many equal stretches of samples.
CHART_POINTS = 6000


class Verdict(NamedTuple):
    """Good or bad, in a word: never by colour alone."""

    good: bool
    word: str


@dataclass(frozen=True)
class Text:
    """A paragraph under an optional heading."""

    text: str
    title: str = ""


@dataclass(frozen=True)
class Tile:
    """One key figure: `value` in `unit`, with a line of `detail` below it."""

    name: str
    value: str
    unit: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Tiles:
    """The key figures of a run, side by side."""

    tiles: Sequence[Tile]
    title: str = ""


@dataclass(frozen=True)
class Column[R]:
    """A column of a table.

    Attributes
    ----------
    label, unit : heading
    value : what a row has there: a number, a text, a `Verdict`, or None
    decimals : digits after the point of its numbers; None shows the values as text
    group : heading above neighbouring columns that share it
    best : "low" or "high" prints the best value of the valid rows bold; "" none
    """

    label: str
    value: Callable[[R], Any]
    unit: str = ""
    decimals: int | None = None
    group: str = ""
    best: str = ""

    def shown(self, row: R) -> str:
        """Text of a row's value."""
        return format_value(self.value(row), self.decimals)

    @property
    def name(self) -> str:
        """Heading in one line, without the unit."""
        return f"{self.group} {self.label}".strip()


@dataclass(frozen=True)
class Table[R]:
    """Rows under columns; one that is not `valid` is greyed and never the best. `caption` is a smaller heading."""

    title: str
    columns: Sequence[Column[R]]
    rows: Sequence[R]
    note: str = ""
    valid: Callable[[R], bool] = lambda _: True
    caption: str = ""

    def is_best(self, column: Column[R], row: R) -> bool:
        """Whether a row's value is the best of a column that has one."""
        if not column.best or not self.valid(row):
            return False
        values = [value for other in self.rows if self.valid(other) and _is_number(value := column.value(other))]
        if len(values) < 2 or min(values) == max(values):
            return False
        return bool(column.value(row) == (min(values) if column.best == "low" else max(values)))

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the columns with the number of columns each spans; empty without any."""
        if not any(column.group for column in self.columns):
            return []
        spans = [list(found) for _, found in itertools.groupby(self.columns, lambda column: column.group or id(column))]
        return [(found[0].group, len(found)) for found in spans]


@dataclass(frozen=True)
class Series:
    """A line of a chart: values over the chart's time (NaN: a gap), in palette colour 0..7.

    A `wide` line still shows under a thin one that runs over it.
    """

    name: str
    values: ArrayLike
    colour: int = 0
    dashed: bool = False
    step: bool = False
    wide: bool = False


@dataclass(frozen=True)
class Panel:
    """One axis of a chart.

    Attributes
    ----------
    label, unit : of the axis
    series : its lines
    decimals : digits after the point when a value is read
    limits : values the axis always shows
    ticks : names of values, for a signal that is a choice and not a number
    references : named levels drawn across
    """

    label: str
    unit: str
    series: Sequence[Series]
    decimals: int = 2
    limits: tuple[float, float] | None = None
    ticks: Sequence[tuple[float, str]] = ()
    references: Sequence[tuple[float, str]] = ()


@dataclass(frozen=True)
class Chart:
    """Panels over one time axis, s. Time must rise."""

    title: str
    time_s: ArrayLike
    panels: Sequence[Panel]
    note: str = ""

    def data(self) -> str:
        """What the page's script draws, as JSON that may stand inside a script element."""
        if not any(panel.series for panel in self.panels):
            raise ValueError(f"chart {self.title!r} has no series")
        time = np.asarray(self.time_s, dtype=np.float64)
        panels = []
        for panel in self.panels:
            lines = []
            for series in panel.series:
                thin_time, values = thin(time, np.asarray(series.values, dtype=np.float64), CHART_POINTS)
                lines.append(vars(series) | {"values": values})
            panels.append(vars(panel) | {"series": lines})
        content = {"time": plain(thin_time, 8), "panels": plain(panels, 7)}
        return json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")


@dataclass(frozen=True)
class Picture:
    """A matplotlib figure with its caption."""

    title: str
    figure: Figure
    note: str = ""


@dataclass(frozen=True)
class Pictures:
    """Figures beside each other where there is room."""

    title: str
    pictures: Sequence[Picture]
    note: str = ""


@dataclass(frozen=True)
class Settings:
    """Names and values of what a run was made with."""

    title: str
    items: Mapping[str, Any]


Block = Text | Tiles | Table[Any] | Chart | Pictures | Settings


@dataclass(frozen=True)
class Page:
    """A whole page.

    Attributes
    ----------
    title, lead : what the page is, and the one sentence to take away
    blocks : its parts, in order
    contents_after : so many blocks are followed by a list of all headings; None: there is none
    valid : None, or whether the run it shows may be used, with `verdict` saying why
    """

    title: str
    lead: str
    blocks: Sequence[Block]
    valid: bool | None = None
    verdict: str = ""
    contents_after: int | None = None


@functools.cache
def _environment() -> Environment:
    """Templates of this package; whatever is put into them is escaped."""
    made = Environment(
        loader=PackageLoader("iwm_sim.study", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"shown": format_value, "kind": lambda block: type(block).__name__.lower(), "anchor": anchor}
    made.globals |= {"version": __version__, "svg": svg_of}
    made.tests["verdict"] = lambda value: isinstance(value, Verdict)
    return made


def render(page: Page) -> str:
    """The page as one HTML document."""
    return _environment().get_template("report.html.jinja").render(page=page).strip() + "\n"


def anchor(title: str) -> str:
    """Id of a heading."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def write_page(path: Path | str, page: Page) -> None:
    """Write the page atomically; `ConfigError` if the folder cannot be written."""
    atomic_write(path, render(page).encode())


def format_value(value: Any, decimals: int | None) -> str:
    """A value as the page shows it: "–" for what is missing, a true minus sign, yes / no for booleans."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, Verdict):
        return value.word
    if not _is_number(value):
        return str(value)
    text = f"{value:.{decimals}f}" if decimals is not None else f"{value:g}" if isinstance(value, float) else str(value)
    if float(text) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def thin(
    time: NDArray[np.float64], values: NDArray[np.float64], points: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most about `points` points that keep every peak.

    The samples are cut into equal stretches; of each, the smallest and the largest value are kept in the order in
    which they came, so that no spike gets lost, however short. Time is that of the stretch's first and middle sample,
    the same for every series cut alike.

    Parameters
    ----------
    time, values : (N,) samples; NaN values are gaps
    points : largest number of points returned; N <= points returns the input

    Returns
    -------
    (M,) time and values, M <= points.
    """
    count = len(time)
    if len(values) != count:
        raise ValueError(f"{len(values)} values for {count} times")
    if count <= points:
        return time, values
    length = -(-count // (points // 2))
    stretches = -(-count // length)
    padded = np.full(stretches * length, np.nan)
    padded[:count] = values
    blocks = padded.reshape(stretches, length)
    empty = np.isnan(blocks).all(axis=1)
    low = np.where(np.isnan(blocks), np.inf, blocks).argmin(axis=1)
    high = np.where(np.isnan(blocks), -np.inf, blocks).argmax(axis=1)
    row = np.arange(stretches)
    kept = np.stack((blocks[row, np.minimum(low, high)], blocks[row, np.maximum(low, high)]), axis=1)
    kept[empty] = np.nan
    first = row * length
    middle = np.minimum(first + length // 2, count - 1)
    return time[np.stack((first, middle), axis=1)].ravel(), kept.ravel()


def svg_of(figure: Figure, prefix: str, title: str) -> str:
    """A figure as an inline SVG element.

    Text stays text (selectable, in the page's font), `palette.COLOURS` and the ink become the page's own colours, and
    every id gets `prefix`, so that the definitions of two figures on one page do not mix.
    """
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, count=1, flags=re.DOTALL)
    text = re.sub(r'\sid="([^"]+)"', rf' id="{prefix}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', text)
    text = re.sub(r"font:[^;\"]*'[^;\"]*", lambda match: _page_font(match.group(0)), text)
    for index, colour in enumerate(COLOURS):
        text = text.replace(colour, f"var(--c{index})")
    text = text.replace(INK, "var(--ink)")
    # Width and height in points would fix the size; the view box alone lets the page decide.
    text = re.sub(r'<svg([^>]*?)\swidth="[^"]*"', r"<svg\1", text, count=1)
    text = re.sub(r'<svg([^>]*?)\sheight="[^"]*"', r"<svg\1", text, count=1)
    return text.replace("<svg", f'<svg role="img" aria-label="{html.escape(title)}"', 1)


def _page_font(font: str) -> str:
    size = re.search(r"([\d.]+)px", font)
    return f"font: {size.group(1) if size else '10'}px system-ui, sans-serif"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool | np.bool_)
