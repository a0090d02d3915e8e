"""Windows as estimators take them: readings of late encoders at the samples whose motion they show, and the angle of a
motor that has no encoder."""

from __future__ import annotations

from collections.abc import Mapping

from servotwin.estimation.commanded_angle import has_commanded_angle, samples_fading, with_commanded_angle
from servotwin.estimation.motors_position import is_motors_position
from servotwin.estimation.window import Window
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array


def samples_late(plant: Plant, rate: float) -> int:
    """Samples at a rate (Hz) by which a prompt window is shorter: of late encoders, or of a motor without one."""
    late = max(plant.sensors.motor.late(rate), plant.sensors.load.late(rate))
    return late + (samples_fading(plant, rate) if has_commanded_angle(plant) else 0)


def prompt_window(window: Window, plant: Plant) -> Window:
    """The window as of when its readings were true, with the motor's angle.

    Where the motor has no encoder its angle comes from the command (`with_commanded_angle`).

    Raises
    ------
    InvalidInput
        The motor's angle is neither measured nor follows from the command.
    """
    return on_time(with_commanded_angle(window, plant), plant)


def on_time(window: Window, plant: Plant) -> Window:
    """The window with the readings of a plant's late encoders moved to when they were true, in whole samples.

    What is left of a delay is at most half a sample. Commands and reference stay; the end is shorter by the longest
    delay.
    """
    motor, load = plant.sensors.motor.late(window.sample_rate), plant.sensors.load.late(window.sample_rate)
    if is_motors_position(window, plant):
        load = motor
    if motor == load == 0:
        return window
    late: Mapping[str, int] = {"theta_m": motor, "position": load}
    kept = window.samples - max(late.values())
    channels: dict[str, Array] = {
        name: values[late.get(name, 0) : late.get(name, 0) + kept] for name, values in window.channels.items()
    }
    return Window(**channels, sample_rate=window.sample_rate, start=window.start, source=window.source)
