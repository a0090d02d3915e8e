"""Chart over time as SVG from a template: where a page is made by a service that draws nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

from servotwin.report.theme import SHADES
from servotwin.runtime.templates import render

BLUE, ORANGE, GREEN, RED = (SHADES[name].light for name in ("blue", "orange", "green", "red"))
_LETTER = 7.0
"""Width of a letter of the axes' words, at most."""
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 760.0, 300.0, 62.0, 12.0, 26.0, 46.0
_STEPS_S = (1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 21600, 43200, 86400, 172800, 604800, 2592000, 7776000)
_DAY = 86400.0
Values = Sequence[float | None]


class ChartLine(NamedTuple):
    """A line; None interrupts it. `dots`: points instead of a line; `dash`: as in SVG."""

    name: str
    color: str
    values: Values
    dots: bool = False
    dash: str = ""


class ChartMark(NamedTuple):
    """A vertical line at a time, with a word."""

    time: float
    word: str
    color: str = ORANGE


@dataclass(frozen=True)
class TimeChart:
    """Values over time.

    Attributes
    ----------
    label : str
        Of the upright axis, with the unit.
    time : sequence of float
        s since the epoch, ascending.
    lines : sequence of ChartLine
    band : (sequence, sequence) or None
        Low and high end of an interval.
    marks : sequence of ChartMark
    """

    label: str
    time: Sequence[float]
    lines: Sequence[ChartLine]
    band: tuple[Values, Values] | None = None
    marks: Sequence[ChartMark] = ()

    def svg(self) -> bytes:
        """Draw it."""
        x, y = self._scales()
        text = render(
            "time_chart.svg",
            width=f"{_WIDTH:g}",
            height=f"{_HEIGHT:g}",
            grid=list(_grid(x, y)),
            grid_color=SHADES["line"].light,
            labels=list(_labels(x, y)),
            label=self.label,
            middle=f"{(_TOP + _HEIGHT - _BOTTOM) / 2:g}",
            band=self._band_path(x, y),
            band_color=BLUE,
            marks=list(self._drawn_marks(x)),
            lines=[self._drawn(line, x, y) for line in self.lines],
            legend=list(self._legend()),
        )
        return text.encode()

    def _scales(self) -> tuple[_Scale, _Scale]:
        times = [*self.time, *(mark.time for mark in self.marks)] or [0.0]
        values = [value for line in self.lines for value in line.values if value is not None] or [0.0]
        top = max(values)
        # An interval that is far wider than what is known would hide it.
        if self.band is not None:
            top = max([top, *(min(value, 2.0 * top) for value in self.band[1] if value is not None)])
        low = min([0.0, *values])
        x = _Scale(min(times), max(times), _LEFT, _WIDTH - _RIGHT)
        return x, _Scale(low, low + 1.08 * (top - low), _HEIGHT - _BOTTOM, _TOP)

    def _band_path(self, x: _Scale, y: _Scale) -> str:
        if self.band is None:
            return ""
        known = [
            (time, low, min(high, y.high))
            for time, low, high in zip(self.time, *self.band, strict=True)
            if low is not None and high is not None
        ]
        there = [f"{x(time):.1f} {y(high):.1f}" for time, _, high in known]
        back = [f"{x(time):.1f} {y(min(low, y.high)):.1f}" for time, low, _ in reversed(known)]
        return f"M{'L'.join([*there, *back])}Z" if known else ""

    def _drawn_marks(self, x: _Scale) -> Iterator[dict[str, Any]]:
        """Lines with their words; words that would overlap are left out."""
        free = -math.inf
        for mark in sorted(self.marks):
            place, word = x(mark.time), None
            if place > free:
                inside = place + 8.0 * len(mark.word) < _WIDTH
                where, anchor = (place + 3, "start") if inside else (place - 3, "end")
                word = (mark.word, where, _TOP + 11, anchor, mark.color)
                free = place + 8.0 * len(mark.word)
            yield {"path": f"M{place:.1f} {_TOP:g}V{_HEIGHT - _BOTTOM:g}", "color": mark.color, "word": word}

    def _drawn(self, line: ChartLine, x: _Scale, y: _Scale) -> dict[str, Any]:
        known = [(x(time), y(value)) for time, value in zip(self.time, line.values, strict=True) if value is not None]
        path = "" if line.dots or not known else "M" + "L".join(f"{across:.1f} {up:.1f}" for across, up in known)
        return {"color": line.color, "dots": known if line.dots else [], "path": path, "dash": line.dash}

    def _legend(self) -> Iterator[dict[str, Any]]:
        names = [(line.name, line.color, 1.0) for line in self.lines if line.name]
        names += [("95 % interval", BLUE, 0.4)] if self.band is not None else []
        place = _LEFT
        for name, color, opacity in names:
            yield {"x": place, "name": name, "color": color, "opacity": opacity}
            place += 34 + 7.0 * len(name)


class _Scale(NamedTuple):
    """Maps low to high to places on the screen."""

    low: float
    high: float
    begin: float
    end: float

    def __call__(self, value: float) -> float:
        spread = self.high - self.low
        return self.begin + (self.end - self.begin) * ((value - self.low) / spread if spread else 0.5)


def _ticks(low: float, high: float) -> list[float]:
    spread = high - low
    if not spread > 0.0:
        return [low]
    power = 10.0 ** math.floor(math.log10(spread / 5.0))
    step = next(each * power for each in (1, 2, 5, 10) if each * power >= spread / 5.0 * (1.0 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def _time_ticks(low: float, high: float) -> list[float]:
    step = next((each for each in _STEPS_S if each >= (high - low) / 8.0), math.ceil((high - low) / 8.0))
    return [float(k * step) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _time_text(time: float, span: float) -> str:
    form = (
        "%Y-%m-%d" if span > 6.0 * _DAY else "%m-%d %H:%M" if span > _DAY else "%H:%M" if span > 600.0 else "%H:%M:%S"
    )
    return datetime.fromtimestamp(time, UTC).strftime(form)


def _grid(x: _Scale, y: _Scale) -> Iterator[str]:
    for value in _ticks(y.low, y.high):
        yield f"M{_LEFT:g} {y(value):.1f}H{_WIDTH - _RIGHT:g}"
    for time in _time_ticks(x.low, x.high):
        yield f"M{x(time):.1f} {_TOP:g}V{_HEIGHT - _BOTTOM:g}"


def _labels(x: _Scale, y: _Scale) -> Iterator[tuple[str, float, float, str]]:
    """Words at the axes: text, place, and which end of it is there."""
    for value in _ticks(y.low, y.high):
        yield f"{value:.6g}", _LEFT - 6, y(value) + 4, "end"
    for time in _time_ticks(x.low, x.high):
        word = _time_text(time, x.high - x.low)
        place, low = x(time), _HEIGHT - _BOTTOM + 16
        cut = place + 0.5 * _LETTER * len(word) > _WIDTH
        yield (word, _WIDTH - 2, low, "end") if cut else (word, place, low, "middle")
    begin = datetime.fromtimestamp(x.low, UTC).strftime("%Y-%m-%d %H:%M")
    yield f"Time, UTC (from {begin})", (_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 8, "middle"
