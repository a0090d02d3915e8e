"""The same machine in other units: slower or faster, larger or smaller, on another voltage."""

from typing import NamedTuple

from servotwin.plant.servo import Servo


class Units(NamedTuple):
    """Factors on times, lengths and voltages."""

    time: float = 1.0
    length: float = 1.0
    voltage: float = 1.0


def scaled(servo: Servo, time: float = 1.0, length: float = 1.0, voltage: float = 1.0) -> Servo:
    """The same servo in other units: every solution is the same but for its scale."""
    law, per = servo.controller, voltage / length
    changed = servo.replace(
        R=servo.R * voltage,
        L=servo.L * voltage * time,
        k_B=servo.k_B * voltage * time,
        J=servo.J * time**2,
        p=servo.p * length,
        k=tuple(servo.stiffnesses / time**2),
        c=tuple(servo.dampings / time),
        position_resolution=servo.position_resolution * length,
        Kp=law.Kp * per,
        Ki=law.Ki * per / time,
        Kd=law.Kd * per * time,
        Tf=law.Tf * time,
        feedforward=law.feedforward * voltage,
    )
    limits = {
        "sample_rate": None if law.sample_rate is None else law.sample_rate / time,
        "loop_filter_hz": None if law.loop_filter_hz is None else law.loop_filter_hz / time,
        "voltage_limit": None if law.voltage_limit is None else law.voltage_limit * voltage,
        "rate_limit": None if law.rate_limit is None else law.rate_limit * voltage / time,
    }
    tracking = None if law.tracking_time is None else law.tracking_time * time
    return changed.replace(**limits, tracking_time=tracking, release_time=law.release_time * time)
