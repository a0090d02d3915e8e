"""What the edge falls back to, and on what evidence."""

from dataclasses import dataclass
from math import inf
from typing import NamedTuple

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


@dataclass(frozen=True, slots=True)
class FallbackSet:
    """Setting that serves every gap in the servo's stated range, and when the edge falls back to it.

    Parameters
    ----------
    setting : Setting
        Gains None: the gains stay. The band is certified for the servo: no update may do worse in error and settling,
        whatever it predicts.
    silence_s : float
        The twin may leave a window unanswered this long before the edge falls back; inf: for ever.
    refuse_s : float
        Updates are refused this long after the first fallback, twice as long after each further one.
    """

    setting: Setting
    silence_s: float = inf
    refuse_s: float = 10.0

    def __post_init__(self) -> None:
        if not self.setting.has_valid_tolerance():
            raise InvalidInput(f"fallback tolerance = {self.setting.tolerance!r} m: must be finite and at least 0")
        if not self.silence_s > 0.0:
            raise InvalidInput(f"fallback silence_s = {self.silence_s!r} s: must be greater than 0")
        if not 0.0 <= self.refuse_s < inf:
            raise InvalidInput(f"fallback refuse_s = {self.refuse_s!r} s: must be finite and at least 0")
