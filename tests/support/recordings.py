"""Recordings of a motor and a load behind a gap, as real logs have them."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.plant.backlash import play


def swings(seconds=20.0, rate=500.0, speed=1.0):
    """Times, and a motor that swings through different strokes."""
    time = np.arange(0.0, seconds, 1.0 / rate)
    return time, 3.0 * np.sin(np.pi * speed * time) + 1.3 * np.sin(5.2 * speed * time + 1.0)


def recording(gap=0.05, ratio=0.1, lag=0.0, noise=2e-5, count=1e-3, error=None, seed=1, **motion):
    """A recording; `error` is the transmission error as a function of the play's output, in the load's unit."""
    time, motor = swings(**motion)
    output = play(np.interp(time - lag, time, motor), gap)
    load = ratio * output + 0.03 + noise * np.random.default_rng(seed).standard_normal(time.size)
    if error is not None:
        load = load + error(output)
    return EncoderRecording(time, np.round(motor / count) * count, load)


def short_strokes(gap, amplitude, seed, count=1e-4, noise=3e-4, ratio=1.6):
    """A recording of 16 strokes to and fro between points that are drawn, with speeds that are drawn too."""
    random = np.random.default_rng(seed)
    points = np.concatenate([[0.0], amplitude * random.uniform(0.5, 1.0, 16) * np.where(np.arange(16) % 2, -1.0, 1.0)])
    spans = np.abs(np.diff(points)) / random.uniform(0.5, 1.5, 16)
    edges = np.concatenate([[0.0], np.cumsum(40.0 * spans / spans.sum())])
    time = np.arange(0.0, 40.0, 2e-3)
    place = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, 15)
    share = (time - edges[place]) / np.diff(edges)[place]
    motor = points[place] + np.diff(points)[place] * (3.0 - 2.0 * share) * share**2
    load = ratio * play(motor, gap) + noise * random.standard_normal(time.size)
    return EncoderRecording(time, np.round(motor / count) * count, load, load_unit="mm")


def rows(made):
    """Time, motor and load of a recording, a row for each sample."""
    return np.column_stack([made.time, made.motor, made.load])


def csv(path, values, header="time_s,motor_rad,load_rad", separator=",", comma=False, comments=()):
    """Write rows to a table of text; its path."""
    lines = [*comments, header.replace(",", separator)]
    lines += [separator.join(f"{value:.9g}" for value in row) for row in values]
    text = "\n".join(lines) + "\n"
    path.write_text(text.replace(".", ",") if comma else text)
    return path


def to_and_fro(speeds=(3.0,), rest=0.0, gap=0.0, lag=0.0, delay=0.0, count=1e-4, rate=200.0, seconds=40.0):
    """A motor to and fro over 6 rad, at each of the speeds in turn, with rests; its load is late in one of two ways."""
    corners, time = [(0.0, -3.0)], np.arange(0.0, seconds, 1.0 / rate)
    while corners[-1][0] < seconds:
        speed = speeds[(len(corners) - 1) // (4 if rest else 2) % len(speeds)]
        corners.append((corners[-1][0] + 6.0 / speed, -corners[-1][1]))
        corners += [(corners[-1][0] + rest, corners[-1][1])] if rest else []
    motor = np.interp(time, *np.transpose(corners))
    load = play(np.interp(time - delay, time, motor), gap)
    if lag:
        share = 1.0 - np.exp(-1.0 / (rate * lag))
        load, _ = lfilter([share], [1.0, share - 1.0], load, zi=[(1.0 - share) * load[0]])
    return EncoderRecording(time, np.round(motor / count) * count, np.round(load / count) * count, load_unit="mm")
