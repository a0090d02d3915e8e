"""The gap of the lead screw as a play operator: the screw rests until the motor's side of the gap pushes it.

Sample by sample (`play`), and as the contact modes {-, open, +} of the servo's automaton.

theta_d is clamped to [theta_m - b, theta_m + b], b half the TOTAL gap. This is Eqs 16-18 read as the results need them:
theta_b there is the total gap (errata E2, E3 and E4): nothing jumps at a reversal, a growing gap
never moves the screw, and a shrinking one pushes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from servotwin.errors import InvalidInput
from servotwin.hybrid.compiled import compiled
from servotwin.plant.basis import BacklashKind, Basis, GuardRow, PlantNumbers, outer, rows_times, scaled
from servotwin.plant.friction import StickSlipMode, stillness, stopping_speed
from servotwin.plant.signals import Array


@compiled
def play_step(theta_d: float, theta_m: float, half_gap: float) -> float:
    """The screw's next angle (rad) for the motor's next angle: the clamp of theta_d to theta_m -+ half_gap."""
    return min(max(theta_d, theta_m - half_gap), theta_m + half_gap)


@compiled
def play_samples(theta_m: Array, half_gap: Array, theta_d0: float) -> Array:
    """Play without checks: (n,) motor angles and half gaps, (n,) or (1,)."""
    theta_d = np.empty_like(theta_m)
    now = theta_d0
    # A constant gap is one number: no array of equal ones has to be made.
    stride = 0 if half_gap.size == 1 else 1
    for i in range(theta_m.size):
        now = play_step(now, theta_m[i], half_gap[i * stride])
        theta_d[i] = now
    return theta_d


def play(theta_m: ArrayLike, gap: ArrayLike, theta_d0: float = 0.0) -> Array:
    """Angle of the screw behind a gap, sample by sample (Eqs 16-18 as a clamp).

    Exact for motor angles that are monotone between samples, with a gap that is too.

    Parameters
    ----------
    theta_m : (n,) array
        rad, angle of the motor.
    gap : float or (n,) array
        rad, TOTAL gap.
    theta_d0 : float
        rad, angle of the screw before the first sample; clamped into the gap there.

    Returns
    -------
    (n,) array
        rad, angle of the screw.

    Raises
    ------
    InvalidInput
        Shapes differ, a number is not finite, or the gap is negative somewhere.
    """
    angles = np.ascontiguousarray(theta_m, dtype=float)
    half = 0.5 * np.atleast_1d(np.ascontiguousarray(gap, dtype=float))
    if angles.ndim != 1 or half.shape not in ((1,), angles.shape):
        raise InvalidInput(
            f"play needs theta_m (n,) and a gap that is a number or (n,), not {angles.shape} and {half.shape}"
        )
    if not (np.all(np.isfinite(angles)) and np.all(np.isfinite(half)) and np.isfinite(theta_d0)):
        raise InvalidInput("play: theta_m, gap and theta_d0 must be finite, in rad")
    if np.any(half < 0.0):
        first = int(np.argmax(half < 0.0))
        raise InvalidInput(f"gap = {2.0 * half[first]:.6g} rad at sample {first} is negative; it must be 0 rad or more")
    return play_samples(angles, half, float(theta_d0))


_PUSHES = 2.0  # speeds below which a motor is at rest: faster, the flank of a stuck one pushes


@dataclass(frozen=True)
class ContactMode:
    """A mode of the backlash: in contact with the flank of a side, resting on it under part of the load, or open
    (side 0)."""

    name: str
    side: int
    resting: bool = False


_PLAIN = (ContactMode("-", -1), ContactMode("open", 0), ContactMode("+", 1))
# A load that acts back would push a slow motor off its flank, and nothing would keep it off: between the two it rests
# there under part of the load (the sliding mode of this automaton).
_ELASTIC = (*_PLAIN, ContactMode("held -", -1, resting=True), ContactMode("held +", 1, resting=True))
OPEN = 1
"""Index of the open mode."""


def contact_modes(servo: PlantNumbers) -> tuple[ContactMode, ...]:
    """All modes of the backlash."""
    return _ELASTIC if servo.backlash_kind is BacklashKind.HELD else _PLAIN


def screw_rate(servo: PlantNumbers, basis: Basis, contact: ContactMode) -> Array:
    """theta_d' of the play operator: in contact with the motor, less the half gap's own rate; zero in the gap and at
    rest on a flank (errata E3, E4). A free shaft relaxes in the gap: there its spring and damper balance."""
    if contact.side == 0 and servo.backlash_kind is BacklashKind.FREE:
        return _relaxing(servo, basis)
    if contact.side == 0 or contact.resting:
        return np.zeros(len(basis.names))
    return basis.row("speed") - 0.5 * contact.side * basis.row("gap'")


def _relaxing(servo: PlantNumbers, basis: Basis) -> Array:
    """Rate of a free shaft's load-side end in the gap: k_d (d - q_1) + c_d (d' - v_1) = 0; without a damper it is at
    q_1."""
    chain = servo.chain()
    states, half = basis.chain_states(chain), chain.A.shape[-1] // 2
    rate = _at_screw(servo, basis, states.start + half)
    if not np.any(chain.reaction_velocity):
        return rate
    twist = scaled_row(servo.p, basis.row("theta_d"))
    twist[..., states.start] -= 1.0
    return np.asarray(rate - chain.reaction_position / chain.reaction_velocity / servo.p * twist)


def _load_side(servo: PlantNumbers, basis: Basis) -> Array:
    """Row of a screw's load-side end in the gap, rad.

    Without a damper a free shaft's end is at q_1. Its state follows at the same speed, and comes off it by rounding:
    a contact by that state would begin with a pull, which ends it, without end.
    """
    chain = servo.chain()
    if servo.backlash_kind is not BacklashKind.FREE or np.any(chain.reaction_velocity):
        return basis.row("theta_d")
    return _at_screw(servo, basis, basis.chain_states(chain).start)


def _at_screw(servo: PlantNumbers, basis: Basis, place: int) -> Array:
    """Row of a state of the load as the screw sees it: over the ratio."""
    row = np.zeros((*np.shape(servo.p)[:-1], len(basis.names)))
    row[..., place] = np.squeeze(1.0 / np.asarray(servo.p))
    return row


def scaled_row(factor: float | Array, row: Array) -> Array:
    """A row times a number, or (P, 1) numbers."""
    return np.array(factor * row, dtype=float)


def screw_force(servo: PlantNumbers, basis: Basis, rate: Array) -> Array:
    """Row of the force of an elastic screw on its load, N, where its load-side end moves at a rate (row)."""
    chain = servo.chain()
    force = np.array(chain.reaction_position * servo.p * basis.row("theta_d"))
    force[..., basis.chain_states(chain)] += chain.reaction
    return force + chain.reaction_velocity * servo.p * rate if np.any(chain.reaction_velocity) else force


def flank(side: int, resting: bool = False) -> str:
    """Name of the mode on the flank of a side."""
    return next(mode.name for mode in _ELASTIC if mode.side == side and mode.resting == resting)


def contact_guards(
    servo: PlantNumbers,
    basis: Basis,
    contact: ContactMode,
    stick_slip: StickSlipMode,
    accelerations: Sequence[Array],
    resets: Mapping[int, Array],
) -> list[GuardRow]:
    """Guards that end a mode of the backlash.

    Parameters
    ----------
    stick_slip : StickSlipMode
    accelerations : sequence of (N,) rows
        Acceleration of the motor free of the load, and under all of it; used only where the motor rests on a flank and
        does not stick.
    resets : mapping of int to (..., N, N) array
        `contact_reset` of either side.
    """
    side = contact.side
    if side == 0:
        apart = basis.row("theta_m") - _load_side(servo, basis)
        return [
            GuardRow(s * apart - 0.5 * basis.row("gap"), "+" if s > 0 else "-", resets[s], "contact", s)
            for s in (1, -1)
        ]
    motor = stick_slip.motor
    if motor.stuck and servo.backlash_kind is BacklashKind.HELD:
        return _stuck_on_flank(basis, contact, stillness(servo, basis), resets[side])
    if contact.resting:
        # Relative to the flank, which accelerates with the half gap.
        free, pressed = (side * row - 0.5 * basis.row("gap''") for row in accelerations)
        ends = [
            GuardRow(pressed, flank(side), None, "contact", side),
            GuardRow(-free, "open", None, "release", side),
        ]
        # What slips off its flank does so although the load may pull it on.
        return ends[::-1] if motor.side == -side else ends
    rate = screw_rate(servo, basis, contact)
    if servo.backlash_kind is BacklashKind.FREE:
        # A flank pushes and never pulls.
        return [GuardRow(-side * screw_force(servo, basis, rate), "open", None, "release", side)]
    release = -side * rate - stopping_speed(servo, basis, stick_slip)
    if servo.backlash_kind is BacklashKind.RIGID:
        return [GuardRow(release, "open", resets[side], "release", side)]
    reset = resets[side].copy()
    # The motor stands on the flank and moves with it, at the rate of the half gap.
    reset[..., basis["speed"], :] = 0.5 * side * basis.row("gap'")
    return [GuardRow(release, flank(side, resting=True), reset, "hold", side)]


def _stuck_on_flank(basis: Basis, contact: ContactMode, still: Array, reset: Array) -> list[GuardRow]:
    """Guards of a motor that sticks on the flank of a screw that is held: the flank pushes the screw while the gap
    shrinks, rests while it is constant, and goes away while it grows."""
    side, apart = contact.side, 0.5 * basis.row("gap'")
    if not contact.resting:
        return [GuardRow(apart + still, flank(side, resting=True), None, "hold", side)]
    return [
        GuardRow(apart - still, "open", reset, "release", side),
        GuardRow(-apart - _PUSHES * still, flank(side), None, "contact", side),
    ]


def contact_reset(servo: PlantNumbers, basis: Basis, side: int) -> Array:
    """Put the screw on its flank; the chain's damper turns a jump of the screw into one of velocity (Eq 10)."""
    chain = servo.chain()
    size, lead = len(basis.names), chain.B_velocity.shape[:-1]
    reset = np.broadcast_to(np.eye(size), (*lead, size, size)).copy()
    moved = basis.row("theta_m") - 0.5 * side * basis.row("gap") - basis.row("theta_d")
    reset[..., basis["theta_d"], :] += moved
    reset[..., basis.chain_states(chain), :] += scaled(servo.p, outer(chain.B_velocity, moved))
    if np.any(chain.reaction_velocity):
        # The same impulse acts back on the motor.
        impulse = scaled_row(chain.reaction_velocity * np.square(servo.p), moved)
        reset[..., : basis["theta_d"], :] -= outer(servo.shaft().E, impulse)
    if "sensed" in basis:
        reset[..., basis["sensed"], :] = rows_times(basis.sensed_of(servo), reset)
    return reset
