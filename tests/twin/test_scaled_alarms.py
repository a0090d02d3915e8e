"""Alarms of a machine in other units: gaps that fall or jump, contacts that do, and an offset that is doubted."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from exploration import explored
from scaling import Units, scaled, scaled_window
from twin_messages import message_of

from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.simulation import simulate
from servotwin.twin.evidence import GapEstimateRecord, RedesignRecord
from servotwin.twin.evidence_rows import rows
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.step import WindowArrival, step

MODEL = Servo.preset("paper")
OWN = MODEL.controller
CALM = MODEL.replace(Kp=0.4 * OWN.Kp, Kd=0.4 * OWN.Kd, Ki=0.0)
LIVELY = MODEL.replace(Ki=0.0)
ELSEWHERE = explored(
    [
        Units(time=2.0**-10),
        Units(time=2.0**10),
        Units(length=2.0**-20),
        Units(length=2.0**20),
        Units(voltage=2.0**-7),
        Units(2.0**-10, 2.0**20, 2.0**7),
        Units(1e3, 1e-6, 1e2),
        Units(1e-3, 1e6, 1e-2),
    ],
    5,
    6,
)


@dataclass(frozen=True)
class Told:
    """What a twin made of some windows, one every 10 s."""

    estimates: list[GapEstimate]
    alarms: list[list[str]]
    tolerances: list[float]
    """Of the settings, m of the first units; NaN: none was sent."""


@cache
def windows(servo: Servo, gap_deg: float, count: int, home_deg: float = 0.0, seed: int = 0) -> list[Window]:
    """About steps to and fro of a machine 1 % stiffer, with an encoder homed elsewhere and 0.2 um of noise."""
    gap, rng = math.radians(gap_deg), np.random.default_rng(seed)
    machine = servo.replace(k=tuple(1.01 * servo.stiffnesses))
    wave = SquareWave(2.5e-4 if servo is CALM else 1e-3, 20.0)
    run = simulate(machine, 10.0 * (count + 1), reference=wave, gap=gap, theta_d0=0.2 * gap, sample_rate=1024.0)
    found = [Window.from_run(run, 10.0 * (number + 1) - 0.3, 2.0) for number in range(count)]
    return [
        each.replace(
            position=each.position + rng.normal(0.0, 2e-7, each.position.size),
            theta_m=each.theta_m + math.radians(home_deg),
        )
        for each in found
    ]


def in_turn(*parts: list[Window]) -> list[Window]:
    return [window for group in zip(*parts, strict=True) for window in group]


@cache
def falls_by_turns() -> list[Window]:
    return in_turn(windows(MODEL, 5.0, 4), windows(MODEL, 6.0, 4, seed=5))


@cache
def jumps_by_turns() -> list[Window]:
    five, twelve = windows(MODEL, 5.0, 6), windows(MODEL, 12.0, 6)
    return in_turn(five[::2], five[1::2], twelve[::2], twelve[1::2])


@cache
def a_new_screw_and_another_home() -> list[Window]:
    return [*windows(CALM, 28.0, 4), *windows(CALM, 12.0, 4, home_deg=20.0, seed=3)]


@cache
def two_calm_machines() -> list[Window]:
    return in_turn(windows(CALM, 28.0, 4), windows(CALM, 12.0, 4, home_deg=20.0, seed=3))


@cache
def an_encoder_that_slipped() -> list[Window]:
    short = [each.slice(each.start, 1.2) for each in windows(LIVELY, 12.0, 4, home_deg=30.0, seed=3)]
    return [*windows(LIVELY, 12.0, 3), *short]


CASES = {
    falls_by_turns: (MODEL, "the gap falls and rises by turns"),
    jumps_by_turns: (MODEL, "the gap has jumped"),
    a_new_screw_and_another_home: (CALM, ""),
    two_calm_machines: (CALM, "times the motor met the screw elsewhere"),
    an_encoder_that_slipped: (LIVELY, ""),
}


@cache
def told(name: Callable[[], list[Window]], units: Units) -> Told:
    servo, _ = CASES[name]
    steps, bias = (1e-4 * units.length, 2.5e-3 * units.length), 0.1 * units.voltage
    settings = TwinSettings(
        policy="hysteresis",
        uncertainty=Uncertainty(step=steps, input_bias=(-bias, bias)),
        learning=LearningSettings(k_drift=0.0, c_drift=0.0, motor_drift=0.0),  # the defaults are per day
    )
    model = TwinModel.of(scaled(servo, *units), settings)
    state, made = model.initial_state("axis"), Told([], [], [])
    for number, window in enumerate(name()):
        time = 10.0 * number * units.time
        result = step(
            model, state, WindowArrival(message_of(scaled_window(window, units), number, start=time), time), time
        )
        state = result.state
        made.alarms.append([row.status for row in rows(result.evidence, 1, "") if row.kind == "alarm"])
        made.estimates.extend(each.estimate for each in result.evidence if isinstance(each, GapEstimateRecord))
        for redesign in (each.redesign for each in result.evidence if isinstance(each, RedesignRecord)):
            made.tolerances.append(math.nan if redesign.setting is None else redesign.setting.tolerance / units.length)
    return made


def in_words(sentences: list[str]) -> list[str]:
    return [re.sub(r"[-+]?\d[\d.e+-]*", "#", sentence) for sentence in sentences]


@pytest.mark.slow
@pytest.mark.parametrize("units", ELSEWHERE)
@pytest.mark.parametrize("name", CASES, ids=lambda name: name.__name__)
def test_a_twin_says_the_same_in_other_units(name: Callable[[], list[Window]], units: Units) -> None:
    here, there = told(name, Units()), told(name, units)
    assert [each.status for each in there.estimates] == [each.status for each in here.estimates]
    for one, other in zip(here.estimates, there.estimates, strict=True):
        assert other.gap == pytest.approx(one.gap, rel=1e-4, abs=1e-5)
        assert other.interval == pytest.approx(one.interval, rel=1e-3, abs=1e-4)
        assert in_words(list(other.reasons)) == in_words(list(one.reasons))
    assert [in_words(each) for each in there.alarms] == [in_words(each) for each in here.alarms]
    assert there.tolerances == pytest.approx(here.tolerances, rel=1e-4, nan_ok=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES, ids=lambda name: name.__name__)
def test_the_cases_show_what_they_are_for(name: Callable[[], list[Window]]) -> None:
    said = " | ".join(sentence for each in told(name, Units()).alarms for sentence in each)
    assert CASES[name][1] in said


@pytest.mark.slow
def test_in_these_cases_contacts_confirm_the_gap_and_an_offset_is_doubted() -> None:
    screw, slipped = (told(name, Units()).estimates for name in (a_new_screw_and_another_home, an_encoder_that_slipped))
    assert [each.ok for each in screw] == [False, False, True, True, False, False, True, True]
    assert [each.ok for each in slipped] == [True, True, True, False, False, True, True]
