"""From recordings of a drive to an axis with its uncertainty: `commission`."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from servotwin.analysis.tuning.cascade import tune_cascade
from servotwin.control.cascade import Cascade
from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.closed_loop import rigid_axis
from servotwin.estimation.inverse_dynamics.conditioning import motion_of
from servotwin.estimation.inverse_dynamics.fit import ParameterFit
from servotwin.estimation.inverse_dynamics.fitted_cascade import GivenGains
from servotwin.estimation.inverse_dynamics.identify import GivenLaw, IdentifiedDrive, identify_drive
from servotwin.estimation.inverse_dynamics.shaft import ShaftResponse
from servotwin.logs.cleaning import SHARED
from servotwin.logs.clocks import WHOLE
from servotwin.logs.drive_recordings import DriveColumns, DriveLog, read_drive_log
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import LOAD, MOTOR
from servotwin.plant.transmission import FREE, Transmission
from servotwin.redesign.certified.uncertainty import Uncertainty

_WIDEST = 0.99  # relative half-width that an uncertainty may have
# Relative errors beyond the statistical ones that derivatives and a gap in the shaft brought (test_shaft).
_SHAFT = {"m": 0.03, "k": 0.1, "c": 0.5}
_SINE = 2.0 * math.sqrt(2.0)  # range of a sine over its standard deviation
_APART = 5.0  # crossovers of velocity and position loop, to begin with
_PHASE_MARGIN = math.radians(60.0)
_BY_NAME, _FITTED = DriveColumns(), GivenGains()


@dataclass(frozen=True, eq=False)
class CommissionedAxis:
    """Parameters, controller and axis of a drive, from recordings.

    Attributes
    ----------
    logs : tuple of DriveLog
    drive : IdentifiedDrive
    axis : Axis or None
        None where no controller is known.
    uncertainty : Uncertainty
        Of that axis: 95 % of its parameters, beside the defaults of what the recordings do not show.
    force_per_command : float or None
        N (rotary: N m) per unit of the command; None: unknown, inertia and friction are in units of the command.
    """

    logs: tuple[DriveLog, ...]
    drive: IdentifiedDrive
    axis: Axis | None
    uncertainty: Uncertainty
    force_per_command: float | None

    @property
    def best(self) -> ParameterFit:
        """The refined fit, or the first where there is no refinement."""
        refined = self.drive.refinement
        return self.drive.symmetric if refined is None or not refined.converged else refined.symmetric

    @property
    def asymmetric(self) -> ParameterFit:
        """The fit with a friction for each direction, of the same kind."""
        refined = self.drive.refinement
        return self.drive.asymmetric if refined is None or not refined.converged else refined.asymmetric


def commission(
    logs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    columns: DriveColumns = _BY_NAME,
    *,
    gains: GivenLaw = _FITTED,
    inertia: float | None = None,
    feedback: str = MOTOR,
    applied: bool = False,
    crossover: float | None = None,
) -> CommissionedAxis:
    """Identify a drive from logs of its command and position in closed loop.

    Parameters
    ----------
    logs : path or sequence of paths
        Of one drive; the first one's reference is simulated.
    columns : DriveColumns
        Which columns and units; by default found by their names.
    gains : GivenGains or GivenPid
        Of the controller that ran, in units of the command and of m (rotary: rad) of the position; fitted where they
        are not given.
    inertia : float, optional
        kg (rotary: kg m^2) of all that moves, seen from the load: gives the force per command where no scale is known.
    feedback : {"motor", "load"}
        Encoder of the axis on which the position is controlled; with "load" it gets an encoder at the load as fine as
        the motor's, which the twin needs.
    applied : bool
        The command of the logs is what the drive gave, also at its limit.
    crossover : float, optional
        rad/s, of the velocity loop: the axis gets a cascade that is tuned to it, with a phase margin of 60 degrees.
        None: the controller that ran.

    Raises
    ------
    InvalidInput
        A log cannot be read, logs are of different kinds, or they do not show the parameters.
    """
    paths = [logs] if isinstance(logs, str | os.PathLike) else list(logs)
    if not paths:
        raise InvalidInput("commission: give at least one log")
    if feedback not in (MOTOR, LOAD):
        raise InvalidInput(f"commission: feedback {feedback!r}: must be {MOTOR!r} or {LOAD!r}")
    read = tuple(read_drive_log(Path(path), columns) for path in paths)
    _check_alike(read)
    read = read if inertia is None else _scaled(read, inertia, gains, applied)
    first = read[0].recording
    scale = first.force_per_command
    gains = gains if scale is None else gains.scaled(abs(scale))
    travel = 1.0 if read[0].travel is None else read[0].travel
    drive = _without_hidden_shaft(read[0], _identified(read, gains, travel, applied))
    found = CommissionedAxis(read, drive, None, Uncertainty(), scale)
    lag = drive.refinement.lag if drive.refinement is not None and drive.refinement.converged else 0.0
    axis = None if drive.law is None else rigid_axis(found.best, drive.law, first, travel, lag)
    if axis is not None and drive.shaft is not None and drive.split is not None:
        axis = _with_shaft(axis, drive.shaft, drive.split)
    if axis is not None and feedback == LOAD:
        axis = _with_load_encoder(axis, first.load_resolution or first.resolution)
    if axis is not None and crossover is not None:
        axis = replace(
            axis, controller=tune_cascade(_with_cascade(axis, crossover), crossover, _PHASE_MARGIN).controller
        )
    if axis is not None:
        # That of the loop as it is now, with the shaft and the gains found.
        axis = replace(axis, controller=axis.controller.replace(release_time=None))
    return replace(found, axis=axis, uncertainty=_uncertainty(found, travel))


def _identified(logs: Sequence[DriveLog], gains: GivenLaw, travel: float, applied: bool) -> IdentifiedDrive:
    """The drive that the logs show; a refusal names times whose unit or place was assumed."""
    try:
        return identify_drive([log.recording for log in logs], gains, travel, applied)
    except InvalidInput as error:
        if any(WHOLE in log.found for log in logs):
            raise InvalidInput(f"{error}; or its {WHOLE}") from None
        if shared := sum(log.found.get(SHARED, 0) for log in logs):
            raise InvalidInput(
                f"{error}; {shared} of its samples have the time stamp of the one before: give --rate in Hz, or record "
                "finer stamps"
            ) from None
        raise


def _check_alike(logs: Sequence[DriveLog]) -> None:
    first = logs[0].recording
    for each in (log.recording for log in logs[1:]):
        if (each.rotary, each.force_unit) != (first.rotary, first.force_unit):
            raise InvalidInput(
                f"{each.source}: counts in {each.unit} and {each.force_unit}, {first.source} in {first.unit} and "
                f"{first.force_unit}: the logs must be of one drive"
            )


def _scaled(logs: Sequence[DriveLog], inertia: float, gains: GivenLaw, applied: bool) -> tuple[DriveLog, ...]:
    """The logs with the force per command that gives the known inertia."""
    if not (math.isfinite(inertia) and inertia > 0.0):
        raise InvalidInput(f"commission: --inertia {inertia!r}: must be positive and finite")
    first = logs[0].recording
    if first.force_per_command is not None:
        raise InvalidInput(
            f"{first.source}: the force per command is known already ({first.force_per_command:g} {first.force_unit}): "
            "leave out --inertia"
        )
    bare = [replace(log, recording=replace(log.recording, reference=None)) for log in logs]
    unscaled = _identified(bare, gains, 1.0, applied)
    scale = inertia / unscaled.symmetric["inertia"]
    return tuple(
        replace(log, recording=replace(log.recording, force=log.recording.force * scale, force_per_command=scale))
        for log in logs
    )


def _without_hidden_shaft(log: DriveLog, drive: IdentifiedDrive) -> IdentifiedDrive:
    """The drive without inertias at a shaft whose elastic deflection is less than the lost motion, which hides it."""
    recording, lost, shaft = log.recording, log.lost_motion, drive.shaft
    if drive.split is None or shaft is None or recording.load is None or lost is None:
        return drive
    acceleration = motion_of(recording.load, recording.rate, drive.bands[0]).acceleration
    deflection = _SINE * float(np.std(acceleration)) / (2.0 * math.pi * shaft.resonance) ** 2
    return replace(drive, split=None) if lost.at_load > deflection else drive


def _with_shaft(axis: Axis, shaft: ShaftResponse, split: ParameterFit) -> Axis:
    """The axis with its inertia divided, on a shaft that is free in its gap."""
    motor, load, p = split["motor_inertia"], split["load_inertia"], axis.p
    actuator = replace(axis.actuator, J=motor * p * p)  # type: ignore[arg-type]
    screw = Transmission(p, shaft.stiffness(load), shaft.shaft_damping(load), FREE)
    return replace(axis, actuator=actuator, transmission=screw, load=Load((load,), motion=axis.load.motion))


def _with_load_encoder(axis: Axis, resolution: float) -> Axis:
    law = axis.controller.replace(on=LOAD) if isinstance(axis.controller, Cascade) else axis.controller
    sensors = replace(axis.sensors, position_resolution=resolution, feedback=LOAD)
    return replace(axis, controller=law, sensors=sensors)


def _with_cascade(axis: Axis, crossover: float) -> Axis:
    """The axis with a cascade to be tuned; where a PID ran, with one of that crossover (rad/s)."""
    own = axis.controller
    if isinstance(own, Cascade):
        return axis
    gain = crossover * axis.load.m[0] * axis.p * axis.p
    law = Cascade(
        crossover / _APART,
        axis.p,
        gain,
        on=axis.sensors.feedback,
        voltage_limit=own.voltage_limit,
        sample_rate=own.sample_rate,
    )
    return replace(axis, controller=law)


def _uncertainty(found: CommissionedAxis, p: float) -> Uncertainty:
    """95 % of the parameters; friction covers both directions of the motion too."""
    fit, sides = found.best, found.asymmetric
    inertia = fit.half_width("inertia") / fit["inertia"]
    sided = [sides[name] for name in ("viscous_forward", "viscous_backward")]
    widest = [abs(each - fit["viscous"]) for each in sided]
    viscous = (fit.half_width("viscous") + max(widest)) / fit["viscous"] if fit["viscous"] > 0.0 else _WIDEST
    coulomb = max(fit["coulomb"], sides["coulomb_forward"], sides["coulomb_backward"]) - fit["coulomb"]
    offset, half = -fit["offset"] * p, fit.half_width("offset") * p
    shaft, known = found.drive.shaft, Uncertainty()
    if shaft is not None and found.drive.split is not None:
        mass = found.drive.split
        load = _SHAFT["m"] + mass.half_width("load_inertia") / abs(mass["load_inertia"])
        stiffness = load + _SHAFT["k"] + 4.0 * shaft.resonance_std / shaft.resonance
        damping = load + _SHAFT["c"] + 2.0 * shaft.damping_std / shaft.damping if shaft.damping > 0.0 else _WIDEST
        known = known.replace(m=min(load, _WIDEST), k=min(stiffness, _WIDEST), c=min(damping, _WIDEST))
    return known.replace(
        # The inertia of a rigid axis turns with the motor: less inertia is more torque per inertia.
        k_T=min(inertia, _WIDEST),
        k_B=min(viscous, _WIDEST),
        friction=(0.0, (coulomb + fit.half_width("coulomb")) * p),
        input_bias=(offset - half, offset + half),
    )
