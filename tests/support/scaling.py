"""The same machine in other units: slower or faster, larger or smaller, on another voltage."""

import math
import tomllib
from collections.abc import Mapping
from typing import Any, NamedTuple

from servotwin.config.toml import dumps
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
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


def scaled_window(window: Window, units: Units) -> Window:
    """The same window of a servo in other units."""
    factors = {"position": units.length, "reference": units.length, "voltage": units.voltage, "theta_m": 1.0}
    channels = {name: factors[name] * samples for name, samples in window.channels.items()}
    return Window(sample_rate=window.sample_rate / units.time, start=window.start * units.time, **channels)


# Keys of an axis's file without a unit, and powers of (time, length, torque, voltage) of those with one.
_PLAIN = ("torque_per_command", "enter_tolerances", "leave_tolerances", "notch_damping", "notch_depth")
_DIMENSIONS: Mapping[str, tuple[int, int, int, int]] = {
    "inertia_kg_m2": (2, 0, 1, 0),
    "current_loop_time_s": (1, 0, 0, 0),
    "velocity_loop_time_s": (1, 0, 0, 0),
    "viscous_friction_n_m_s_per_rad": (1, 0, 1, 0),
    "coulomb_friction_n_m": (0, 0, 1, 0),
    "resistance_ohm": (0, 0, 0, 1),
    "torque_gain_n_m_per_a": (0, 0, 1, 0),
    "back_emf_v_s_per_rad": (1, 0, 0, 1),
    "inductance_h": (1, 0, 0, 1),
    "lead_mm_per_rev": (0, 1, 0, 0),
    "pitch_m_per_rad": (0, 1, 0, 0),
    "stiffness_n_per_m": (0, -2, 1, 0),
    "damping_n_s_per_m": (1, -2, 1, 0),
    "mass_kg": (2, -2, 1, 0),
    "friction_n": (0, -1, 1, 0),
    "friction_n_m": (0, 0, 1, 0),
    "position_resolution_m": (0, 1, 0, 0),
    "encoder_resolution_rad": (0, 0, 0, 0),
    "kp_n_m_per_m": (0, -1, 1, 0),
    "ki_n_m_per_m_s": (-1, -1, 1, 0),
    "kd_n_m_s_per_m": (1, -1, 1, 0),
    "kp_v_per_m": (0, -1, 0, 1),
    "ki_v_per_m_s": (-1, -1, 0, 1),
    "kd_v_s_per_m": (1, -1, 0, 1),
    "filter_time_s": (1, 0, 0, 0),
    "torque_limit_n_m": (0, 0, 1, 0),
    "voltage_limit_v": (0, 0, 0, 1),
    "sample_rate_hz": (-1, 0, 0, 0),
    "kp_n_m_per_rad": (0, 0, 1, 0),
    "ki_n_m_per_rad_s": (-1, 0, 1, 0),
    "kd_n_m_s_per_rad": (1, 0, 1, 0),
    "kp_rad_per_s_per_rad": (-1, 0, 0, 0),
    "ki_rad_per_s_per_rad_s": (-2, 0, 0, 0),
    "kd_rad_per_s_s_per_rad": (0, 0, 0, 0),
    "kp_rad_per_m": (0, -1, 0, 0),
    "ki_rad_per_m_s": (-1, -1, 0, 0),
    "kd_rad_s_per_m": (1, -1, 0, 0),
    "smoothing_time_s": (1, 0, 0, 0),
    "speed_limit_rad_per_s": (-1, 0, 0, 0),
    "velocity_time_s": (1, 0, 0, 0),
    "stiffness_n_m_per_rad": (0, 0, 1, 0),
    "damping_n_m_s_per_rad": (1, 0, 1, 0),
    "position_gain_per_s": (-1, 0, 0, 0),
    "velocity_gain_n_m_s_per_rad": (1, 0, 1, 0),
    "integral_time_s": (1, 0, 0, 0),
    "speed_filter_s": (1, 0, 0, 0),
    "reference_filter_s": (1, 0, 0, 0),
    "position_resolution_rad": (0, 0, 0, 0),
    "travel_m_per_rad": (0, 1, 0, 0),
    "travel_rad_per_rad": (0, 0, 0, 0),
    "ratio": (0, 0, 0, 0),
} | dict.fromkeys(_PLAIN, (0, 0, 0, 0))


class AxisUnits(NamedTuple):
    """Factors on times, lengths of the load, torques of the motor and voltages."""

    time: float = 1.0
    length: float = 1.0
    torque: float = 1.0
    voltage: float = 1.0


def scaled_axis(axis: Axis, units: AxisUnits) -> Axis:
    """The same axis in other units; its release time is the default in those, and a rotary load has no length."""
    return Axis.loads(dumps(_scaled_table(tomllib.loads(axis.dumps()), units)), "scaled.toml")


def _scaled_table(table: Mapping[str, Any], units: AxisUnits) -> dict[str, Any]:
    return {
        key: _scaled_table(value, units) if isinstance(value, dict) else _scaled_value(key, value, units)
        for key, value in table.items()
        if key != "release_time_s"
    }


def _scaled_value(key: str, value: Any, units: AxisUnits) -> Any:
    if isinstance(value, str | bool) or value == 0.0:
        return value
    if isinstance(value, list):
        return [_scaled_value(key, each, units) for each in value]
    powers = zip(units, _DIMENSIONS[key], strict=True)
    return value * math.prod(unit**power for unit, power in powers)
