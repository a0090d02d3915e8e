"""Settings of the novelty filter: rules, and the structure's response at the sample rate."""

from dataclasses import dataclass
from importlib.util import find_spec
from math import isfinite, radians
from typing import Annotated, NamedTuple

from servotwin.config.keys import check, key, settings
from servotwin.config.toml import Values, values_of
from servotwin.edge.window_filter import WindowFilter
from servotwin.errors import InvalidInput

_NUMERIC = "numpy", "scipy", "numba"
_PLAIN, _OPTIONAL = ("rate", "direct", "static_gain", "unseen", "factor"), {"second": 1.0, "encoder_resolution": 0.0}


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
        s: motion of the screw so late in a window has not reached the last mass.
    factor : int
        Decimation factor of the score.
    second : float
        s, one of the servo's own (`plant.scales`).
    encoder_resolution : float
        rad, one count of the motor's encoder; 0: not known.
    """

    rate: float
    modes: tuple[ResponseMode, ...]
    direct: float
    static_gain: float
    unseen: float
    factor: int = 1
    second: float = 1.0
    encoder_resolution: float = 0.0

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
        if not (isfinite(self.second) and self.second > 0.0):
            raise InvalidInput(f"novelty model second = {self.second!r} s: must be finite and greater than 0")
        if not (isfinite(self.encoder_resolution) and self.encoder_resolution >= 0.0):
            count = f"encoder_resolution = {self.encoder_resolution!r} rad"
            raise InvalidInput(f"novelty model {count}: must be finite and at least 0")
        if self.factor < 1:
            raise InvalidInput(f"novelty model decimation = {self.factor!r} samples: must be at least 1")


def model_table(
    rate: Annotated[float, key("sample_rate_hz", above=0.0, help="Rate of the samples.")],
    decay_real: Annotated[tuple[float, ...], key(help="Real parts of exp(pole T), one per mode.")],
    decay_imag: Annotated[tuple[float, ...], key(help="Imaginary parts of them.")],
    gain_real: Annotated[tuple[float, ...], key(help="Real parts of the gains, one per mode.")],
    gain_imag: Annotated[tuple[float, ...], key(help="Imaginary parts of them.")],
    direct: Annotated[float, key("direct_m_per_rad", help="Position over angle at once.")],
    static_gain: Annotated[float, key("static_gain_m_per_rad", help="Position over angle at rest.")],
    unseen: Annotated[
        float,
        key("unseen_s", minimum=0.0, help="Motion of the screw this late in a window has not reached the last mass."),
    ],
    factor: Annotated[int, key("decimation", minimum=1, help="Decimation factor of the score.")],
    second: Annotated[
        float, key("own_second_s", above=0.0, help="The servo's own second, in which a rest lasts.")
    ] = 1.0,
    encoder_resolution: Annotated[
        float, key("encoder_resolution_rad", minimum=0.0, help="One count of the motor's encoder; 0: not known.")
    ] = 0.0,
) -> NoveltyModel:
    """Response of the structure; a program writes it."""
    if not len(decay_real) == len(decay_imag) == len(gain_real) == len(gain_imag):
        raise InvalidInput("decay_real, decay_imag, gain_real and gain_imag must have as many numbers as one another")
    decay, gain = map(complex, decay_real, decay_imag), map(complex, gain_real, gain_imag)
    modes = tuple(ResponseMode(*pair) for pair in zip(decay, gain, strict=True))
    return NoveltyModel(rate, modes, direct, static_gain, unseen, factor, second, encoder_resolution)


def _model_values(model: NoveltyModel) -> Values:
    """Keys and values that `model_table` reads as this model."""
    # Files of the version before have neither.
    changed = [name for name, usual in _OPTIONAL.items() if getattr(model, name) != usual]
    return {
        "decay_real": [mode.decay.real for mode in model.modes],
        "decay_imag": [mode.decay.imag for mode in model.modes],
        "gain_real": [mode.gain.real for mode in model.modes],
        "gain_imag": [mode.gain.imag for mode in model.modes],
        **values_of(model, model_table, only=(*_PLAIN, *changed)),
    }


@settings("novelty")
@dataclass(frozen=True, slots=True)
class NoveltyRules:
    """Rules by which a window counts as novel."""

    resolution: Annotated[
        float,
        key(
            "resolution_deg",
            "resolution_rad",
            above=0.0,
            help="Smallest standard deviation that a window's gap is assumed to have.",
        ),
    ] = radians(0.005)
    worth: Annotated[
        float,
        key(
            "worth_deg",
            "worth_rad",
            minimum=0.0,
            help="Smallest change since the last sent window for which a window is sent.",
        ),
    ] = 0.0
    score_limit: Annotated[
        float,
        key(
            above=0.0,
            infinite=True,
            help="Change from the baseline, in standard deviations, from which on one window is novel.",
        ),
    ] = 4.5
    allowance: Annotated[
        float, key(minimum=0.0, help="Allowance of the cumulative sum per window, in standard deviations.")
    ] = 0.5
    cusum_limit: Annotated[
        float,
        key(above=0.0, infinite=True, help="Cumulative sum, in standard deviations, from which on a window is novel."),
    ] = 8.0
    margin: Annotated[
        float,
        key(
            "margin_deg",
            "margin_rad",
            above=0.0,
            infinite=True,
            help="Excess of the lost motion at rest over the twin's gap that makes a window novel; at least worth_deg.",
        ),
    ] = radians(0.25)
    travel: Annotated[
        float | None,
        key(
            "travel_deg",
            "travel_rad",
            above=0.0,
            help="Smallest travel of the pushed screw, both ways, in an informative window; where absent 0.5 deg, or, "
            "where the servo states the encoder's resolution, a third of the gap and at least 100 counts, if that is "
            "less.",
        ),
    ] = None
    baseline_move: Annotated[
        float,
        key(
            "baseline_move_deg",
            "baseline_move_rad",
            above=0.0,
            help="Largest move of the baseline by an update whose window was not scored.",
        ),
    ] = radians(0.2)
    relearn: Annotated[
        int, key(minimum=0, help="Largest weight of the baseline after an accepted update, in windows.")
    ] = 5
    learn: Annotated[int, key(minimum=0, help="Number of informative windows sent after each start, novel or not.")] = 2
    outlier: Annotated[
        float,
        key(
            "outlier_deg",
            "outlier_rad",
            above=0.0,
            infinite=True,
            help="A larger change may be an outlier for the twin, which needs more windows to confirm it.",
        ),
    ] = radians(1.0)
    confirm: Annotated[int, key(minimum=0, help="Number of windows sent after such a change, novel or not.")] = 1
    patience: Annotated[
        int,
        key(
            minimum=0,
            help="Number of consecutive uninformative windows that are sent while unconditional ones remain: the twin "
            "may then request more informative ones.",
        ),
    ] = 4
    period_s: Annotated[float, key(above=0.0, infinite=True, help="Longest time from one sent window to the next.")] = (
        600.0
    )
    look_s: Annotated[
        float,
        key(
            above=0.0,
            infinite=True,
            help="Time without a change of the reference after which a window is cut and scored; inf: never.",
        ),
    ] = 60.0

    def __post_init__(self) -> None:
        check(self)


@settings("novelty")
@dataclass(frozen=True, slots=True)
class NoveltySettings:
    """Model and rules of the novelty filter."""

    model: Annotated[
        NoveltyModel,
        key(makers={"": model_table}, dump=_model_values, help="Response of the structure; a program writes it."),
    ]
    rules: Annotated[NoveltyRules, key(prefix="", help="Rules by which a window counts as novel.")] = NoveltyRules()
    gap: Annotated[float, key("gap_deg", "gap_rad", minimum=0.0, help="Total gap to begin at.")] = 0.0

    def __post_init__(self) -> None:
        check(self)

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
