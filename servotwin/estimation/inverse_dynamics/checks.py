"""Refusal of recordings that do not show a drive's parameters, each with what to do instead."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion
from servotwin.estimation.inverse_dynamics.fit import ParameterFit, Rows, solved
from servotwin.estimation.inverse_dynamics.fitted_cascade import GivenGains, fitted_cascade
from servotwin.estimation.inverse_dynamics.recording import DriveRecording, Mask
from servotwin.plant.signals import Array

_COUNTS = 20.0  # of the encoder: a smaller motion shows its counts
_AT_LIMIT = 0.1  # of the moving samples: beyond, the recording shows the limit
_EXTREME = 1e-6  # of the command's range: so near the largest value it is at its limit
_ONE_WAY = 0.02  # of the way: share in the rarer direction
_SAME_SPEED = 0.1  # of the speed: part that is no combination of its sign and the others
_STEADY = 0.02  # of the acceleration, likewise
_UNEXPLAINED = 0.7  # of the force
_JUMP, _FAST = 10.0, 0.999  # times the way from sample to sample, and its quantile
_LEFT_OF_TWO = 0.3  # of what one drive's parameters leave: two drives' do not leave more
_OTHER_INERTIA = 1.2  # ratio of two drives' inertias


def at_limit(recording: DriveRecording) -> Mask:
    """Samples whose command is at its largest or smallest value, where it stays there for a while."""
    force = recording.force
    near = _EXTREME * float(np.ptp(force))
    mask = (force >= force.max() - near) | (force <= force.min() + near)
    # A maximum that is passed through has one sample.
    return np.asarray(mask & (np.roll(mask, 1) | np.roll(mask, -1)))


def without_limit(recording: DriveRecording) -> DriveRecording:
    """The recording with its limit, and without the samples at which the command is there."""
    limited = at_limit(recording)
    if not limited.any():
        return recording
    return replace(recording, usable=recording.usable & ~limited, limit=float(np.abs(recording.force[limited]).max()))


def check_motion(recording: DriveRecording) -> None:
    """Refuse a recording without motion or without a command.

    Raises
    ------
    InvalidInput
    """
    reach, unit = float(np.ptp(recording.position)), recording.unit
    if reach == 0.0:
        raise InvalidInput(
            f"{recording.source}: the position is {recording.position[0]:.6g} {unit} throughout: record a motion to "
            "and fro at several speeds, or is --motor another column?"
        )
    if not reach > _COUNTS * recording.resolution:
        raise InvalidInput(
            f"{recording.source}: the position moves by {reach:.3g} {unit} only, {_COUNTS:g} counts of the encoder are "
            f"{_COUNTS * recording.resolution:.3g} {unit}: record a motion to and fro at several speeds"
        )
    if float(np.ptp(recording.force)) == 0.0:
        raise InvalidInput(
            f"{recording.source}: the command is {recording.force[0]:g} {recording.force_unit} throughout: record the "
            "torque, current or voltage that the controller demands"
        )
    steps = np.diff(recording.position)
    place, usual = int(np.argmax(np.abs(steps))), float(np.quantile(np.abs(steps), _FAST))
    if abs(steps[place]) > _JUMP * max(usual, recording.resolution):
        raise InvalidInput(
            f"{recording.source}: {(place + 1) / recording.rate:.4g} s after its start the position jumps by "
            f"{steps[place]:+.3g} {unit}, and otherwise by at most {usual:.3g} {unit} from sample to sample: the "
            "encoder slipped, its unit changes, or two logs were joined; give each part by itself"
        )


def check_one_drive(recording: DriveRecording, rows: Rows) -> None:
    """Refuse a recording of which two parts have two inertias, and next to nothing is left then.

    Raises
    ------
    InvalidInput
    """
    design, blocks = rows.design[:, :4], rows.blocks
    whole = _fit_of(design, rows.force)
    tried = []
    for block in np.unique(blocks)[1:]:
        behind = blocks >= block
        one, other = (_fit_of(design[part], rows.force[part]) for part in (~behind, behind))
        tried.append((math.hypot(one.left, other.left), one.inertia, other.inertia, int(np.argmax(behind))))
    left, before, after, place = min(tried)
    differ = min(before, after) > 0.0 and max(before, after) > _OTHER_INERTIA * min(before, after)
    if left < _LEFT_OF_TWO * whole.left and differ:
        raise InvalidInput(
            f"{recording.source}: in the first {100.0 * place / len(blocks):.0f} % of the motion the inertia is "
            f"{before:.4g}, and {after:.4g} in the rest: two drives, loads or units in one log; give each by itself"
        )


class _PartFit(NamedTuple):
    """Inertia, and norm of the force that is left."""

    inertia: float
    left: float


def _fit_of(design: Array, force: Array) -> _PartFit:
    values = solved(design, force)
    return _PartFit(float(values[0]), float(np.linalg.norm(force - design @ values)))


def check_limit(recording: DriveRecording, motion: DriveMotion) -> None:
    """Refuse a recording whose command is at its limit for long.

    Raises
    ------
    InvalidInput
    """
    moving = ~motion.resting
    share = float(np.mean(at_limit(recording)[moving])) if moving.any() else 0.0
    if share > _AT_LIMIT:
        largest = float(np.abs(recording.force).max())
        raise InvalidInput(
            f"{recording.source}: the command is at its limit of {largest:.4g} {recording.force_unit} in "
            f"{100.0 * share:.0f} % of the motion, and the drive may have given less than it says: record smaller "
            "accelerations, or state --applied where the log holds what the drive gave"
        )


def check_directions(recording: DriveRecording, motion: DriveMotion) -> None:
    """Refuse a recording that moves in one direction only.

    Raises
    ------
    InvalidInput
    """
    moving = motion.speed[~motion.resting]
    way = float(np.abs(moving).sum())
    forward = float(moving[moving > 0.0].sum()) / way if way else 0.0
    if not _ONE_WAY < forward < 1.0 - _ONE_WAY:
        side = "forwards" if forward > 0.5 else "backwards"
        raise InvalidInput(
            f"{recording.source}: the motion goes {side} only, so that Coulomb friction and a constant force cannot be "
            "told apart: record strokes in both directions"
        )


def check_separable(recording: DriveRecording, rows: Rows) -> None:
    """Refuse a motion at one speed, or without acceleration.

    Raises
    ------
    InvalidInput
    """
    design = rows.design[:, :4]
    inertia, viscous, _, _ = (_own_part(design, place) for place in range(4))
    if inertia < _STEADY:
        raise InvalidInput(
            f"{recording.source}: the motion hardly accelerates ({100.0 * inertia:.2g} % of the acceleration is "
            "its own): the inertia does not show; record strokes with sharper reversals"
        )
    if viscous < _SAME_SPEED:
        raise InvalidInput(
            f"{recording.source}: the motion has one speed only ({100.0 * viscous:.2g} % of the speed is no constant "
            "times its sign): viscous and Coulomb friction cannot be told apart; record strokes at three or more speeds"
        )


def check_sense(recording: DriveRecording, fit: ParameterFit) -> None:
    """Refuse parameters that no drive has: the columns or the command's sign are wrong.

    Raises
    ------
    InvalidInput
    """
    inertia, half, unit = fit["inertia"], fit.half_width("inertia"), recording.inertia_unit
    if fit.relative_error <= _UNEXPLAINED and inertia < -half:
        raise InvalidInput(
            f"{recording.source}: the command acts against the motion (inertia {inertia:.3g} {unit}): its sign is "
            "wrong, turn it with a negative --scale; or --motor and --command are swapped"
        )
    if fit.relative_error <= _UNEXPLAINED and inertia <= half:
        raise InvalidInput(
            f"{recording.source}: the inertia does not show ({inertia:.3g} ± {half:.2g} {unit}, 95 %), although "
            f"inertia and friction explain {100.0 * (1.0 - fit.relative_error**2):.0f} % of the command: record longer "
            "strokes at several speeds, whose accelerations last for many samples; or are --motor and --command mixed "
            "up?"
        )
    if fit.relative_error > _UNEXPLAINED:
        raise InvalidInput(
            f"{recording.source}: inertia and friction explain {100.0 * (1.0 - fit.relative_error**2):.0f} % of the "
            "command only: is --command what this drive gets, and --motor its position (not the "
            "reference, the speed or another axis)?"
        )


def _own_part(design: Array, place: int) -> float:
    """Norm of what the other columns do not explain of one, over its own."""
    column, others = design[:, place], np.delete(design, place, axis=1)
    norms = np.linalg.norm(others, axis=0)
    scaled = others / np.where(norms > 0.0, norms, 1.0)
    left = column - scaled @ np.linalg.lstsq(scaled, column, rcond=None)[0]
    size = float(np.linalg.norm(column))
    return float(np.linalg.norm(left)) / size if size > 0.0 and math.isfinite(size) else 0.0


def check_reference(recording: DriveRecording, gains: GivenGains) -> None:
    """Refuse a reference that is the position, and a position that is the reference.

    Raises
    ------
    InvalidInput
    """
    assert recording.reference is not None
    swapped = replace(recording, reference=recording.position, position=recording.reference)
    if fitted_cascade(swapped, gains).explains:
        raise InvalidInput(f"{recording.source}: --reference and --motor are swapped: the reference lags the position")
