"""Estimate of the gap: value, spread, interval, status, reasons, and the model and method behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from servotwin.runtime.notebook import html_table

Interval = tuple[float, float]
NOTHING_KNOWN: Interval = (0.0, math.inf)
NORMAL_95 = 1.959963984540054  # standard deviations on either side of the mean hold 95 % of a normal distribution


class GapStatus(StrEnum):
    """Status of an estimate; only OK may reach a controller."""

    OK = "ok"
    LOWER_BOUND = "lower bound"
    UNIDENTIFIABLE = "unidentifiable"
    MODEL_MISMATCH = "model mismatch"
    LOST_MOTION = "lost motion"  # known, and with it the largest gap: friction may wind up all of it


@dataclass(frozen=True)
class OffsetReading:
    """The encoder's offset as one window shows it: value, standard deviation (rad), covariance with the gap (rad^2)."""

    offset: float
    std: float
    covariance: float = 0.0


@dataclass(frozen=True)
class CarriedOffset:
    """The encoder's offset from earlier windows; without it the window would not show the gap.

    Attributes
    ----------
    offset, std : float
        rad, as handed to the estimator.
    slope : float
        Change of the estimated gap per change of the offset.
    """

    offset: float
    std: float
    slope: float


@dataclass(frozen=True)
class MachineReading:
    """The machine's numbers over the model's after one window, what was known before included.

    Attributes
    ----------
    factors : tuple of 4 float
        Logarithms of the factors on k/m, c/m, pitch and mass ratio.
    covariance : tuple of 16 float
        Of these, row by row.
    softness : (float, float)
        The structure's stiffness over the screw's beyond that of the model, and one over the variance of that; (0, 0):
        nothing is known of it. The fitted screw is the model's all the same: this says what that leaves out.
    """

    factors: tuple[float, ...]
    covariance: tuple[float, ...]
    softness: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class GapBetween:
    """The gap as the contacts of two windows show it, one on each side.

    Attributes
    ----------
    gap, std : float
        rad.
    time : float
        s, the middle between both contacts.
    rate : float
        rad/s, growth since the two contacts before; NaN where there were none.
    """

    gap: float
    std: float
    time: float
    rate: float = math.nan


@dataclass(frozen=True)
class LastContact:
    """Last contact of a window in which the motor pushed the screw one way only.

    Attributes
    ----------
    side : float
        1: the motor pushed the screw forwards; -1: backwards.
    motor : float
        rad, the motor's furthest angle: where it touches the screw.
    position : float
        m, of the last mass at rest with the screw there.
    std : float
        rad, of both together.
    time : float
        s, when the motor was there.
    between : GapBetween, optional
        The gap between the contact before, on the other side, and this one; None: there was none.
    lead : float
        rad, motor's way to this side in its window at least: the gap was no narrower.
    jumps : int
        Contacts that were not where the one before on the same side was, since contacts last confirmed each other.
    """

    side: float
    motor: float
    position: float
    std: float
    time: float
    between: GapBetween | None = None
    lead: float = 0.0
    jumps: int = 0


@dataclass(frozen=True)
class UnknownRatio:
    """The transmission's ratio, where a window does not tell the gap from it and would show the gap with it.

    Steps between the same two places tell one number of the two: at rest the load has moved by the ratio times the
    motor's travel, less the gap. Moves of different lengths tell both.

    Attributes
    ----------
    known, needed : float
        Standard deviation of its logarithm: before the window, and with which the window would show the gap.
    widest : float
        rad, largest gap of the window within what is known of the ratio (95 %).
    """

    known: float
    needed: float
    widest: float


@dataclass(frozen=True, repr=False)
class GapEstimate:
    """Total gap estimated from one window.

    Attributes
    ----------
    gap : float
        Total gap, rad; a lower bound where the status says so; NaN when nothing is known.
    std : float
        Statistical standard deviation, rad; inf when the window does not determine the gap.
    std_total : float
        `std` with the method's known systematic error added, rad.
    interval : (float, float)
        95 % interval of the gap from `std_total`, rad; its upper end is inf where only a lower bound is known.
    status : GapStatus
    time : float
        Time of the window's middle, s; the gap belongs to it.
    theta_d0 : float
        Screw angle at the first sample, rad; NaN when unknown.
    reasons : tuple of str
        Reasons for a status other than OK, one sentence each.
    model_version : str
        Version of the assumed model: `Servo.version`.
    method : str
    rms : float
        Root mean square of the residual over the samples that count, m; NaN when nothing was fitted.
    evaluations : int
        Evaluations of the cost.
    offset : OffsetReading or CarriedOffset, optional
        The encoder's offset, read from this window or carried from earlier ones; None: not used. Of an estimate that is
        not OK: a carried one that does not fit the window.
    machine : MachineReading, optional
        The machine's own numbers; None: the model was taken as it is.
    ratio : UnknownRatio, optional
        None: the window tells the gap from the ratio, or would not show the gap with a known ratio either.
    contact : LastContact, optional
        The window's last contact; None: it has contacts on both sides, or none for certain.
    """

    gap: float
    std: float
    std_total: float
    interval: Interval
    status: GapStatus
    time: float
    theta_d0: float = math.nan
    reasons: tuple[str, ...] = ()
    model_version: str = ""
    method: str = ""
    rms: float = math.nan
    evaluations: int = 0
    offset: OffsetReading | CarriedOffset | None = None
    machine: MachineReading | None = None
    ratio: UnknownRatio | None = None
    contact: LastContact | None = None

    def __post_init__(self) -> None:
        # Estimates go into messages and logs, which take plain floats only, not numpy scalars.
        for name in ("gap", "std", "std_total", "time", "theta_d0", "rms"):
            object.__setattr__(self, name, float(getattr(self, name)))
        low, high = self.interval
        object.__setattr__(self, "interval", (float(low), float(high)))

    def __repr__(self) -> str:
        """Status, gap with its 95 % interval and time in one line."""
        low, high = map(math.degrees, self.interval)
        value = f"{math.degrees(self.gap):.4g} deg (95 %: {low:.4g} .. {high:.4g} deg)"
        return f"<GapEstimate {self.status.value}: {value} at {self.time:.6g} s>"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        low, high = map(math.degrees, self.interval)
        rows = {
            "status": self.status.value,
            "total gap": f"{math.degrees(self.gap):.4g} deg",
            "95 % interval": f"{low:.4g} .. {high:.4g} deg",
            "time": f"{self.time:.6g} s",
            "method": self.method or "-",
            "model": self.model_version or "-",
        }
        return html_table("Gap estimate", rows | ({"reasons": "; ".join(self.reasons)} if self.reasons else {}))

    @property
    def ok(self) -> bool:
        """True where the value may be used to set a controller."""
        return self.status is GapStatus.OK


def no_estimate(time: float, reasons: tuple[str, ...] = (), model_version: str = "", method: str = "") -> GapEstimate:
    """Make the estimate of a window that does not show the gap, with the reasons; `time` in s."""
    return GapEstimate(
        gap=math.nan,
        std=math.inf,
        std_total=math.inf,
        interval=NOTHING_KNOWN,
        status=GapStatus.UNIDENTIFIABLE,
        time=time,
        reasons=reasons,
        model_version=model_version,
        method=method,
    )


def interval_95(gap: float, std: float) -> Interval:
    """95 % interval (rad) of a total gap with a normal spread, cut at 0."""
    return max(0.0, gap - NORMAL_95 * std), gap + NORMAL_95 * std
