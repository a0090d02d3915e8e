"""Settings of a twin and of its triage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from servotwin.config.keys import check, key, settings
from servotwin.config.own_units import AT_LOAD, at_load
from servotwin.config.table import Table
from servotwin.config.toml import attribute, part, read
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput
from servotwin.estimation import whitened
from servotwin.estimation.gap import METHODS, settings_of
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.learning.trend_settings import TrendSettings, trend_maker, wear
from servotwin.plant.axis import Axis
from servotwin.plant.own_units import INPUT_BIAS_KEYS
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales
from servotwin.plant.signals import turn_in_words
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.redesign.registry import POLICIES, paper_k_dz

_LEAST_MISFIT, _BIAS = 1e-7, 2e-3  # m for the smallest step of the default range; V on the paper's servo
# Smallest change of the gap that counts, and largest spread of a glance that decides: of the gap, and at most.
_NEWS, _TOLD, _MOST = 0.01, 0.05, math.radians(0.1)
# Of the command that the model's friction holds: rests from either side are twice as far apart, on a machine whose
# friction is up to a quarter larger.
_RESTS = 2.5
_LARGEST_BIAS = 0.01  # of a command's limit: no larger offset of a drive is assumed where its file states none


@settings("triage")
@dataclass(frozen=True)
class TriageSettings:
    """Conditions under which a glance at a window is enough.

    Raises
    ------
    InvalidInput
        A value is not finite and above 0, or `every` is not a whole number.
    """

    gap: Annotated[
        float | None,
        key(
            "gap_deg",
            above=0.0,
            at_load=True,
            help="A smaller change of the gap needs no estimate; where absent 1 % of the gap estimated last, at most "
            "0.1 deg.",
        ),
    ] = None
    deviations: Annotated[
        float, key(above=0.0, help="Smallest change of gap and input bias, in standard deviations.")
    ] = 3.0
    widest: Annotated[
        float | None,
        key(
            "widest_deg",
            above=0.0,
            at_load=True,
            help="Largest standard deviation of a glance that decides; that of the last estimate where it is more. "
            "Where absent 5 % of the gap estimated last, at most 0.1 deg.",
        ),
    ] = None
    misfit: Annotated[
        float, key(above=0.0, help="Factor above the usual misfit from which a misfit counts as unusual.")
    ] = 3.0
    least_misfit: Annotated[
        float | None,
        key(
            "least_misfit_um",
            above=0.0,
            help="Smallest misfit that counts as unusual; where absent a thousandth of the smallest stated step, "
            "0.1 um by default.",
        ),
    ] = None
    bias: Annotated[
        float | None,
        key(
            "bias_mv",
            above=0.0,
            help="A smaller change of the input bias needs no estimate; where absent 2 mV on the preset paper, as much "
            "of another's own volt, and the difference between two rests that the model's friction allows.",
        ),
    ] = None
    every: Annotated[int, key(minimum=1, help="Largest number of windows from one estimate to the next.")] = 50
    longest: Annotated[float, key("longest_s", above=0.0, help="Longest time from one estimate to the next.")] = 3600.0

    def __post_init__(self) -> None:
        check(self)

    def on(self, volt: float, friction: float, step: float) -> TriageSettings:
        """The settings for a servo with a smallest step (m).

        Its own volt (`plant.scales`) is so many V, and its friction holds it at rest under a command of `friction`.
        """
        usual = _LEAST_MISFIT * (step / Uncertainty().step[0])
        misfit = usual if self.least_misfit is None else self.least_misfit
        bias = max(_BIAS * volt, _RESTS * friction) if self.bias is None else self.bias
        return replace(self, least_misfit=misfit, bias=bias)

    def gap_limit(self, gap: float) -> float:
        """Smallest change (rad) that counts of a gap (rad)."""
        return min(_MOST, _NEWS * gap) if self.gap is None else self.gap

    def widest_limit(self, gap: float) -> float:
        """Largest standard deviation (rad) of a glance at a gap (rad) that decides."""
        return min(_MOST, _TOLD * gap) if self.widest is None else self.widest

    @property
    def misfit_limit(self) -> float:
        """Smallest misfit that counts as unusual, m."""
        return _LEAST_MISFIT if self.least_misfit is None else self.least_misfit

    @property
    def bias_limit(self) -> float:
        """Smallest change of the input bias that counts, V."""
        return _BIAS if self.bias is None else self.bias


@settings("twin")
@dataclass(frozen=True)
class TwinSettings:
    """Settings of a twin: estimator, policy, and repetition of its messages.

    Parameters
    ----------
    estimator : object, optional
        Settings of the estimator; None: its defaults. Those of "whitened" must leave `combine` off, because the
        trend already combines the windows; a `gap_rate` of 0 is replaced by that of the trend.

    Raises
    ------
    InvalidInput
        A value is not a finite number in its range, the method or the policy does not exist, or the settings belong to
        another method or policy.
    """

    enabled: Annotated[
        bool,
        key(
            help="Answer the edge's windows. A scenario of a twin that does not, and that states no policy, runs with "
            "the servo's own controller."
        ),
    ] = True
    method: Annotated[str, key(choices=tuple(METHODS), help="Estimator; the table [estimator] has its settings.")] = (
        whitened.METHOD
    )
    estimator: Any = None
    policy: Annotated[
        str,
        key(
            choices=tuple(POLICIES),
            help="Rule that computes a setting from an estimate: certified sends verified settings, margin and "
            "hysteresis set a dead zone, paper is Eq 21.",
        ),
    ] = next(iter(POLICIES))
    uncertainty: Annotated[
        Uncertainty,
        key(
            help="Uncertainty of the model, and the stated range of gaps, steps and input bias for which settings are "
            "verified; the policy margin needs the steps."
        ),
    ] = field(default_factory=lambda: Uncertainty(input_bias=(-0.1, 0.1)))
    demands: Annotated[Demands, key(help="Requirements on a certified setting.")] = field(default_factory=Demands)
    table: Annotated[
        str | None,
        key(
            relative=True,
            help="File of settings verified in advance (`servotwin certify`), for the policy certified. The twin looks "
            "a setting up, sends it and verifies it afterwards; without the file it verifies before it sends.",
        ),
    ] = None
    horizon: Annotated[
        float | None,
        key(
            "horizon_s",
            minimum=0.0,
            help="Time for which a certified setting is to hold: it is verified for the gap as the trend lets it grow "
            "meanwhile. Where absent 40 s, of a slow machine 40 of its own seconds.",
        ),
    ] = None
    silence: Annotated[
        float,
        key(
            "silence_s",
            above=0.0,
            infinite=True,
            help="Time for which the twin may leave a window unanswered before an edge whose policy sends gains falls "
            "back, as `enroll` writes it into the edge's file; inf: for ever. Longer than horizon_s, the edge keeps a "
            "setting beyond the time for which it was verified.",
        ),
    ] = 40.0
    k_dz: Annotated[
        float | None, key(minimum=0.0, help="Dead-zone gain of Eq 21, for the policy paper; 1 where absent.")
    ] = None
    smoothing: Annotated[
        float | None,
        key(
            minimum=0.0,
            maximum=1.0,
            help="Share of the previous gap that each update keeps, below 1, for the policy paper; 0 where absent.",
        ),
    ] = None
    k_noise: Annotated[
        float | None,
        key(minimum=0.0, help="Tolerances per standard deviation of the measurement's noise, for the policy margin."),
    ] = None
    excitation: Annotated[
        ExcitationSettings | None,
        key(help="Requests to the edge when windows are not informative enough; none where absent."),
    ] = None
    triage: Annotated[
        TriageSettings | None,
        key(help="Conditions under which a glance at a window is enough; where absent every window is estimated."),
    ] = None
    initial_gap: Annotated[
        float,
        key("initial_gap_deg", minimum=0.0, at_load=True, help="Gap before the first estimate (section 4.2: zero)."),
    ] = 0.0
    trend: Annotated[TrendSettings, key(makers={"": wear}, select=trend_maker, help="Assumptions on wear.")] = field(
        default_factory=TrendSettings
    )
    learning: Annotated[LearningSettings, key(help="How the machine's stiffness, damping and pitch are learnt.")] = (
        field(default_factory=LearningSettings)
    )
    gap_limit: Annotated[
        float | None,
        key(
            "gap_limit_deg",
            minimum=0.0,
            at_load=True,
            help="Largest acceptable gap; the twin reports the time until then.",
        ),
    ] = None
    processing: Annotated[
        float,
        key(
            "processing_s",
            minimum=0.0,
            help="Time from a window's arrival to the update's departure; the acknowledgement does not wait for it.",
        ),
    ] = 0.0
    validity: Annotated[
        float | None,
        key(
            "validity_s",
            above=0.0,
            help="Time after a window's first sample within which an update computed from it may be applied. Where "
            "absent 60 s, of a slow machine, whose windows are long, 60 of its own seconds.",
        ),
    ] = None
    retry: Annotated[
        float,
        key(
            "retry_s",
            above=0.0,
            help="Time without a receipt after which an update is sent again; if it is shorter than a round trip, each "
            "update is sent twice.",
        ),
    ] = 5.0
    attempts: Annotated[int, key(minimum=1, help="Number of sendings after which the twin abandons an update.")] = 4

    def __post_init__(self) -> None:
        check(self)
        for name, owner in ((name, owner) for owner, entry in POLICIES.items() for name in entry.options):
            value = getattr(self, name)
            if value is not None and owner != self.policy:
                raise InvalidInput(f"twin {name} = {value!r}: belongs to policy {owner!r}, and this is {self.policy!r}")
        if getattr(settings_of(self.method, self.estimator), "combine", False):
            raise InvalidInput("twin estimator combine = True: must be False: the trend already combines the windows")

    def on(self, servo: Plant) -> TwinSettings:
        """The settings with what is absent derived for a servo: a slow machine wears slowly, and needs longer windows.

        A trend that differs from the default one was stated, and stays.
        """
        second, _, volt = scales(servo)
        friction = float(servo.command_of(servo.own_friction))
        slow = max(1.0, second)  # a fast machine's link takes no less time
        horizon = slow * self.holds_for if self.horizon is None else self.horizon
        return replace(
            self,
            horizon=horizon,
            validity=slow * self.valid_for if self.validity is None else self.validity,
            trend=self._trend(servo, second, horizon),
            excitation=None if self.excitation is None else self.excitation.on(second),
            triage=None if self.triage is None else self.triage.on(volt, friction, self.uncertainty.step[0]),
        )

    @property
    def holds_for(self) -> float:
        """Time for which a certified setting is to hold, s: as stated, otherwise that of the paper's servo."""
        return 40.0 if self.horizon is None else self.horizon

    @property
    def valid_for(self) -> float:
        """Time after a window's first sample within which its update may be applied, s: likewise."""
        return 60.0 if self.validity is None else self.validity

    def _trend(self, servo: Plant, second: float, horizon: float) -> TrendSettings:
        if self.trend != TrendSettings():
            return self.trend
        if isinstance(servo, Axis) and horizon > 0.0:
            return TrendSettings.within(self.uncertainty.gap[1], horizon)
        return TrendSettings.on(second)

    def initial_tolerance(self, servo: Plant) -> float:
        """Tolerance before the first update by Eq 21, m; 0 where no gap is assumed."""
        return servo.tolerance_for(self.initial_gap, paper_k_dz(self))

    def replace(self, **changes: Any) -> TwinSettings:
        """A copy with some values changed, validated again."""
        return replace(self, **changes)


def check_gaps(table: Table, names: Sequence[str], plant: Plant) -> None:
    """Refuse gaps of a table, numbers or ranges, that are larger than those of the machine can be.

    They count at the motor or, where the name says so, at the load.

    Raises
    ------
    InvalidInput
    """
    for name in names:
        given, unit = table.values.get(name), unit_of(name)
        most = unit.from_si(plant.largest_gap * (plant.p if AT_LOAD in name else 1.0))
        sizes = given if isinstance(given, list) else [given]
        if any(isinstance(size, int | float) and size > most * (1.0 + 1e-12) for size in sizes):
            numbers = "two numbers" if isinstance(given, list) else "a number"
            allowed = f"{numbers}, at least 0, at most {most:g} {unit.name}, {turn_in_words(plant.largest_gap)}"
            raise table.invalid(name, allowed)


def read_twin_settings(table: Table, folder: Path = Path(), plant: Plant | None = None) -> TwinSettings:
    """Read [twin] with its inner tables; the method declares the keys of [estimator].

    Parameters
    ----------
    table : Table
    folder : Path
        That paths are relative to.
    plant : Servo or Axis, optional
        Steps and input bias of the uncertainty that the file does not state are those of the preset `paper` in the
        axis's own metre and volt, the bias at most a hundredth of the command's limits; a servo's are as they are.
    """
    estimator = part(table, "estimator", METHODS[attribute(table, TwinSettings, "method")].settings)
    given = table.values.get("uncertainty", {})
    settings: TwinSettings = read(table, TwinSettings, folder, estimator=estimator)
    if plant is not None:
        check_gaps(table.table("uncertainty"), ["gap_deg", *at_load("gap_deg")], plant)
    if not isinstance(plant, Axis) or not isinstance(given, Mapping):
        return settings
    known, own = settings.uncertainty, scales(plant)
    changed = {}
    if not {"step_mm", "step_deg"} & given.keys():
        changed["step"] = (own.length * known.step[0], own.length * known.step[1])
    if not set(INPUT_BIAS_KEYS) & given.keys():
        limits = [
            _LARGEST_BIAS * each for each in (plant.command_limit, plant.controller.voltage_limit) if each is not None
        ]
        most = min([own.voltage * known.input_bias[1], *limits])
        changed["input_bias"] = (-most, most)
    return replace(settings, uncertainty=known.replace(**changed)) if changed else settings
