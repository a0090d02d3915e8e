"""Watches the loop itself: does it still do what was predicted of the parameters in force?

Evidence counts only while the reference rests and the loop had time to settle, since the last step of the reference and
since the last change of parameters. Samples are taken together in slots of 10 ms: the mean error of a slot keeps what
the loop does and little of the sensor's noise, the sums of squares keep everything.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, sqrt
from operator import mul, sub

from servotwin.edge.turns import Turns
from servotwin.edge.verdict import Verdict
from servotwin.errors import InvalidInput
from servotwin.messages import Band, Cause


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """What counts as evidence.

    Parameters
    ----------
    slot_s : float
        Samples that are looked at together.
    window_s : float
        Length of the sliding window for energies.
    settling_s : float
        Until the loop is settled, where no band says so.
    margin : float
        The loop may leave the predicted band by this factor.
    persist_s : float
        How long the error itself must be outside.
    error_floor, effort_floor : float
        m and V: what is smaller is no evidence, whatever the band says; above the sensor's noise in a slot.
    swings : int
        Turns of the error, one up, one down, that make a limit cycle.
    similarity : float
        Factor by which a swing may be smaller than one before it, and half a period longer or shorter than another.
    """

    slot_s: float = 0.01
    window_s: float = 2.0
    settling_s: float = 3.0
    margin: float = 1.25
    persist_s: float = 0.05
    error_floor: float = 1e-5
    effort_floor: float = 0.02
    swings: int = 6
    similarity: float = 1.3

    def __post_init__(self) -> None:
        for name in ("slot_s", "window_s", "persist_s", "error_floor", "effort_floor"):
            if not 0.0 < getattr(self, name) < inf:
                raise InvalidInput(f"watch {name} = {getattr(self, name)!r}: must be finite and greater than 0")
        if not 0.0 <= self.settling_s < inf:
            raise InvalidInput(f"watch settling_s = {self.settling_s!r} s: must be finite and at least 0")
        for name in ("margin", "similarity"):
            if not 1.0 <= getattr(self, name) < inf:
                raise InvalidInput(f"watch {name} = {getattr(self, name)!r}: must be finite and at least 1")
        if self.swings < 2:
            raise InvalidInput(f"watch swings = {self.swings!r}: must be at least 2")


class Watch:
    """Takes samples, gives verdicts.

    Parameters
    ----------
    settings : WatchSettings
    rate : float
        Samples per second.
    reference : float
        Before the first sample, m.
    band : Band, optional
        Predicted of the parameters in force at the start.
    """

    def __init__(self, settings: WatchSettings, rate: float, reference: float = 0.0, band: Band | None = None) -> None:
        self.settings, self.rate = settings, rate
        self.slot = max(1, round(settings.slot_s * rate))
        self._reference = reference
        self._settled = 0
        self.restart(band, 0)

    @property
    def proven(self) -> bool:
        """Whether the parameters in force did for a whole window what was predicted of them."""
        return len(self._squares) == self._squares.maxlen

    def restart(self, band: Band | None, sample: int) -> None:
        """Other parameters from a sample on: what was seen so far says nothing about them."""
        self._band = band
        self._floor = max(self.settings.error_floor, 0.0 if band is None else sqrt(2.0) * band.error_rms)
        self._unsettle(sample)

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
            if self._counts(first + start, reference[part]):
                verdict = self._add(errors[part], voltage[part])
                found = found or verdict
        return found or self._energies()

    def _counts(self, sample: int, reference: Sequence[float]) -> bool:
        """Whether the reference rests and the loop is settled during a slot."""
        if min(reference) != max(reference) or reference[0] != self._reference:
            self._reference = reference[-1]
            self._unsettle(sample + len(reference))
        return sample >= self._settled

    def _unsettle(self, sample: int) -> None:
        settling = self.settings.settling_s if self._band is None else self._band.settling
        self._settled = sample + round(settling * self.rate)
        window = max(1, round(self.settings.window_s * self.rate / self.slot))
        self._squares: deque[float] = deque(maxlen=window)
        self._efforts: deque[float] = deque(maxlen=window)
        self._turns = Turns(self._floor, self.settings.swings)
        self._outside = 0

    def _add(self, errors: Sequence[float], voltage: Sequence[float]) -> Verdict | None:
        """One more slot."""
        mean = sum(errors) / len(errors)
        if not isfinite(mean):
            return None
        self._squares.append(sum(map(mul, errors, errors)) / len(errors))
        self._efforts.append(sum(map(mul, voltage, voltage)) / len(voltage))
        if self._turns.add(mean):
            amplitude = self._turns.sustained(self._floor, self.settings.similarity)
            if amplitude is not None:
                return Verdict(Cause.LIMIT_CYCLE, amplitude, self._floor)
        return self._error(abs(mean))

    def _error(self, size: float) -> Verdict | None:
        """Outside the band for too long?"""
        if self._band is None:
            return None
        allowed = max(self.settings.margin * self._band.error, self.settings.error_floor)
        self._outside = self._outside + 1 if size > allowed else 0
        long = self._outside * self.slot >= self.settings.persist_s * self.rate
        return Verdict(Cause.ERROR, size, allowed) if long else None

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
