"""Settings of the novelty filter: rules, and the structure's response at the sample rate."""

from dataclasses import dataclass
from importlib.util import find_spec
from math import inf, isfinite, radians
from typing import NamedTuple

from servotwin.edge.window_filter import WindowFilter
from servotwin.errors import InvalidInput

_NUMERIC = "numpy", "scipy", "numba"


class ResponseMode(NamedTuple):
    """Pole of the structure (one of a conjugate pair): exp(pole T), and the gain that reads the position off its state.

    The position is the real part of gain times state.
    """

    decay: complex
    gain: complex


@dataclass(frozen=True, slots=True)
class NoveltyModel:
    """Response of the structure, screw angle to position of the last mass, at one sample rate.

    Parameters
    ----------
    rate : float
        Hz.
    modes : tuple of ResponseMode
    direct, static_gain : float
        m/rad: position over angle at once, and at rest.
    unseen : float
        s: what the screw does so late in a window has not reached the last mass.
    factor : int
        Samples per sample that is judged.
    """

    rate: float
    modes: tuple[ResponseMode, ...]
    direct: float
    static_gain: float
    unseen: float
    factor: int = 1

    def __post_init__(self) -> None:
        numbers = [part for mode in self.modes for value in mode for part in (value.real, value.imag)]
        if not all(map(isfinite, (*numbers, self.direct, self.static_gain))):
            raise InvalidInput("novelty model: modes and gains must be finite")
        if not self.modes or max(abs(mode.decay) for mode in self.modes) >= 1.0:
            raise InvalidInput("novelty model: needs modes, all of which decay")
        if not (isfinite(self.rate) and self.rate > 0.0):
            raise InvalidInput(f"novelty model sample rate = {self.rate!r} Hz: must be greater than 0")
        if self.static_gain == 0.0:
            raise InvalidInput("novelty model static gain = 0 m/rad: must be another number")
        if not 0.0 <= self.unseen < 1e6:
            raise InvalidInput(f"novelty model unseen = {self.unseen!r} s: must be at least 0")
        if self.factor < 1:
            raise InvalidInput(f"novelty model decimation = {self.factor!r} samples: must be at least 1")


@dataclass(frozen=True, slots=True)
class NoveltyRules:
    """What counts as news.

    Parameters
    ----------
    resolution : float
        rad: no window is taken to be surer of the gap than that, so that far smaller changes are no news.
    worth : float
        rad: however sure it is, a change since the twin was last told that is smaller is not sent.
    score_limit : float
        Standard deviations from the baseline at which one window is news by itself.
    allowance, cusum_limit : float
        Standard deviations: what the cumulative sum lets pass in each window, and from which sum on it is news.
    margin : float
        rad: by how much, or by `worth` if that is more, the lost motion at rest may exceed what the twin knows of.
    travel : float
        rad: how far the screw must be pushed, both ways, for a window to say something.
    settle : float
        rad: how far the baseline may move with an update that stands on a window which was not looked at.
    relearn : int
        Windows that the baseline counts as at most after an accepted update.
    learn : int
        Windows that say something and are sent after each start, whatever they say.
    outlier : float
        rad: a change beyond may be an outlier to the twin, which takes none for granted until another window agrees.
    confirm : int
        Windows sent after such a change, whatever they say.
    patience : int
        Windows in a row that say nothing and are sent nevertheless, while some are still to be sent: the twin may ask
        for ones that tell more.
    period_s : float
        s: one is sent at least so often.
    look_s : float
        s: where the reference does not change for so long, a window is cut and looked at; inf: never.
    """

    resolution: float = radians(0.005)
    worth: float = 0.0
    score_limit: float = 4.5
    allowance: float = 0.5
    cusum_limit: float = 8.0
    margin: float = radians(0.25)
    travel: float = radians(0.5)
    settle: float = radians(0.2)
    relearn: int = 5
    learn: int = 2
    outlier: float = radians(1.0)
    confirm: int = 1
    patience: int = 4
    period_s: float = 600.0
    look_s: float = 60.0

    def __post_init__(self) -> None:
        for key in (
            "resolution",
            "score_limit",
            "cusum_limit",
            "margin",
            "travel",
            "settle",
            "outlier",
            "period_s",
            "look_s",
        ):
            value = getattr(self, key)
            if not value > 0.0 or (value == inf and key in ("resolution", "travel", "settle")):
                raise InvalidInput(f"novelty {key} = {value!r}: must be greater than 0")
        for key in ("allowance", "worth"):
            if not 0.0 <= getattr(self, key) < inf:
                raise InvalidInput(f"novelty {key} = {getattr(self, key)!r}: must be finite and at least 0")
        for key in ("relearn", "learn", "confirm", "patience"):
            if getattr(self, key) < 0:
                raise InvalidInput(f"novelty {key} = {getattr(self, key)!r} windows: must be at least 0")


@dataclass(frozen=True, slots=True)
class NoveltySettings:
    """Model and rules.

    Parameters
    ----------
    model : NoveltyModel
    rules : NoveltyRules
    gap : float
        rad: total gap to begin at.
    """

    model: NoveltyModel
    rules: NoveltyRules = NoveltyRules()
    gap: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.gap < inf:
            raise InvalidInput(f"novelty gap = {self.gap!r} rad: must be finite and at least 0")

    @property
    def longest_pause_s(self) -> float:
        """Time after a window at which one is cut though the reference rests, s."""
        return self.rules.look_s

    def check(self, sample_rate: float) -> None:
        """Raise InvalidInput where the model is for another rate (Hz), or a numerical library is not installed."""
        missing = [name for name in _NUMERIC if find_spec(name) is None]
        if missing:
            raise InvalidInput(
                f"[novelty] needs {', '.join(missing)}: install servotwin with its dependencies, or leave the table out"
            )
        if self.model.rate != sample_rate:
            rates = f"{self.model.rate!r} Hz for samples at {sample_rate!r} Hz"
            raise InvalidInput(f"agent novelty model = {rates}: must be equal")

    def start(self, saved: bytes | None = None) -> WindowFilter:
        """Start the filter for a new boot.

        Raises
        ------
        InvalidInput
            `saved` is not a state of this filter.
        """
        from servotwin.novelty.detector import NoveltyDetector, loads

        return NoveltyDetector(self, None if saved is None else loads(saved))
