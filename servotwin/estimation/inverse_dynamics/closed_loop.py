"""Closed-loop simulation of an identified drive beside its log, and the fit to the simulated motion.

The regressors of the first fit are derivatives of a measured position. Here they are those of the simulated motion,
free of its noise, until the parameters come to rest: direct and inverse dynamic identification (Gautier, Janot and
Vandanjon, A new closed-loop output error method for parameter identification of robot dynamics, IEEE TCST 2013).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.linear_law import MOTOR
from servotwin.estimation.inverse_dynamics.command_delay import DELAY, derivative
from servotwin.estimation.inverse_dynamics.conditioning import (
    DriveMotion,
    RegressionBand,
    busiest,
    low_passed,
    motion_of,
)
from servotwin.estimation.inverse_dynamics.fit import (
    ASYMMETRIC,
    SYMMETRIC,
    ParameterFit,
    Rows,
    fit_models,
    regressors,
    rows_of,
)
from servotwin.estimation.inverse_dynamics.fitted_cascade import FittedCascade
from servotwin.estimation.inverse_dynamics.fitted_pid import FittedPid
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.estimation.inverse_dynamics.unmodelled import Unmodelled, effects_of, unmodelled
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import LINEAR, ROTARY, Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import Array, Samples
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

FittedLaw = FittedCascade | FittedPid
_ROUNDS, _LATE_ROUNDS = 8, 12
_CONVERGED = 1e-3  # relative change of the inertia's force; of the others' also relative to Coulomb friction
_RESTS, _LEAST_LAG = 0.1, 0.01  # samples: change of the lag, least lag
_TRACKS = 0.05  # of the position: a simulation that leaves more is not near enough for its motion to be used


@dataclass(frozen=True, eq=False)
class SimulatedLog:
    """A simulation beside its log.

    Attributes
    ----------
    position, force : (n,) array
        In the recording's units.
    position_error, force_error : float
        Norm of the difference over that of the log; forces are compared in the band of the regression.
    """

    position: Array
    force: Array
    position_error: float
    force_error: float


@dataclass(frozen=True, eq=False)
class Refinement:
    """Fits to the simulated motion, if they converged, and the lag of the drive's force behind its command, s.

    Their intervals contain what `effects` beside the parameters do.
    """

    symmetric: ParameterFit
    asymmetric: ParameterFit
    simulated: SimulatedLog
    converged: bool
    lag: float = 0.0
    effects: Unmodelled | None = None


def rigid_axis(fit: ParameterFit, law: FittedLaw, recording: DriveRecording, p: float, lag: float = 0.0) -> Axis:
    """The axis that a fit describes: a torque drive on a rigid transmission, p travel per radian of the motor.

    Raises
    ------
    InvalidInput
        A parameter is out of its range.
    """
    inertia = fit["inertia"]
    return Axis(
        TorqueDrive(
            inertia * p * p, lag, friction=max(fit["viscous"], 0.0) * p * p, coulomb=max(fit["coulomb"], 0.0) * p
        ),
        Transmission(p),
        # Rigid with the motor, whose inertia contains it.
        Load((inertia,), motion=ROTARY if recording.rotary else LINEAR),
        _controller(law, recording, p),
        Sensors(recording.resolution / p, 0.0 if law.on == MOTOR else recording.load_resolution, law.on),
    )


def _controller(law: FittedLaw, recording: DriveRecording, p: float) -> Cascade | Controller:
    limit = None if recording.limit is None else recording.limit * p
    if isinstance(law, FittedPid):
        return Controller(
            Kp=law.Kp * p, Ki=law.Ki * p, Kd=law.Kd * p, Tf=law.Tf, voltage_limit=limit, sample_rate=recording.rate
        )
    return Cascade(
        position_gain=law.position_gain,
        ratio=p,
        velocity_gain=law.velocity_gain * p * p,
        integral_time=law.integral_time,
        speed_filter=law.speed_filter,
        on=law.on,
        voltage_limit=limit,
        sample_rate=recording.rate,
    )


def simulated_log(axis: Axis, offset: float, recording: DriveRecording, band: RegressionBand) -> SimulatedLog:
    """Run the axis along the recording's reference; `offset` is a force that resists the forward motion."""
    assert recording.reference is not None
    start, size = recording.position[0], recording.position.size
    run = simulate(
        axis,
        (size - 1) / recording.rate,
        reference=Samples(tuple(np.arange(size) / recording.rate), tuple(recording.reference - start)),
        sample_rate=recording.rate,
        input_bias=-offset * axis.p,
    )
    position, force = run.theta_m * axis.p + start, run.voltage / axis.p
    both = low_passed(np.column_stack([recording.force, force]), band.corner, recording.rate)
    return SimulatedLog(
        position,
        force,
        _relative(recording.position - start, position - start),
        _relative(both[:, 0], both[:, 1]),
    )


def refine(
    first: ParameterFit,
    law: FittedLaw,
    recording: DriveRecording,
    band: RegressionBand,
    cycle: float,
    p: float,
    lag: float,
) -> Refinement | None:
    """Fit the recorded force to the simulated motion until the parameters rest; None: the simulation does not track, or
    the fit leaves what an axis can be.

    A lag (s) is fitted beside them, from its first value; 0: the drive follows its command at once.
    """
    fit, late = first, lag > 0.0
    for _ in range(_LATE_ROUNDS if late else _ROUNDS):
        simulated = simulated_log(rigid_axis(fit, law, recording, p, lag), fit["offset"], recording, band)
        if not simulated.position_error < _TRACKS:
            return None
        motion = motion_of(simulated.position, recording.rate, band)
        compared = _compared(recording, motion, fit, simulated)
        rows = rows_of(compared, motion, band, cycle, derivative(recording, simulated.force))
        both = fit_models(rows, DELAY if late else ())
        symmetric, asymmetric = both[0].only(SYMMETRIC), both[1].only(ASYMMETRIC)
        converged = _rests(fit, symmetric, rows)
        slower = both[0]["delay"] if late else 0.0
        converged = converged and abs(slower) <= _RESTS / recording.rate
        found, modelled, fit = Refinement(symmetric, asymmetric, simulated, converged, lag), fit, symmetric
        if not symmetric["inertia"] > 0.0:  # it runs away, towards an axis that cannot be
            return None
        if converged:
            break
        lag = max(lag + slower, _LEAST_LAG / recording.rate) if late else 0.0
    return _with_unmodelled(found, _effects(compared, motion, band, cycle, modelled, late))


def _rests(before: ParameterFit, now: ParameterFit, rows: Rows) -> bool:
    """If no parameter changes the force that it makes by much."""
    sizes = np.linalg.norm(rows.design[:, : len(SYMMETRIC)], axis=0)
    forces, changes = sizes * np.abs(before.values), sizes * np.abs(now.values - before.values)
    forces[1:] = np.maximum(forces[1:], forces[SYMMETRIC.index("coulomb")])
    return bool(np.all(changes < _CONVERGED * forces))


def _effects(
    compared: DriveRecording, motion: DriveMotion, band: RegressionBand, cycle: float, fit: ParameterFit, late: bool
) -> Unmodelled | None:
    """Effects beside the parameters, by a force that is compared with the simulated one."""
    part, moved = busiest(compared, motion)
    effects = effects_of(moved, band, part.position, fit)
    shared = derivative(part, part.force) if late else np.empty((part.force.size, 0))
    return unmodelled(rows_of(part, moved, band, cycle, np.column_stack([shared, effects.columns])), effects)


def _with_unmodelled(found: Refinement, effects: Unmodelled | None) -> Refinement:
    """The refinement, its intervals with what effects beside the parameters do."""
    if effects is None:
        return found
    symmetric, asymmetric = effects.widened((found.symmetric, found.asymmetric))
    return replace(found, symmetric=symmetric, asymmetric=asymmetric, effects=effects)


def _compared(
    recording: DriveRecording, motion: DriveMotion, fit: ParameterFit, simulated: SimulatedLog
) -> DriveRecording:
    """The recording with the force of the model, and by how much the log's differs from the simulated one.

    What derivatives and the hold of a sampled command do to the simulation they do to the log, and cancel.
    """
    modelled = regressors(motion)[:, : len(SYMMETRIC)] @ fit.values
    return replace(recording, force=modelled + recording.force - simulated.force)


def _relative(measured: Array, simulated: Array) -> float:
    return float(np.linalg.norm(measured - simulated) / np.linalg.norm(measured))
