"""Watch of the control loop: it compares the loop with the prediction for the parameters in force.

The error is watched at all times: while the loop follows a move of its reference, the error may be a little larger than
that move; otherwise it must stay within the band. Limit cycles and energies count as evidence only while the reference
rests and the loop had time to settle since the last move and the last change of parameters. Until then new parameters
are compared with the certified band, afterwards with the predicted one. Samples are grouped in slots of 10 ms: the mean
error of a slot has the loop's motion and little of the sensor's noise; the sums of squares have both.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from math import isfinite, sqrt
from operator import mul, sub
from typing import Annotated, NamedTuple

from servotwin.config.keys import check, key, settings
from servotwin.messages import Band, Cause


class Violation(NamedTuple):
    """Evidence against the parameters in force: m, V or s, as the cause says."""

    cause: Cause
    measured: float
    allowed: float


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
        float,
        key(
            "effort_floor_v",
            above=0.0,
            infinite=True,
            help="A smaller voltage is no evidence, whatever the band says; inf: none is, as of a stepper, whose "
            "command is its position.",
        ),
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
    """Compares samples with the predicted and the certified band.

    Parameters
    ----------
    settings : WatchSettings
    rate : float
        Samples per second.
    reference : float
        Reference before the first sample, m.
    certified : Band, optional
        Band within which the loop must stay at all times, whatever the prediction is.
    """

    def __init__(
        self, settings: WatchSettings, rate: float, reference: float = 0.0, certified: Band | None = None
    ) -> None:
        self.settings, self.rate = settings, rate
        self.slot = max(1, round(settings.slot_s * rate))
        self._certified = certified
        self._reference: float | None = None
        self._before = reference
        self._moves = ReferenceMoves()
        self.restart(None, 0)

    @property
    def verified(self) -> bool:
        """True where the loop kept the predicted band for a full window under the parameters in force."""
        return len(self._squares) == self._squares.maxlen

    def restart(self, predicted: Band | None, sample: int) -> None:
        """Begin anew with other parameters, in force from a sample on."""
        self._band = _effective_band(predicted, self._certified)
        # A sine has sqrt(2) times its root mean square as amplitude: smaller swings are inside the band.
        self._floor = max(self.settings.error_floor, 0.0 if self._band is None else sqrt(2.0) * self._band.error_rms)
        self._verify_from = sample + self._settling
        self._outside = 0
        self._clear()

    def update(
        self, first: int, reference: Sequence[float], position: Sequence[float], voltage: Sequence[float]
    ) -> Violation | None:
        """Take whole slots of samples, the first of them number `first`; return a violation, if any.

        Parameters
        ----------
        reference, position, voltage : sequence of float
            m, m, V; equally long.
        """
        errors = list(map(sub, reference, position))
        first_violation: Violation | None = None
        for start in range(0, len(errors), self.slot):
            part = slice(start, start + self.slot)
            violation = self._update_slot(first + start, reference[part], errors[part], voltage[part])
            # All slots are taken even after a violation: the result must not depend on the length of the blocks.
            first_violation = first_violation or violation
        return first_violation or self._check_energies()

    @property
    def _settling(self) -> int:
        """Settling time in samples."""
        return round((self.settings.settling_s if self._band is None else self._band.settling) * self.rate)

    def _update_slot(
        self, sample: int, reference: Sequence[float], errors: Sequence[float], voltage: Sequence[float]
    ) -> Violation | None:
        """Take one more slot, the first sample of which has number `sample`."""
        mean = sum(errors) / len(errors)
        # Samples that are not finite say nothing about the loop.
        if not isfinite(mean):
            return None
        self._note_moves(sample, reference, abs(errors[0]))
        if self._moves:
            self._clear()
        violation = self._check_error(sample, abs(mean))
        if violation is not None or self._moves or sample < self._verify_from:
            return violation
        self._squares.append(sum(map(mul, errors, errors)) / len(errors))
        self._efforts.append(sum(map(mul, voltage, voltage)) / len(voltage))
        return self._check_cycle(mean)

    def _note_moves(self, sample: int, reference: Sequence[float], size: float) -> None:
        """Note moves of the reference; the first error counts as a step."""
        until = sample + len(reference) + self._settling
        if self._reference is None:
            self._reference = self._before
            self._moves.add(until, reference[0] - size, reference[0])
        low, high = min(reference), max(reference)
        if low != high or low != self._reference:
            self._moves.add(until, min(low, self._reference), max(high, self._reference))
            self._reference = reference[-1]
        self._moves.expire(sample)

    def _clear(self) -> None:
        window = max(1, round(self.settings.window_s * self.rate / self.slot))
        self._squares: deque[float] = deque(maxlen=window)
        self._efforts: deque[float] = deque(maxlen=window)
        self._turns = TurningPoints(self._floor, self.settings.swings)

    def _check_error(self, sample: int, size: float) -> Violation | None:
        """Compare the error with the band and the reference's moves; it may exceed them for `persist_s`."""
        band = self._certified if sample < self._verify_from else self._band
        if band is None:
            return None
        allowed = max(self.settings.margin * band.error, self.settings.error_floor)
        if self._moves:
            allowed += self.settings.overshoot * self._moves.travel
        self._outside = self._outside + 1 if size > allowed else 0
        long = self._outside * self.slot >= self.settings.persist_s * self.rate
        return Violation(Cause.ERROR, size, allowed) if long else None

    def _check_cycle(self, mean: float) -> Violation | None:
        """Check for a sustained oscillation."""
        if not self._turns.add(mean):
            return None
        amplitude = self._turns.sustained(self._floor, self.settings.similarity)
        return None if amplitude is None else Violation(Cause.LIMIT_CYCLE, amplitude, self._floor)

    def _check_energies(self) -> Violation | None:
        """Compare error and effort over a whole window with the prediction."""
        if self._band is None or not self.verified:
            return None
        kinds = (
            (Cause.ERROR_ENERGY, self._squares, self._band.error_rms, self.settings.error_floor),
            (Cause.EFFORT, self._efforts, self._band.effort, self.settings.effort_floor),
        )
        for cause, squares, predicted, floor in kinds:
            measured, allowed = sqrt(sum(squares) / len(squares)), max(self.settings.margin * predicted, floor)
            if measured > allowed:
                return Violation(cause, measured, allowed)
        return None


def _effective_band(predicted: Band | None, certified: Band | None) -> Band | None:
    """Combine the bands: error and settling at least as tight as certified, effort as predicted.

    A predicted error below the certified one counts only where the predicted settling is not slower than the certified.
    """
    if predicted is None or certified is None:
        return predicted or certified
    if predicted.settling > certified.settling:
        return Band(certified.error, certified.error_rms, predicted.effort, certified.settling)
    return Band(
        min(predicted.error, certified.error),
        min(predicted.error_rms, certified.error_rms),
        predicted.effort,
        predicted.settling,
    )


class _Extreme(NamedTuple):
    """A value (m), and the sample until which it counts."""

    until: int
    value: float


class ReferenceMoves:
    """Moves of the reference that the loop may still follow; they end in the order in which they were made."""

    def __init__(self) -> None:
        self._until = 0
        # Monotonic queues: an extreme that a later, more extreme one outlives is dropped, so the ends are the extremes.
        self._lows: deque[_Extreme] = deque()
        self._highs: deque[_Extreme] = deque()

    def __bool__(self) -> bool:
        """True while the loop may still follow a move."""
        return bool(self._lows)

    @property
    def travel(self) -> float:
        """Distance from the lowest to the highest reference, m; only while there is a move."""
        return self._highs[0].value - self._lows[0].value

    def add(self, until: int, low: float, high: float) -> None:
        """Add a move between two references (m), which is followed until a sample."""
        self._until = max(until, self._until) if self else until
        while self._lows and self._lows[-1].value >= low:
            self._lows.pop()
        while self._highs and self._highs[-1].value <= high:
            self._highs.pop()
        self._lows.append(_Extreme(self._until, low))
        self._highs.append(_Extreme(self._until, high))

    def expire(self, sample: int) -> None:
        """Remove the moves that are over at a sample."""
        for extremes in (self._lows, self._highs):
            while extremes and extremes[0].until <= sample:
                extremes.popleft()


class TurningPoints:
    """Turning points of a signal: an extreme counts once the signal has come back from it by more than `reversal`.

    Parameters
    ----------
    reversal : float
        In the signal's unit.
    swings : int
        Number of last swings, from turn to turn, that are stored.
    """

    def __init__(self, reversal: float, swings: int) -> None:
        self._reversal, self._swings = reversal, swings
        self._points: deque[tuple[int, float]] = deque(maxlen=swings + 1)
        self._turns = 0
        self._place, self._direction = 0, 1.0
        self._extreme: tuple[int, float] | None = None

    def add(self, value: float) -> bool:
        """Take the next value; True where it confirms a turn."""
        self._place += 1
        if self._extreme is None or self._direction * (value - self._extreme[1]) >= 0.0:
            self._extreme = self._place, value
            return False
        if abs(value - self._extreme[1]) <= self._reversal:
            return False
        self._points.append(self._extreme)
        self._turns += 1
        self._direction, self._extreme = -self._direction, (self._place, value)
        return True

    def sustained(self, smallest: float, similarity: float) -> float | None:
        """Return the amplitude (half of the last swing) of an oscillation that does not die out; None: there is none.

        Parameters
        ----------
        smallest : float
            Amplitude that every swing reaches.
        similarity : float
            Factor by which a swing may be smaller than one before it, and half a period differ from another.
        """
        if self._turns < self._swings + 2:  # the first point is where the record began, no turn
            return None
        pairs = list(pairwise(self._points))
        sizes = [abs(after[1] - before[1]) for before, after in pairs]
        times = [after[0] - before[0] for before, after in pairs]
        lasting = all(size * similarity >= largest for size, largest in zip(sizes, accumulate(sizes, max), strict=True))
        regular = max(times) <= similarity * min(times)
        return 0.5 * sizes[-1] if lasting and regular and min(sizes) >= 2.0 * smallest else None
