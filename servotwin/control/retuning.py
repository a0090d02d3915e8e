"""One notion for laws of every kind of what a redesign does to them: scale, stop the integral, take feedforwards away.

Kp of the filtered PID is velocity_gain position_gain / ratio of a cascade, its Kd is velocity_gain, its Tf the filter
of the speed. A linear law has one factor on everything, and no shapes.
"""

import math

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput


def static_gain(law: AnyController) -> float:
    """Command at rest per error of the position (V/m) without integral action."""
    if isinstance(law, Controller):
        return law.Kp
    if isinstance(law, Cascade):
        return (law.velocity_gain or 1.0) * law.position_gain / law.ratio
    return law.static_gain


def integrates(law: AnyController) -> bool:
    """True where a law has integral action."""
    if isinstance(law, Controller):
        return law.Ki != 0.0
    if isinstance(law, Cascade):
        return law.integral_time is not None
    return bool(law.holds) and law.integral_share != 0.0


def check_zone_acts(law: AnyController, what: str) -> None:
    """Refuse a dead zone that changes nothing.

    Parameters
    ----------
    law : Controller, Cascade or LinearLaw
    what : str
        What has the dead zone, and opens the sentence.

    Raises
    ------
    InvalidInput
        It stops the integral only, and there is none.
    """
    if law.integral_only and not integrates(law):
        holds = ", or name its integrators in holds" if isinstance(law, LinearLaw) else ""
        raise InvalidInput(
            f"{what} changes nothing: with controller integral_only = true it stops the integral only, and this "
            f"controller has none; give integral_only = false, with which the loop opens there{holds}"
        )


def only_integrates(law: AnyController) -> bool:
    """True for a filtered PID that has integral action and no other: a dead zone that stops it opens the loop."""
    return isinstance(law, Controller) and law.Ki != 0.0 and law.Kp == law.Kd == 0.0


def strength(law: AnyController) -> float:
    """Gain by which laws of one kind are compared: that at rest, or Ki of one that only integrates."""
    return law.Ki if isinstance(law, Controller) and only_integrates(law) else static_gain(law)


def rest_gain(law: AnyController) -> float:
    """Size of the command at rest per error of the position (V/m), before any integral action adds to it; infinite for
    a law that only integrates."""
    return math.inf if only_integrates(law) else abs(static_gain(law))


def without_integral(law: AnyController) -> AnyController:
    """The law without its integral action, as a dead zone leaves it that stops the integral only."""
    if isinstance(law, Controller):
        return law.replace(Ki=0.0)
    if isinstance(law, Cascade):
        return law.replace(integral_time=None)
    return law.replace(integral_share=0.0)


def friction_feedforward(law: AnyController) -> float:
    """Command added with the sign of the reference's last change; only the filtered PID has it."""
    return law.friction_feedforward if isinstance(law, Controller) else 0.0


def filter_time(law: AnyController) -> float | None:
    """Time constant with which a law differentiates, s; None: not known."""
    return law.Tf if isinstance(law, Controller) else law.speed_filter if isinstance(law, Cascade) else None


def scaled(own: AnyController, scale: float, shape: tuple[float, float], share: float) -> AnyController:
    """The law with its gain scaled, its derivative action moved by a shape (lead, slower), and a share of its integral
    gain."""
    lead, slower = shape
    if isinstance(own, Controller):
        if only_integrates(own):
            return own.replace(Ki=own.Ki * scale * share)
        # Without derivative action nothing is filtered: laws that act alike are equal.
        slower = slower if own.Kd else 1.0
        return own.replace(Kp=own.Kp * scale, Kd=own.Kd * scale * lead * slower, Tf=own.Tf * slower, Ki=own.Ki * share)
    if isinstance(own, LinearLaw):
        # A share counts over the own integral gain, which the gain scales too.
        return own.replace(gain=own.gain * scale, integral_share=own.integral_share * share / scale)
    if own.velocity_gain is None:
        return own.replace(position_gain=own.position_gain * scale)
    gain = own.velocity_gain * scale * lead * slower
    time = None if own.integral_time is None or share == 0.0 else own.integral_time * (gain / own.velocity_gain) / share
    return own.replace(
        velocity_gain=gain,
        position_gain=own.position_gain / (lead * slower),
        speed_filter=own.speed_filter * slower,
        integral_time=time,
    )


def slowed(own: Cascade, share: float) -> Cascade:
    """The cascade with this share of its speed: both loops are slower alike, and a rigid axis keeps the margins."""
    if own.velocity_gain is None:
        return own.replace(position_gain=own.position_gain * share)
    time = None if own.integral_time is None else own.integral_time / share
    return own.replace(
        position_gain=own.position_gain * share, velocity_gain=own.velocity_gain * share, integral_time=time
    )


def law_for_margins(law: AnyController) -> AnyController:
    """The law without feedforwards and thresholds, on which margins do not depend: equal ones share a stored result."""
    plain = law.replace(feedforward=0.0, enter=1.0, leave=1.0, integral_only=False)
    if isinstance(plain, Controller):
        return plain.replace(velocity_feedforward=0.0, velocity_time=1.0, friction_feedforward=0.0)
    if isinstance(plain, Cascade):
        return plain.replace(velocity_feedforward=0.0, acceleration_feedforward=0.0)
    return plain
