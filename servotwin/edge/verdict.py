"""What the edge falls back to, and on what evidence."""

from dataclasses import dataclass
from math import inf
from typing import Annotated, NamedTuple

from servotwin.config.keys import check, key, settings
from servotwin.errors import InvalidInput
from servotwin.messages import Band, Cause, Setting


class Verdict(NamedTuple):
    """Evidence against the parameters in force: m, V or s, as the cause says."""

    cause: Cause
    measured: float
    allowed: float


def judged_by(predicted: Band | None, certified: Band | None) -> Band | None:
    """What the loop is held to: error and settling are certified at worst, the effort is what its gains predict.

    A smaller error counts where the loop is predicted to come to it as soon as to what is certified.
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


@settings("fallback")
@dataclass(frozen=True, slots=True)
class FallbackSet:
    """Setting that serves every gap in the servo's stated range, and when the edge falls back to it.

    Parameters
    ----------
    setting : Setting
        Gains None: the gains stay. The band is certified for the servo: no update may do worse in error and settling,
        whatever it predicts.
    """

    setting: Setting
    silence_s: Annotated[
        float,
        key(
            above=0.0,
            infinite=True,
            help="Time for which the twin may leave a window unanswered before the edge falls back; inf: for ever.",
        ),
    ] = inf
    refuse_s: Annotated[
        float,
        key(
            minimum=0.0,
            help="Time for which updates are refused after the first fallback, twice as long after each further one.",
        ),
    ] = 10.0

    def __post_init__(self) -> None:
        check(self)
        if not self.setting.has_valid_tolerance():
            raise InvalidInput(f"fallback tolerance = {self.setting.tolerance!r} m: must be finite and at least 0")
