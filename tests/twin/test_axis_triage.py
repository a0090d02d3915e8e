"""Triage of windows of axes that no servo stands for: a shaft that is free in the gap, one mass on a rigid screw."""

from functools import cache

import numpy as np
import pytest
from msgspec import structs
from twin_messages import message_of

from servotwin import messages
from servotwin.control.controller import Controller
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.load import Load
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TriageSettings, TwinSettings
from servotwin.twin.state import encode_state
from servotwin.twin.twin import Twin

AXIS = Axis(
    TorqueDrive(J=0.4, lag=1e-3, friction=0.05),
    Transmission(p=1.0, k_d=3300.0, c_d=20.0, in_gap="free"),
    Load((5.6,), (0.0,), (0.3,), "rotary"),
    Controller(Kp=60.0, Ki=20.0, Kd=40.0, Tf=0.01),
)
MACHINE = AXIS.replace(transmission=Transmission(p=1.0, k_d=3200.0, c_d=24.0, in_gap="free"))
SETTINGS = TwinSettings(policy="paper", k_dz=0.0, triage=TriageSettings())
GAP, NOISE = 0.03, 2e-5


@cache
def windows(gap: float, first: int = 0) -> tuple[messages.WindowMessage, ...]:
    """Of a machine off its model, four seconds each, in noise; numbers and times go on from `first`."""
    run = simulate(MACHINE, 26.0, reference=SquareWave(0.2, 4.0), gap=gap, sample_rate=1000.0)
    random, made = np.random.default_rng(first), []
    for number in range(6):
        part = slice(1500 + 4000 * number, 5500 + 4000 * number)
        noise = NOISE * random.normal(size=4000)
        window = Window(run.position[part] + noise, run.theta_m[part], sample_rate=1000.0)
        message = structs.replace(message_of(window), servo="axis", boot="boot-1", reason="periodic")
        made.append(structs.replace(message, sequence=first + number, start=40.0 * (first + number)))
    return tuple(made)


def fed(twin: Twin, arrived: tuple[messages.WindowMessage, ...]) -> Twin:
    for message in arrived:
        twin.receive(message, message.start + 5.0)
    return twin


def new(state: bytes = b"") -> Twin:
    return Twin("axis", TwinModel.of(AXIS, SETTINGS), None, state)


@cache
def settled(count: int) -> Twin:
    """After the first windows of a gap that stays; not to be fed more."""
    return fed(new(), windows(GAP)[:count])


@pytest.mark.slow
def test_windows_that_say_nothing_new_get_a_glance() -> None:
    log = settled(6).log
    assert len(log.estimates) == 1
    glances = list(log.glances.values())
    assert [one.moved for one in glances] == [True, *[False] * 5]
    for one in glances[1:]:
        assert abs(one.gap - GAP) < 3.0 * one.std < 0.03 * GAP
        assert one.why == "nothing moved"


@pytest.mark.slow
@pytest.mark.parametrize("moved", [0.97, 1.03])
def test_a_gap_that_moved_is_estimated_at_once(moved: float) -> None:
    twin = fed(new(settled(6).state()), windows(moved * GAP, 6))
    first = twin.log.glances["axis", "boot-1", 6]
    assert first.why.startswith("the gap moved: ")
    assert first.gap == pytest.approx(moved * GAP, rel=0.005)
    estimate = twin.log.estimates["axis", "boot-1", 6]
    assert estimate.gap == pytest.approx(moved * GAP, rel=0.005)
    # From the estimate on the new gap is what is compared with.
    assert ("axis", "boot-1", 11) not in twin.log.estimates


@pytest.mark.slow
def test_what_triage_remembers_is_part_of_the_state() -> None:
    whole, twin = settled(6), fed(new(), windows(GAP)[:3])
    reborn = fed(Twin("axis", twin.model, twin.log, twin.state()), windows(GAP)[3:])
    assert reborn.state() == whole.state()
    assert reborn.log.glances == whole.log.glances


@pytest.mark.slow
@pytest.mark.parametrize("unknowns", [(), (0.015, 0.0)])
def test_unknowns_of_another_version_or_model_are_not_used(unknowns: tuple[float, ...]) -> None:
    """The window is estimated, and its unknowns serve the next."""
    twin = settled(2)
    state = twin.model.restored("axis", twin.state())
    assert state.triage is not None
    older = structs.replace(state, triage=structs.replace(state.triage, unknowns=unknowns))
    again = fed(Twin("axis", twin.model, None, encode_state(older)), windows(GAP)[2:4])
    assert list(again.log.estimates) == [("axis", "boot-1", 2)]


def test_two_rests_that_friction_tells_apart_are_no_news() -> None:
    """Friction holds the motor at whatever command it came to rest with, on either side."""
    for name in AXES:
        axis = Axis.preset(name)
        found = SETTINGS.on(axis).triage
        assert found is not None
        held = float(axis.command_of(axis.own_friction))
        assert found.bias_limit >= 2.0 * held
    assert TwinSettings(triage=TriageSettings(bias=0.01)).on(Axis.preset("gantry")).triage == TriageSettings(
        bias=0.01, least_misfit=1e-7
    )


def test_a_small_gap_moves_by_small_amounts() -> None:
    settings = TriageSettings()
    assert settings.gap_limit(np.radians(0.36)) == pytest.approx(np.radians(0.0036))
    assert settings.gap_limit(np.radians(25.0)) == pytest.approx(np.radians(0.1))
    assert settings.widest_limit(np.radians(0.36)) == pytest.approx(np.radians(0.018))
    assert TriageSettings(gap=0.1, widest=0.2).gap_limit(1e-3) == 0.1
    assert TriageSettings(gap=0.1, widest=0.2).widest_limit(1e-3) == 0.2
