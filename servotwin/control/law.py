"""The control law, written once: a pure step on plain floats.

The interpreter runs `tick` at the edge, numba compiles the very same function for simulation, and both give the same
bits. So it keeps to what every back end computes alike: additions, products, comparisons. Exponentials belong to
`Controller.law`, which prepares the parameters.
"""

from typing import NamedTuple


class LawParameters(NamedTuple):
    """What the tick needs, discretised; made by `Controller.law`.

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


class LawState(NamedTuple):
    """What the tick remembers.

    Attributes
    ----------
    integral : float
        Ki times the integral of the error, V: a new Ki leaves the voltage where it is.
    derivative : float
        The error behind the derivative's low-pass filter, m.
    filtered : float
        The measurement behind the loop filter, m.
    voltage : float
        What was applied at the last tick, V.
    active : float
        1.0: the loop is closed; 0.0: the error is inside the dead zone.
    """

    integral: float
    derivative: float
    filtered: float
    voltage: float
    active: float


def start(measurement: float) -> LawState:
    """State at rest at `measurement` (m), the loop closed."""
    return LawState(0.0, 0.0, measurement, 0.0, 1.0)


def tick(parameters: LawParameters, state: LawState, reference: float, measurement: float) -> LawState:
    """One sample of the filtered PID with dead zone (Eqs 14 and 20).

    Parameters
    ----------
    parameters, state : LawParameters, LawState
        The law in force and its state after the previous tick.
    reference, measurement : float
        Wanted and measured position of the last mass, m.

    Returns
    -------
    LawState
        The new state; `voltage` is to be applied until the next tick.

    Notes
    -----
    Inside the dead zone the PIDF's input is zero, so its integral holds and its filter decays, and the voltage is zero
    (decision E16). With limits off the voltage equals the continuous PIDF's driven by the held error.
    """
    filtered = measurement + (1.0 - parameters.loop_step) * (state.filtered - measurement)
    error = reference - filtered
    size = abs(error)
    active = state.active
    if active > 0.5:
        if size <= parameters.enter:
            active = 0.0
    elif size > parameters.leave:
        active = 1.0
    driven = error * active
    slope = driven - state.derivative
    wanted = (parameters.Kp * driven + state.integral + parameters.derivative_gain * slope) * active
    voltage = wanted
    if voltage > parameters.voltage_limit:
        voltage = parameters.voltage_limit
    elif voltage < -parameters.voltage_limit:
        voltage = -parameters.voltage_limit
    if voltage > state.voltage + parameters.rate_step:
        voltage = state.voltage + parameters.rate_step
    elif voltage < state.voltage - parameters.rate_step:
        voltage = state.voltage - parameters.rate_step
    correction = parameters.tracking_step * (voltage - wanted) * active
    integral = state.integral + parameters.integral_step * driven + correction
    derivative = state.derivative + parameters.filter_step * slope
    return LawState(integral, derivative, filtered, voltage, active)
