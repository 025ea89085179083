"""Line charts as inline SVG.

Written by hand rather than with matplotlib: a page of twenty plots takes milliseconds instead of seconds,
which a report that may cost 5 % of a short run needs, and its letters are the page's own.
"""

import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

WIDTH, HEIGHT = 360, 300
LEFT, TOP, RIGHT, BOTTOM = 46, 12, 350, 254
INK, GREY, PALE = "#1d2733", "#5f6b78", "#d9dee4"


class Chart:
    """Two axes with ticks, and what is drawn between them, in units of the data.

    Lines end at the frame; nan interrupts them.
    """

    def __init__(self, x_ticks: Sequence[float], y_ticks: Sequence[float], x_label: str, y_label: str) -> None:
        self._x, self._y = (x_ticks[0], x_ticks[-1]), (y_ticks[0], y_ticks[-1])
        self._drawn: list[str] = []
        self._frame = [
            *(
                text(f"{tick:g}", LEFT - 6, self._place_y(tick) + 4, anchor="end", colour=GREY)
                + f'<path d="M{LEFT} {self._place_y(tick):.1f}H{RIGHT}" stroke="{PALE}"/>'
                for tick in y_ticks
            ),
            *(
                text(f"{tick:g}".replace("-", "−"), self._place_x(tick), BOTTOM + 16, anchor="middle", colour=GREY)
                + f'<path d="M{self._place_x(tick):.1f} {BOTTOM}v4" stroke="{GREY}"/>'
                for tick in x_ticks
            ),
            f'<path d="M{LEFT} {BOTTOM}H{RIGHT}" stroke="{GREY}"/>',
            text(x_label, (LEFT + RIGHT) / 2, HEIGHT - 10, anchor="middle"),
            f'<g transform="translate(12 {(TOP + BOTTOM) / 2}) rotate(-90)">'
            + text(y_label, 0, 0, anchor="middle")
            + "</g>",
        ]

    def line(self, x: ArrayLike, y: ArrayLike, colour: str, *, dash: str = "", width: float = 2.2) -> None:
        """A line through points (n,); `dash` as in SVG's stroke-dasharray."""
        xs, ys = self._places_x(x), self._places_y(y)
        inside = np.isfinite(ys)
        runs = np.split(np.flatnonzero(inside), np.flatnonzero(np.diff(np.flatnonzero(inside)) > 1) + 1)
        path = "".join(polyline(xs[run], ys[run]) for run in runs if run.size > 1)
        self._drawn.append(f'<path d="{path}" {stroke(colour, width, dash)}/>')

    def bars(self, edges: ArrayLike, heights: ArrayLike) -> None:
        """Grey steps between edges (n + 1,), of heights (n,)."""
        xs, ys = np.repeat(self._places_x(edges), 2)[1:-1], np.repeat(self._places_y(heights), 2)
        outline = f"{polyline(xs, ys)}V{BOTTOM - TOP}H{xs[0]:.1f}Z"
        self._drawn.append(f'<path d="{outline}" fill="{PALE}"/>')

    def span(self, low: float, high: float) -> None:
        """A grey range of x."""
        left, right = self._places_x([low, high])
        box = f'x="{left:.1f}" width="{right - left:.1f}" height="{BOTTOM - TOP}"'
        self._drawn.append(f'<rect {box} fill="{PALE}" opacity=".6"/>')

    def upright(self, x: float) -> None:
        """A thin line from bottom to top."""
        place = self._places_x(x)
        self._drawn.append(f'<path d="M{place:.1f} 0V{BOTTOM - TOP}" {stroke(GREY, 1, "2 3")}/>')

    def svg(self, description: str) -> str:
        """The drawing; `description` is for those who do not see it."""
        inner_width, inner_height = RIGHT - LEFT, BOTTOM - TOP
        box = f'x="{LEFT}" y="{TOP}" width="{inner_width}" height="{inner_height}"'
        clipped = f'<svg {box} viewBox="0 0 {inner_width} {inner_height}">{"".join(self._drawn)}</svg>'
        return drawing((*self._frame, clipped), description)

    def _place_x(self, x: float) -> float:
        return LEFT + float(self._places_x(x))

    def _place_y(self, y: float) -> float:
        return TOP + float(self._places_y(y))

    def _places_x(self, x: ArrayLike) -> Array:
        low, high = self._x
        return (np.asarray(x, dtype=float) - low) / (high - low) * (RIGHT - LEFT)

    def _places_y(self, y: ArrayLike) -> Array:
        low, high = self._y
        return (high - np.asarray(y, dtype=float)) / (high - low) * (BOTTOM - TOP)


def drawing(parts: Iterable[str], description: str, height: float = HEIGHT) -> str:
    """A whole SVG of the charts' width."""
    return (
        f'<svg class="plot" viewBox="0 0 {WIDTH} {height:g}" role="img" aria-label="{escape(description)}">'
        f"{''.join(parts)}</svg>"
    )


def polyline(x: Array, y: Array) -> str:
    """Path data through points (n,)."""
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def stroke(colour: str, width: float, dash: str = "") -> str:
    """Attributes of a line."""
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return f'fill="none" stroke="{colour}" stroke-width="{width:g}" stroke-linejoin="round"{dashes}'


def text(words: str, x: float, y: float, *, anchor: str = "start", colour: str = INK, halo: bool = False) -> str:
    """One line of letters; `halo` keeps it legible over lines."""
    behind = ' paint-order="stroke" stroke="#fff" stroke-width="4" stroke-linejoin="round"' if halo else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}"{behind}>{escape(words)}</text>'


def nice_ticks(highest: float, most: int = 6) -> list[float]:
    """Round numbers from 0 to at least `highest`, in at most so many steps; for 0 < highest <= 60 most."""
    step = next(step for step in (5, 10, 20, 25, 30, 40, 50, 60) if highest <= step * most)
    return [step * place for place in range(math.ceil(highest / step) + 1)]
