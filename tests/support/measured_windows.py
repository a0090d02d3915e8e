"""Windows made without the simulator: a prescribed motor, the play operator finely sampled, the structure by scipy."""

from functools import lru_cache

import numpy as np
from scipy.signal import lsim

from servotwin.estimation.window import Window
from servotwin.plant.backlash import play
from servotwin.plant.servo import Servo

RATE, FINER = 5000.0, 10


def swinging(t: np.ndarray) -> np.ndarray:
    """A motor angle (rad) that turns round often, as wide as in the paper's loop."""
    return 5.0 * np.sin(2.0 * np.pi * 1.3 * t) + 1.5 * np.sin(2.0 * np.pi * 2.9 * t + 1.0) - 1.5 * np.sin(1.0)


def position_of(servo: Servo, theta_d: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Position of the last mass, from the chain's matrices in physical coordinates."""
    chain = servo.chain()
    velocity = chain.B_velocity
    system = (
        chain.A,
        (chain.A @ velocity + chain.B_position)[:, None],
        chain.C[-1:],
        np.array([[chain.C[-1] @ velocity + chain.D[-1]]]),
    )
    return np.asarray(lsim(system, servo.p * theta_d, times)[1])


@lru_cache(maxsize=64)
def measured(
    gap: float,
    servo: Servo | None = None,
    motor=swinging,
    start: float = 1.0,
    duration: float = 1.0,
    theta_d0: float = 0.0,
) -> Window:
    """What a servo with a total gap (rad) shows from `start` on; at time zero everything rests at zero."""
    servo = servo or Servo.preset("paper")
    times = np.arange(round((start + duration) * RATE * FINER)) / (RATE * FINER)
    theta_m = motor(times)
    position = position_of(servo, play(theta_m, gap, theta_d0), times)
    kept = slice(round(start * RATE) * FINER, None, FINER)
    return Window(position[kept], theta_m[kept], sample_rate=RATE, start=start)
