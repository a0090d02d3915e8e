"""Flow of motor, driven end and load in one mode of the automaton."""

from __future__ import annotations

import numpy as np

from servotwin.plant.backlash import ContactMode, screw_force, screw_rate
from servotwin.plant.basis import BacklashKind, Basis, PlantNumbers, outer, rows_times, scaled
from servotwin.plant.friction import StickSlipMode, resistance
from servotwin.plant.signals import Array


def mechanical_flow(
    servo: PlantNumbers, basis: Basis, contact: ContactMode, stick_slip: StickSlipMode, command: Array
) -> Array:
    """(..., N, N) flow of motor, screw, chain and inputs in one mode; rows of the controller's states are zero.

    Parameters
    ----------
    command : (..., N) array
        Row of what the actuator gets, the input bias included.
    """
    chain, shaft = servo.chain(), servo.shaft()
    flow = np.zeros((*shaft.A.shape[:-2], len(basis.names), len(basis.names)))
    states, screw = basis.chain_states(chain), basis["theta_d"]
    motor = slice(0, screw)
    flow[..., motor, motor] = shaft.A
    flow[..., motor, :] += outer(shaft.B, command)
    resisting = resistance(basis, stick_slip.motor, "friction", basis["speed"], servo.motor_stribeck)
    flow[..., motor, :] -= outer(shaft.E, resisting)
    flow[..., screw, :] = screw_rate(servo, basis, contact)
    if contact.side == 0 and servo.backlash_kind is BacklashKind.FREE:
        flow[..., states, states] = chain.A_open
    else:
        flow[..., states, states] = chain.A
        pushed = outer(chain.B_position, basis.row("theta_d")) + outer(chain.B_velocity, flow[..., screw, :])
        flow[..., states, :] += scaled(servo.p, pushed)
    if contact.resting:
        # The motor moves with its flank, whose half gap changes at its own rate.
        flow[..., basis["speed"], :] = 0.5 * contact.side * basis.row("gap''")
    elif contact.side and servo.backlash_kind is not BacklashKind.RIGID:
        force = screw_force(servo, basis, flow[..., screw, :])
        flow[..., motor, :] -= scaled(servo.p, outer(shaft.E, force))
    if stick_slip.motor.stuck:
        flow[..., basis["speed"], :] = 0.0
    if "load force" in basis or "load friction" in basis:
        last, guide = basis.last_speed(servo), servo.guide
        resisting = resistance(basis, stick_slip.load, "load friction", last, guide.stribeck)
        flow[..., last, :] += (basis.row("load force") - resisting) / guide.mass
        if stick_slip.load.stuck:
            flow[..., last, :] = 0.0
    # A polynomial input is a chain of integrators: every derivative drives the one before it.
    for name in basis.names:
        if name + "'" in basis:
            flow[..., basis[name], :] = basis.row(name + "'")
    if "sensed" in basis:
        flow[..., basis["sensed"], :] = rows_times(basis.sensed_of(servo), flow)
    return flow
