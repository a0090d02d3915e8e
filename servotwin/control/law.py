"""The control law, written once: a pure step on plain floats.

The interpreter runs `tick` at the edge, numba compiles the very same function for simulation, and both give the same
bits. So it keeps to what every back end computes alike: additions, products, comparisons. Exponentials belong to
`Controller.law`, which prepares the parameters.
"""

from math import inf
from typing import NamedTuple


class LawParameters(NamedTuple):
    """Parameters of the tick, discretised; made by `Controller.law`.

    Attributes
    ----------
    Kp : float
        Proportional gain, V/m.
    integral_step : float
        Ki Ts, V/m per tick.
    derivative_gain : float
        Kd / Tf, V/m.
    filter_step : float
        1 - exp(-Ts/Tf), the exact zero-order-hold step of the derivative filter.
    enter, leave : float
        Error below which the loop opens and above which it closes again, m; negative: no dead zone.
    voltage_limit : float
        V; inf: none.
    rate_step : float
        Largest change of the voltage per tick, V; inf: none.
    loop_step : float
        1 - exp(-2 pi f Ts) of the loop filter; 1.0: no filter.
    tracking_step : float
        Ts / Tt of the back-calculation, at most 1.
    feedforward : float
        Always added to the voltage, V.
    release_step : float
        1 - exp(-Ts / release time), the share of `LawState.offset` that fades per tick.
    acting_inside : float
        1.0: inside the dead zone only the integral stops; 0.0: the loop opens there.
    velocity_gain : float
        Velocity feedforward over the time constant of its low-pass filter, V/m.
    velocity_step : float
        The exact zero-order-hold step of that filter.
    friction : float
        V, added with the sign of the reference's last change: none before its first one.
    notch_gain : float
        Share of its band-pass that the notch takes out of the PIDF's voltage: 2 zeta (1 - depth); 0.0: no notch.
    notch_fall, notch_rise, notch_turn : float
        The exact zero-order-hold step of the notch's two states: what the band-pass loses of itself, and the low-pass
        of its distance; and what each gives the other.
    """

    Kp: float
    integral_step: float
    derivative_gain: float
    filter_step: float
    enter: float
    leave: float
    voltage_limit: float
    rate_step: float
    loop_step: float
    tracking_step: float
    feedforward: float = 0.0
    release_step: float = 1.0
    acting_inside: float = 0.0
    velocity_gain: float = 0.0
    velocity_step: float = 1.0
    friction: float = 0.0
    notch_gain: float = 0.0
    notch_fall: float = 0.0
    notch_rise: float = 0.0
    notch_turn: float = 0.0


class LawState(NamedTuple):
    """State of the law between two ticks.

    Attributes
    ----------
    integral : float
        Ki times the integral of the error, V: a new Ki leaves the voltage where it is.
    derivative : float
        The error behind the derivative's low-pass filter, m.
    filtered : float
        The measurement behind the loop filter, m.
    voltage : float
        Voltage applied at the last tick, V.
    active : float
        1.0: the error is outside the dead zone, the integral follows it; 0.0: inside.
    offset : float
        Voltage offset after a change of parameters, V: added to the voltage, inside the dead zone too; it fades
        exponentially.
    reference : float
        The reference of the last tick, m.
    ahead : float
        What the reference was ahead of its low-pass in the velocity feedforward, m: where the reference rests it
        fades beyond all rounding.
    direction : float
        Sign of the reference's last change; 0.0 before the first one.
    notch_band, notch_low : float
        The PIDF's voltage behind the notch's band-pass and low-pass, V.
    """

    integral: float
    derivative: float
    filtered: float
    voltage: float
    active: float
    offset: float = 0.0
    reference: float = 0.0
    ahead: float = 0.0
    direction: float = 0.0
    notch_band: float = 0.0
    notch_low: float = 0.0


def release_of(release_time: float | None) -> float:
    """Time constant (s) with which an offset fades: the paper's loop's where neither a file nor a machine gave one."""
    return 0.5 if release_time is None else release_time


def start(measurement: float) -> LawState:
    """State at rest at `measurement` (m), the loop closed."""
    return LawState(0.0, 0.0, measurement, 0.0, 1.0, 0.0, measurement, 0.0, 0.0, 0.0, 0.0)


def tick(parameters: LawParameters, state: LawState, reference: float, measurement: float) -> LawState:
    """One sample of the filtered PID with dead zone (Eqs 14 and 20).

    Parameters
    ----------
    parameters, state : LawParameters, LawState
        The law in force and its state after the previous tick.
    reference, measurement : float
        Reference and measured position of the last mass, m.

    Returns
    -------
    LawState
        The new state; `voltage` is to be applied until the next tick.

    Notes
    -----
    Inside the dead zone the PIDF's input is zero, so its integral holds and its filter decays, and it gives no voltage
    (erratum E16): what is left is feedforward and offset. A law with `acting_inside` stops its integral there
    and nothing else. With limits off the voltage equals the continuous PIDF's driven by the held error. A notch acts on
    the PIDF's voltage; where the loop opens, it rings out. The limits act on the sum.
    """
    filtered = measurement + (1.0 - parameters.loop_step) * (state.filtered - measurement)
    error = reference - filtered
    # Two thresholds: noise about one of them does not open and close the loop.
    size = abs(error)
    active = state.active
    if active > 0.5:
        if size <= parameters.enter:
            active = 0.0
    elif size > parameters.leave:
        active = 1.0
    # Both factors are 0 or 1, so that nothing here rounds.
    acting = active if active > parameters.acting_inside else parameters.acting_inside
    driven = error * acting
    slope = driven - state.derivative
    pidf = (parameters.Kp * driven + state.integral + parameters.derivative_gain * slope) * acting
    moved = reference - state.reference
    ahead = (1.0 - parameters.velocity_step) * state.ahead + moved
    direction = state.direction if moved == 0.0 else (1.0 if moved > 0.0 else -1.0)
    band, low, through = state.notch_band, state.notch_low, pidf
    if parameters.notch_gain != 0.0:
        through = pidf - parameters.notch_gain * band
        behind = pidf - low
        low = low + (parameters.notch_turn * band + parameters.notch_rise * behind)
        band = band + (parameters.notch_turn * behind - parameters.notch_fall * band)
    fed = parameters.feedforward + parameters.friction * direction
    unlimited = through + (fed + state.offset + parameters.velocity_gain * ahead)
    voltage = unlimited
    if voltage > parameters.voltage_limit:
        voltage = parameters.voltage_limit
    elif voltage < -parameters.voltage_limit:
        voltage = -parameters.voltage_limit
    # The rate limit comes last: it counts from the voltage applied before.
    if voltage > state.voltage + parameters.rate_step:
        voltage = state.voltage + parameters.rate_step
    elif voltage < state.voltage - parameters.rate_step:
        voltage = state.voltage - parameters.rate_step
    # Back-calculation (anti-windup); inside the dead zone the integral must hold.
    correction = parameters.tracking_step * (voltage - unlimited) * active
    integral = state.integral + parameters.integral_step * driven * active + correction
    derivative = state.derivative + parameters.filter_step * slope
    offset = state.offset * (1.0 - parameters.release_step)
    return LawState(integral, derivative, filtered, voltage, active, offset, reference, ahead, direction, band, low)


def replaced(integral: float, feedforward: float) -> float:
    """Part of an integral (V) that an additional feedforward (V) supplies: at most all of it, never the other sign."""
    return min(max(feedforward, min(integral, 0.0)), max(integral, 0.0))


def transfer(old: LawParameters, new: LawParameters, state: LawState, reference: float, measurement: float) -> LawState:
    """Change the law without a bump: the state with which the next tick of `new` gives the voltage of `old`.

    Parameters
    ----------
    old, new : LawParameters
        The law so far and the law to come, equally limited.
    state : LawState
        After the last tick of `old`.
    reference, measurement : float
        Inputs of the tick that is due, m.

    Returns
    -------
    LawState
        For the first tick of `new`. The difference between the two laws is in the offset and fades with it; the part of
        the old voltage beyond its limits is dropped.

    Notes
    -----
    The integral is stored in volts. A law without integral action never changes it, so it would remain as a bias: it
    becomes a part of the offset. Where only the integral stops in the dead zone, a new feedforward replaces as much of
    the integral as it supplies, for good: a law that hardly integrates would take long to give it up.
    """
    # With the old law's limits, so that a voltage that never reached the motor does not come back.
    voltage = tick(old, state, reference, measurement).voltage
    integral = state.integral if new.integral_step != 0.0 else 0.0
    if new.acting_inside > 0.0:
        integral -= replaced(integral, new.feedforward - old.feedforward)
    moved = state._replace(integral=integral, offset=0.0)
    unlimited = new._replace(voltage_limit=inf, rate_step=inf)
    if new.notch_gain == 0.0:
        moved = moved._replace(notch_band=0.0, notch_low=0.0)
    elif old.notch_gain == 0.0:
        # A notch that is new starts at rest at what it filters: at zero it would ring.
        bare = unlimited._replace(notch_gain=0.0, feedforward=0.0, velocity_gain=0.0, friction=0.0)
        moved = moved._replace(notch_band=0.0, notch_low=tick(bare, moved, reference, measurement).voltage)
    return moved._replace(offset=voltage - tick(unlimited, moved, reference, measurement).voltage)
