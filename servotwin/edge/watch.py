"""Watches the loop itself: does it still do what was predicted of the parameters in force?

The error is watched at all times: while the loop may still follow its reference it may be as large as the reference
moved and a little more, otherwise it stays within the band. Cycles and energies are evidence only while the reference
rests and the loop had time to settle, since the last step of the reference and since the last change of parameters; in
that time new parameters are held to what is certified, then to what is predicted of them. Samples are taken together in
slots of 10 ms: the mean error of a slot keeps what the loop does and little of the sensor's noise, the sums of squares
keep everything.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, sqrt
from operator import mul, sub
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.edge.moves import Moves
from servotwin.edge.turns import Turns
from servotwin.edge.verdict import Verdict, judged_by
from servotwin.messages import Band, Cause


@settings("watch")
@dataclass(frozen=True, slots=True)
class WatchSettings:
    """Thresholds of the evidence against the parameters in force."""

    slot_s: Annotated[float, key(above=0.0, help="Length of a slot, in which samples are taken together.")] = 0.01
    window_s: Annotated[float, key(above=0.0, help="Length of the sliding window for energies.")] = 2.0
    settling_s: Annotated[float, key(minimum=0.0, help="Time until the loop is settled, where no band says so.")] = 3.0
    margin: Annotated[float, key(minimum=1.0, help="Factor by which the loop may leave the band.")] = 1.25
    overshoot: Annotated[
        float,
        key(
            minimum=1.0,
            help="While the loop settles the error may be larger by this multiple of the reference's travel.",
        ),
    ] = 1.3
    persist_s: Annotated[float, key(above=0.0, help="Time for which the error itself must be outside.")] = 0.05
    error_floor: Annotated[
        float,
        key(
            "error_floor_m",
            "error_floor_mm",
            above=0.0,
            help="A smaller error is no evidence, whatever the band says; above the sensor's noise in a slot.",
        ),
    ] = 1e-5
    effort_floor: Annotated[
        float, key("effort_floor_v", above=0.0, help="A smaller voltage is no evidence, whatever the band says.")
    ] = 0.02
    swings: Annotated[int, key(minimum=2, help="Turns of the error, one up, one down, that make a limit cycle.")] = 6
    similarity: Annotated[
        float,
        key(
            minimum=1.0,
            help="Factor by which a swing may be smaller than one before it, and half a period longer or shorter than "
            "another.",
        ),
    ] = 1.3

    def __post_init__(self) -> None:
        check(self)


class Watch:
    """Takes samples, gives verdicts.

    Parameters
    ----------
    settings : WatchSettings
    rate : float
        Samples per second.
    reference : float
        Before the first sample, m.
    certified : Band, optional
        What the loop has to stay within at all times, whatever is predicted.
    """

    def __init__(
        self, settings: WatchSettings, rate: float, reference: float = 0.0, certified: Band | None = None
    ) -> None:
        self.settings, self.rate = settings, rate
        self.slot = max(1, round(settings.slot_s * rate))
        self._certified = certified
        self._reference: float | None = None
        self._before = reference
        self._moves = Moves()
        self.restart(None, 0)

    @property
    def proven(self) -> bool:
        """Whether the parameters in force did for a whole window what was predicted of them."""
        return len(self._squares) == self._squares.maxlen

    def restart(self, predicted: Band | None, sample: int) -> None:
        """Other parameters from a sample on: what was seen so far says nothing about them."""
        self._band = judged_by(predicted, self._certified)
        self._floor = max(self.settings.error_floor, 0.0 if self._band is None else sqrt(2.0) * self._band.error_rms)
        self._proving = sample + self._settling
        self._outside = 0
        self._forget()

    def see(
        self, first: int, reference: Sequence[float], position: Sequence[float], voltage: Sequence[float]
    ) -> Verdict | None:
        """Take whole slots of samples, the first of them number `first`; the evidence against the parameters, if any.

        Parameters
        ----------
        reference, position, voltage : sequence of float
            m, m, V; equally long.
        """
        errors = list(map(sub, reference, position))
        found: Verdict | None = None
        for start in range(0, len(errors), self.slot):
            part = slice(start, start + self.slot)
            verdict = self._slot(first + start, reference[part], errors[part], voltage[part])
            found = found or verdict
        return found or self._energies()

    @property
    def _settling(self) -> int:
        """In samples."""
        return round((self.settings.settling_s if self._band is None else self._band.settling) * self.rate)

    def _slot(
        self, sample: int, reference: Sequence[float], errors: Sequence[float], voltage: Sequence[float]
    ) -> Verdict | None:
        """One more slot, which begins with a sample."""
        mean = sum(errors) / len(errors)
        if not isfinite(mean):
            return None
        self._note_moves(sample, reference, abs(errors[0]))
        if self._moves:
            self._forget()
        verdict = self._error(sample, abs(mean))
        if verdict is not None or self._moves or sample < self._proving:
            return verdict
        self._squares.append(sum(map(mul, errors, errors)) / len(errors))
        self._efforts.append(sum(map(mul, voltage, voltage)) / len(voltage))
        return self._cycle(mean)

    def _note_moves(self, sample: int, reference: Sequence[float], size: float) -> None:
        """Keep what the reference did while the loop may still follow it; the first error counts as a step."""
        until = sample + len(reference) + self._settling
        if self._reference is None:
            self._reference = self._before
            self._moves.add(until, reference[0] - size, reference[0])
        low, high = min(reference), max(reference)
        if low != high or low != self._reference:
            self._moves.add(until, min(low, self._reference), max(high, self._reference))
            self._reference = reference[-1]
        self._moves.expire(sample)

    def _forget(self) -> None:
        window = max(1, round(self.settings.window_s * self.rate / self.slot))
        self._squares: deque[float] = deque(maxlen=window)
        self._efforts: deque[float] = deque(maxlen=window)
        self._turns = Turns(self._floor, self.settings.swings)

    def _error(self, sample: int, size: float) -> Verdict | None:
        """Larger for too long than the band and the reference's moves allow?"""
        band = self._certified if sample < self._proving else self._band
        if band is None:
            return None
        allowed = max(self.settings.margin * band.error, self.settings.error_floor)
        if self._moves:
            allowed += self.settings.overshoot * self._moves.travel
        self._outside = self._outside + 1 if size > allowed else 0
        long = self._outside * self.slot >= self.settings.persist_s * self.rate
        return Verdict(Cause.ERROR, size, allowed) if long else None

    def _cycle(self, mean: float) -> Verdict | None:
        """An oscillation that lasts?"""
        if not self._turns.add(mean):
            return None
        amplitude = self._turns.sustained(self._floor, self.settings.similarity)
        return None if amplitude is None else Verdict(Cause.LIMIT_CYCLE, amplitude, self._floor)

    def _energies(self) -> Verdict | None:
        """More error or effort than predicted over a whole window?"""
        if self._band is None or not self.proven:
            return None
        kinds = (
            (Cause.ERROR_ENERGY, self._squares, self._band.error_rms, self.settings.error_floor),
            (Cause.EFFORT, self._efforts, self._band.effort, self.settings.effort_floor),
        )
        for cause, squares, predicted, floor in kinds:
            measured, allowed = sqrt(sum(squares) / len(squares)), max(self.settings.margin * predicted, floor)
            if measured > allowed:
                return Verdict(cause, measured, allowed)
        return None
