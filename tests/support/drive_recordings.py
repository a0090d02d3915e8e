"""Recordings of a drive whose parameters are known, with errors that no model of it has."""

from __future__ import annotations

from functools import cache

import numpy as np

import servotwin as st
from servotwin.estimation.inverse_dynamics.recording import DriveRecording

RATE = 500.0
PARAMETERS = {"inertia": 20.0, "viscous": 150.0, "coulomb": 12.0, "offset": -4.0}
GAINS = {"position_gain": 25.0, "velocity_gain": 2400.0}  # 1/s, N s/m


def strokes(speeds=(0.02, 0.1, 0.2), acceleration=1.0, cruise=0.4, cycles=4, rate=RATE):
    """Position of strokes to and fro at several speeds, with jerk-limited ramps."""
    profile = []
    for _ in range(cycles):
        for speed in speeds:
            ramp = speed / acceleration
            time = np.arange(0.0, 2.0 * ramp + cruise, 1.0 / rate)
            there = np.minimum(np.minimum(time, ramp), time[-1] - time) * acceleration
            profile += [there, -there]
    speed = np.convolve(np.concatenate(profile), np.hanning(15) / np.hanning(15).sum(), mode="same")
    return np.cumsum(speed) / rate


def prescribed(seed=None, count=1e-7, side=(0.0, 0.0), **motion):
    """A loop that follows its reference, its force from the parameters; with a seed also cyclic friction of some pitch,
    drift and seldom knocks, which no model knows; `side` is added to the friction of the forward motion (viscous,
    Coulomb)."""
    position = strokes(**motion)
    speed = np.gradient(position, 1.0 / RATE)
    direction, forward = np.sign(speed), speed > 0.0
    force = PARAMETERS["inertia"] * np.gradient(speed, 1.0 / RATE) + PARAMETERS["viscous"] * speed
    force = force + PARAMETERS["coulomb"] * direction + PARAMETERS["offset"] + forward * (side[0] * speed + side[1])
    if seed is not None:
        random = np.random.default_rng(seed)
        pitch, phase = random.uniform(0.003, 0.02), random.uniform(0.0, 2.0 * np.pi)
        force = force + 1.5 * direction * np.sin(2.0 * np.pi * position / pitch + phase)
        drift = np.convolve(random.standard_normal(position.size), np.exp(-np.arange(400) / 100.0), mode="same")
        force = force + 0.05 * drift + 3.0 * random.standard_t(3, position.size) * (random.random(position.size) < 0.02)
    return recording_of(np.round(position / count) * count, force, count=count)


def recording_of(position, force, reference=None, count=1e-7, **more):
    """A recording of arrays."""
    return DriveRecording(
        rate=more.pop("rate", RATE),
        position=position,
        force=force,
        usable=np.ones(position.size, dtype=bool),
        reference=reference,
        force_per_command=1.0,
        resolution=count,
        source="log test.csv",
        **more,
    )


@cache
def elastic(stiffness=2e5, damping=60.0, gap=0.0, noise=1e-8, rate=2000.0, shake=1e-4):
    """A simulated loop of 8 kg at the motor and 12 kg on a shaft, shaken a little; positions of both ends."""
    p, random = 1e-3, np.random.default_rng(1)
    axis = st.Axis(
        st.TorqueDrive(8.0 * p * p, friction=150.0 * p * p, coulomb=12.0 * p),
        st.Transmission(p, stiffness, damping, in_gap="free"),
        st.Load((12.0,), (0.0,), (20.0,)),
        st.Cascade(20.0, p, 1500.0 * p * p, on="motor", speed_filter=2e-3, sample_rate=rate),
        st.Sensors(feedback="motor"),
    )
    reference = strokes(cycles=2, rate=rate)
    reference = reference + shake * np.convolve(random.standard_normal(reference.size), np.hanning(9), "same")
    time = np.arange(reference.size) / rate
    held = st.Samples(tuple(time), tuple(reference))
    run = st.simulate(axis, time[-1], reference=held, sample_rate=rate, gap=gap)
    load = run.position + noise * random.standard_normal(time.size)
    return recording_of(run.theta_m * p, run.voltage / p, reference, rate=rate, load=load)


@cache
def simulated(integral_time=None, count=1e-7, rate=RATE, delay=0, lag=0.0):
    """A simulated loop of a cascade and a drive with friction, its position counted: recording with reference.

    The drive's force lags its command by a time constant (s); the encoder is late by whole samples, which is the same
    to a log as a drive that is.
    """
    p = 1e-3
    axis = st.Axis(
        st.TorqueDrive(
            PARAMETERS["inertia"] * p * p,
            lag,
            friction=PARAMETERS["viscous"] * p * p,
            coulomb=PARAMETERS["coulomb"] * p,
        ),
        st.Transmission(p),
        st.Load((PARAMETERS["inertia"],)),
        st.Cascade(
            position_gain=GAINS["position_gain"],
            ratio=p,
            velocity_gain=GAINS["velocity_gain"] * p * p,
            integral_time=integral_time,
            on="motor",
            speed_filter=3e-3,
            sample_rate=rate,
        ),
        st.Sensors(encoder_resolution=count / p, feedback="motor", encoder_delay=delay / rate),
    )
    reference = strokes(cycles=2, rate=rate)
    time = np.arange(reference.size) / rate
    run = st.simulate(
        axis,
        time[-1],
        reference=st.Samples(tuple(time), tuple(reference)),
        sample_rate=rate,
        input_bias=-PARAMETERS["offset"] * p,
    )
    position = np.round(run.theta_m * p / count) * count
    position = np.concatenate([np.full(delay, position[0]), position[: position.size - delay]])
    return recording_of(position, run.voltage / p, reference, count=count, rate=rate)
