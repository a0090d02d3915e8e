"""Guard: decides whether an update may be applied. A pure function, so that nothing unsafe depends on its caller.

Several updates may be in flight. Each names the version it replaces, and only one that replaces the version in force
is applied (compare-and-swap); so of two made on the same base the first to arrive wins, and the other is refused.
Every receipt, every window and every hello names the version in force. The twin has only its newest estimate as its
goal and, when a receipt says that the goal was refused for its base or version, sends it again on the base the receipt
names. The newest data therefore win in the end, and no update is ever applied on an assumption that does not hold.
A repeated update gets its first answer again, so that a lost receipt costs nothing. `servotwin.edge.switch` chooses the
instant at which an admissible update is applied.
"""

from dataclasses import dataclass

from msgspec.structs import replace

from servotwin.edge.limits import Limits
from servotwin.edge.parameters import Parameters
from servotwin.messages import Gains, Reason, Receipt, Update


@dataclass(frozen=True, slots=True)
class Instant:
    """An edge (servo, boot) and its next sample, at `rate` Hz."""

    servo: str
    boot: str
    sample: int
    rate: float

    @property
    def time(self) -> float:
        """Sample time, s."""
        return self.sample / self.rate


def is_repeat(update: Update, current: Parameters, here: Instant) -> bool:
    """True where an update is the one in force, sent again."""
    return update.version == current.version and update.window == current.window and update.servo == here.servo


def updated_parameters(update: Update, current: Parameters, sample: int) -> Parameters:
    """Make the parameters in force from `sample` on; an update without gains leaves the gains as they are."""
    gains = current.setting.gains if update.setting.gains is None else update.setting.gains
    setting = replace(update.setting, gains=gains)
    return Parameters(update.version, setting, update.data_time, update.window, sample, gap=update.gap)


def judge(update: Update, current: Parameters, limits: Limits, here: Instant, own: Gains | None = None) -> Reason:
    """Return the reason for which an update is refused, or `Reason.APPLIED`.

    Parameters
    ----------
    update : Update
    current : Parameters
        In force.
    limits : Limits
    here : Instant
    own : Gains, optional
        The servo's own gains; None: the edge changes no gains.
    """
    samples = here.sample - current.sample
    since = samples / here.rate
    old, new = current.setting.tolerance, update.setting.tolerance
    checks = (
        (update.servo == here.servo, Reason.WRONG_SERVO),
        (update.window[0] == here.boot, Reason.OTHER_BOOT),
        (update.version > current.version, Reason.OLD_VERSION),
        (update.data_time > current.data_time, Reason.OLD_DATA),
        (update.base_version == current.version, Reason.BASE_MISMATCH),
        (update.data_time <= here.time, Reason.FUTURE_DATA),
        (here.time < update.not_after and here.time - update.data_time <= limits.lifetime_s, Reason.EXPIRED),
        (limits.allows_tolerance(new), Reason.OUT_OF_BOUNDS),
        (limits.allows_tolerance_step(old, new, since), Reason.STEP_TOO_LARGE),
        (current.window is None or samples >= limits.interval_s * here.rate, Reason.TOO_SOON),
        (here.sample >= current.not_before, Reason.AFTER_FALLBACK),
    )
    reason = next((reason for passed, reason in checks if not passed), Reason.APPLIED)
    if reason is not Reason.APPLIED or update.setting.gains is None:
        return reason
    return Reason.NO_GAINS if own is None else _judge_gains(update.setting.gains, current, limits, own, since)


def _judge_gains(gains: Gains, current: Parameters, limits: Limits, own: Gains, since: float) -> Reason:
    if not limits.allows_gains(gains, own):
        return Reason.GAINS_OUT_OF_BOUNDS
    if not limits.allows_gains_step(current.setting.gains or own, gains, own, since):
        return Reason.GAINS_STEP_TOO_LARGE
    return Reason.APPLIED


def receipt(update: Update, reason: Reason, sample: int, current: Parameters, here: Instant) -> Receipt:
    """Make the receipt of a decision; `current` is in force after it."""
    is_applied = reason is Reason.APPLIED
    return Receipt(here.servo, update.version, is_applied, sample, reason, current.version, here.boot)
