"""Claims about the loop without a gap (section 2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servotwin.control.controller import Controller
from servotwin.plant.linear import LinearSystem
from servotwin.plant.loop import pidf
from servotwin.plant.margins import Margins
from servotwin.plant.servo import Servo
from servotwin.reproduction import measures as measure
from servotwin.reproduction.claims.registry import Finding, Verdict, decided, listed, measures
from servotwin.reproduction.runs import PERIOD, Runs

_CROSSOVER, _MARGIN_DEG = 10.0, 10.0  # rad/s and deg, section 2.2
_LOOP_FILTER_HZ = 20.0  # section 4.3


@measures("crossover")
def crossover(runs: Runs) -> Finding:
    """Lowest gain crossover against 10 rad/s."""
    margins = runs.servo.margins()
    crossovers = [one.omega for one in margins.gain_crossovers]
    first = crossovers[0]
    why = (
        f"the loop gain falls through 1 at {first:.4g} rad/s first; the closed loop's gain falls by 3 dB only at"
        f' {margins.bandwidth:.4g} rad/s, so that "bandwidth" means the crossover'
    )
    values = [(f"gain crossover {i + 1}", omega, "rad/s") for i, omega in enumerate(crossovers)]
    return decided(
        abs(first - _CROSSOVER) < 0.01 * _CROSSOVER, why, *values, ("-3 dB bandwidth", margins.bandwidth, "rad/s")
    )


@measures("phase-margin")
def phase_margin(runs: Runs) -> Finding:
    """Smallest phase margin over all gain crossovers."""
    margins = runs.servo.margins()
    smallest = _smallest_margin_deg(margins)
    filtered = _smallest_margin_deg(runs.servo.margins(_with_loop_filter(runs.servo)))
    count = len(margins.gain_crossovers)
    why = f"the smallest margin over {count} crossover{'s' if count > 1 else ''} is {smallest:.4g} deg"
    return decided(
        margins.stable and smallest >= _MARGIN_DEG,
        why,
        ("smallest phase margin", smallest, "deg"),
        ("with the 20 Hz loop filter", filtered, "deg"),
        ("Ms", margins.Ms),
    )


@measures("loop-filter-stable")
def loop_filter(runs: Runs) -> Finding:
    """The same with section 4.3's loop filter."""
    controller = _with_loop_filter(runs.servo)
    margins = runs.servo.margins(controller)
    smallest = _smallest_margin_deg(margins)
    reproduced = margins.stable and smallest >= _MARGIN_DEG
    state = "stable" if margins.stable else "unstable"
    why = f"with the filter the loop is {state} and keeps {smallest:.4g} deg of the {_MARGIN_DEG:g} deg asked for"
    before = _smallest_margin_deg(runs.servo.margins())
    return decided(
        reproduced,
        why,
        ("phase margin with the filter", smallest, "deg"),
        ("without", before, "deg"),
        ("stable", margins.stable),
    )


@measures("pidtune")
def pidtune(runs: Runs) -> Finding:
    """Zeros of the printed gains; the rest of the claim needs MATLAB."""
    law = runs.servo.controller
    zeros = np.roots([law.Kp * law.Tf + law.Kd, law.Kp + law.Ki * law.Tf, law.Ki])
    margins = runs.servo.margins()
    why = (
        "pidtune belongs to MATLAB and picks among many controllers that meet the requirements; the printed Tf equals"
        f" 1/(10 rad/s), and the printed gains cross over at {margins.gain_crossovers[0].omega:.4g} rad/s here"
    )
    values = [(f"controller zero {i + 1}", float(-zero.real), "rad/s") for i, zero in enumerate(zeros)]
    return Finding(Verdict.CANNOT_BE_CHECKED, why, listed(*values, ("1/Tf", 1.0 / law.Tf, "rad/s")))


@measures("zero-steady-state-error")
def steady_state(runs: Runs) -> Finding:
    """Static gain of the closed loop."""
    return _static(runs.servo.closed_loop(), "the printed gains")


@measures("pd-first-requirement")
def pd_steady_state(runs: Runs) -> Finding:
    """The same without integral action."""
    return _static(runs.servo.closed_loop(_without_integral(runs.servo)), "Ki = 0")


def _static(closed: LinearSystem, name: str) -> Finding:
    error = 1.0 - float(closed.response(0.0).real)
    stable = closed.is_stable()
    why = f"with {name} the closed loop is {'stable' if stable else 'unstable'} and its static error is {error:.2g}"
    return decided(stable and abs(error) < 1e-9, why, ("static error", error, "m/m"), ("stable", stable))


@measures("pd-bandwidth")
def pd_bandwidth(runs: Runs) -> Finding:
    """Search the filtered PDs that cross over at 10 rad/s for one with 10 deg of margin."""
    first = runs.servo.margins(_without_integral(runs.servo)).gain_crossovers[0].omega
    laws = pd_family(runs.servo)
    stable = [law for law in laws if runs.servo.closed_loop(law).is_stable()]
    best, law = best_pd(runs.servo, stable)
    why = (
        f"the printed Kp, Kd and Tf alone cross over at {first:.4g} rad/s; but of {len(laws)} filtered PDs scaled to 10"
        f" rad/s {len(stable)} are stable, the best with {best:.3g} deg (Kp = {law.Kp:.5g}, Kd = {law.Kd:.5g},"
        f" Tf = {law.Tf:.3g} s: in effect a lag)"
    )
    return decided(
        best < _MARGIN_DEG,
        why,
        ("crossover of the printed PD", first, "rad/s"),
        ("best margin of a PD at 10 rad/s", best, "deg"),
        ("filtered PDs tried", len(laws)),
        ("of them stable", len(stable)),
    )


def best_pd(servo: Servo, laws: Sequence[Controller]) -> tuple[float, Controller]:
    """Largest margin (deg) among stabilising controllers, and its controller."""
    return max(((_pd_margin_deg(servo, law), law) for law in laws), key=lambda pair: pair[0])


def pd_family(servo: Servo) -> list[Controller]:
    """Kp (1 + ratio s / (s/pole + 1)) with a gain of 1 at 10 rad/s: leads, lags and right-half-plane zeros."""
    plant = complex(servo.plant().response(_CROSSOVER))
    steps = np.geomspace(1e-3, 10.0, 17)
    pairs = [(float(ratio), float(pole)) for ratio in (0.0, *steps, *-steps) for pole in np.geomspace(1.0, 1e3, 25)]
    return [_pd(servo, plant, ratio, pole) for ratio, pole in pairs]


def _pd(servo: Servo, plant: complex, ratio: float, pole: float) -> Controller:
    shape = 1.0 + ratio * 1j * _CROSSOVER / (1j * _CROSSOVER / pole + 1.0)
    gain = 1.0 / abs(shape * plant)
    return servo.controller.replace(Kp=gain, Ki=0.0, Kd=gain * ratio, Tf=1.0 / pole)


def _pd_margin_deg(servo: Servo, law: Controller) -> float:
    """Smallest phase margin, deg; 0 when it crosses over below 10 rad/s too."""
    margins = servo.margins(law)
    early = margins.gain_crossovers[0].omega < 0.99 * _CROSSOVER
    return 0.0 if early else _smallest_margin_deg(margins)


@measures("pd-disturbances")
def pd_disturbances(runs: Runs) -> Finding:
    """Static position error per volt of disturbance at the motor's input."""
    with_integral, without = (
        _static_sensitivity(law) for law in (runs.servo.controller, _without_integral(runs.servo))
    )
    peaks = [runs.servo.margins(law).Ms for law in (runs.servo.controller, _without_integral(runs.servo))]
    why = (
        f"a constant volt at the motor moves the position by {without * 1e3:.3g} mm without and"
        f" {with_integral * 1e3:.2g} mm with integral action; but the sensitivity peak Ms is {peaks[0]:.3g} with it and"
        f" {peaks[1]:.3g} without"
    )
    return decided(
        abs(with_integral) < abs(without),
        why,
        ("static error per volt, PIDF", with_integral * 1e3, "mm/V"),
        ("static error per volt, PD", without * 1e3, "mm/V"),
        ("Ms, PIDF", peaks[0]),
        ("Ms, PD", peaks[1]),
    )


def _static_sensitivity(law: Controller) -> float:
    """Limit of G / (1 + C G) for low frequencies, m/V: 1 / C(0), because G has an integrator."""
    controller = pidf(law)
    return float(controller.denominator[0] / controller.numerator[0])


@measures("two-resonances")
def two_resonances(runs: Runs) -> Finding:
    """Local maxima of the closed loop above 1."""
    omega = np.geomspace(0.1, 1000.0, 20001)
    magnitude = np.abs(runs.servo.closed_loop().response(omega))
    maxima = [int(i) for i in measure.peaks(magnitude) if magnitude[i] > 1.0]
    where = " and ".join(f"{omega[i]:.3g} rad/s (gain {magnitude[i]:.3g})" for i in maxima)
    values = [(f"resonance {n + 1}", float(omega[i]), "rad/s") for n, i in enumerate(maxima)]
    gains = [(f"its gain {n + 1}", float(magnitude[i])) for n, i in enumerate(maxima)]
    return decided(len(maxima) == 2, f"maxima above 1 lie at {where or 'no frequency'}", *values, *gains)


@measures("overshoot")
def overshoot(runs: Runs) -> Finding:
    """Overshoot of the step response and the least damped pole."""
    closed = runs.servo.closed_loop()
    time, position = _linear_step(runs)
    excess = 100.0 * (float(position.max()) - 1.0)
    poles = closed.poles()
    damping = float(np.min(-poles.real / np.abs(poles)))
    why = f"it overshoots by {excess:.3g} % and rings with a damping ratio of {damping:.3g}"
    reproduced = closed.is_stable() and excess > 5.0 and damping < 0.2
    peak_time = float(time[position.argmax()])
    return decided(
        reproduced, why, ("overshoot", excess, "%"), ("its time", peak_time, "s"), ("least damping", damping)
    )


@measures("half-period")
def half_period(runs: Runs) -> Finding:
    """2 % settling time of the linear step response against half a period."""
    time = linear_settling_time(runs)
    why = f"the step response stays within 2 % after {time:.3g} s, and half a period lasts {PERIOD / 2:g} s"
    return decided(time < PERIOD / 2.0, why, ("2 % settling time", time, "s"), ("half period", PERIOD / 2.0, "s"))


@measures("structure-stable")
def structure_stable(runs: Runs) -> Finding:
    """Poles of G2."""
    slowest = float(np.max(runs.servo.G2().poles().real))
    return decided(
        slowest < 0.0, f"its slowest pole has the real part {slowest:.3g} 1/s", ("real part", slowest, "1/s")
    )


def _linear_step(runs: Runs) -> tuple[measure.Array, measure.Array]:
    """Time (s) and unit step response of the closed loop over 40 s."""
    time = np.linspace(0.0, PERIOD, 8001)
    return time, runs.servo.closed_loop().step(time)


def linear_settling_time(runs: Runs) -> float:
    """Time to stay within 2 % of 1, s."""
    return measure.settling_time(*_linear_step(runs), 1.0, measure.BAND)


def _smallest_margin_deg(margins: Margins) -> float:
    """Smallest distance of a stable loop's phase from -180 deg, on either side, over all gain crossovers."""
    return float(np.degrees(min(abs(one.phase_margin) for one in margins.gain_crossovers)))


def _without_integral(servo: Servo) -> Controller:
    """The printed gains with Ki = 0."""
    return servo.controller.replace(Ki=0.0)


def _with_loop_filter(servo: Servo) -> Controller:
    """The printed gains with the 20 Hz first-order filter of section 4.3."""
    return servo.controller.replace(loop_filter_hz=_LOOP_FILTER_HZ)
