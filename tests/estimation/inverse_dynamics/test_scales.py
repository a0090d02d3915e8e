"""A drive's log in other units of time, length and force: the same parameters, controller and advice."""

from dataclasses import replace

import pytest
from drive_recordings import elastic, prescribed, simulated

from servotwin.estimation.inverse_dynamics.identify import identify_drive

# Powers of two, so that only the searches of a filter's and an integral's time round otherwise.
UNITS = [(2.0**-10, 2.0**20, 1.0), (2.0**10, 2.0**-20, 2.0**6), (1.0, 2.0**20, 2.0**-6)]
PITCH = 1e-3


def in_units(recording, time, length, force):
    lengths = {name: None if values is None else length * values for name, values in
               (("reference", recording.reference), ("load", recording.load))}  # fmt: skip
    return replace(
        recording,
        rate=recording.rate / time,
        position=length * recording.position,
        force=force * recording.force,
        resolution=length * recording.resolution,
        **lengths,
    )


def identified(recording, time=1.0, length=1.0, force=1.0):
    return identify_drive([in_units(recording, time, length, force)], p=length * PITCH)


@pytest.mark.parametrize(("time", "length", "force"), UNITS)
def test_the_controller_and_the_refined_parameters_are_the_same(time, length, force):
    recording = simulated(integral_time=0.05)
    one, other = identified(recording), identified(recording, time, length, force)
    assert other.law.position_gain * time == pytest.approx(one.law.position_gain, rel=1e-5)
    assert other.law.integral_time / time == pytest.approx(0.05, rel=1e-4)
    fits = one.refinement.symmetric, other.refinement.symmetric
    inertia, coulomb = force * time**2 / length, force
    for name, unit in (("inertia", inertia), ("coulomb", coulomb)):
        assert fits[1][name] / unit == pytest.approx(fits[0][name], rel=1e-6)
        assert fits[1].half_width(name) / unit == pytest.approx(fits[0].half_width(name), rel=1e-2)
    assert fits[1].condition == pytest.approx(fits[0].condition, rel=1e-4)


@pytest.mark.parametrize(("time", "length", "force"), UNITS)
def test_the_simulated_loop_is_refined_as_often(time, length, force):
    one, other = (identified(elastic(), *units).refinement.symmetric for units in ((), (time, length, force)))
    assert other["inertia"] * length / (force * time**2) == pytest.approx(one["inertia"], rel=1e-4)
    assert other.rows == one.rows


@pytest.mark.parametrize(("time", "length", "force"), UNITS)
def test_the_friction_at_the_speeds_of_the_log_is_the_same(time, length, force):
    one, other = (identified(prescribed(1), *units).friction for units in ((), (time, length, force)))
    for each, alike in zip(one, other, strict=True):
        assert alike.speed * time / length == pytest.approx(each.speed, rel=1e-9)
        assert alike.force / force == pytest.approx(each.force, rel=1e-6)
        assert alike.half_width / force == pytest.approx(each.half_width, rel=1e-6)


@pytest.mark.parametrize(("time", "length", "force"), UNITS)
def test_the_next_experiment_is_the_same(time, length, force):
    one, other = (identified(prescribed(1), *units).advice for units in ((), (time, length, force)))
    assert other.worst == one.worst
    assert other.half_width == pytest.approx(one.half_width, rel=1e-6)
    assert other.duration / time == pytest.approx(one.duration, rel=1e-6)
    assert one.duration > 0.0
