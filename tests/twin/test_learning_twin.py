"""What a twin records of the machine that it learns, and its alarm where the machine is another one."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from twin_messages import known_gap, window_message

from servotwin.estimation.estimate import GapEstimate, GapStatus, MachineReading
from servotwin.estimation.learning.machine import LearningSettings, LearntMachine
from servotwin.estimation.learning.motor import BACK_EMF
from servotwin.estimation.learning.wear import Expectation
from servotwin.messages import WindowMessage, checksum, pack_channel
from servotwin.plant.servo import Servo
from servotwin.twin.evidence import MachineRecord
from servotwin.twin.evidence_rows import StoredExpectation, rows
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.state import decode_state, encode_state
from servotwin.twin.step import WindowArrival, step

SETTINGS = TwinSettings(policy="paper")


def reading(k: float) -> MachineReading:
    return MachineReading((k, 0.0, 0.0, 0.0), tuple(np.diag([1e-6] * 4).ravel().tolist()))


def steps(factors: list[float]) -> list[tuple[LearntMachine, list[str]]]:
    """Machine and kinds of its evidence after windows that show these stiffnesses; off the first one they mismatch."""
    seen: list[Expectation] = []

    def estimate(window, expected):
        seen.append(expected)
        factor, middle = factors[len(seen) - 1], window.start + 0.5 * window.duration
        status = GapStatus.OK if factor == factors[0] else GapStatus.MODEL_MISMATCH
        return GapEstimate(0.1, 1e-3, 1e-3, (0.098, 0.102), status, middle, machine=reading(factor))

    model = TwinModel.of(Servo.preset("paper"), SETTINGS, estimator=estimate)
    state, results = model.initial_state("axis"), []
    for number in range(len(factors)):
        result = step(model, state, WindowArrival(window_message(number, 10.0 * number), 10.0 * number), 10.0 * number)
        state = decode_state("axis", encode_state(result.state))
        records = [record for record in result.evidence if isinstance(record, MachineRecord)]
        results.append((state.wear.machine, [row.kind for row in rows(records, 1, "")]))
    assert seen[0].machine is None
    assert all(one.machine is not None for one in seen[1:])
    return results


def test_a_changed_machine_raises_an_alarm_and_is_learnt_when_three_windows_agree() -> None:
    (first, kinds), *others = steps([0.01, 0.2, 0.2, 0.2])
    assert (first.factors[0], kinds) == (0.01, ["machine"])
    assert [machine.factors[0] for machine, _ in others] == [0.01, 0.01, 0.2]
    assert [kinds for _, kinds in others] == [["alarm"]] * 3
    assert "learnt anew" in others[-1][0].alarm


def test_an_expectation_is_stored_with_the_machine_bit_for_bit() -> None:
    machine = steps([0.01])[0][0]
    expected = Expectation(0.1, None, machine.prior(SETTINGS.learning, 5.0))
    again = StoredExpectation.of(expected).expectation(SETTINGS.trend)
    assert again.machine is not None
    assert np.array_equal(again.machine.mean, expected.machine.mean)
    assert np.array_equal(again.machine.covariance, expected.machine.covariance)


def motor_window(number: int, factor: float) -> WindowMessage:
    """Window of a motor that swings, with `factor` times the model's back EMF."""
    servo, time = Servo.preset("paper"), np.arange(2000) / 1000.0
    lag, middle = servo.J * servo.R / servo.k_T, 9.0 * (time + 0.5e-3)  # of the time in which a voltage is held
    volts = factor * servo.k_B * 9.0 * np.cos(middle) - lag * 81.0 * np.sin(middle)
    channels = tuple(
        pack_channel(name, unit, values)
        for name, unit, values in (
            ("position", "m", np.zeros(2000)),
            ("theta_m", "rad", np.sin(9.0 * time)),
            ("voltage", "V", volts),
        )
    )
    return msgspec.structs.replace(
        window_message(number, 10.0 * number, channels=channels), rate=1000.0, crc=checksum(channels)
    )


def test_the_motor_is_learnt_recorded_and_stored_bit_for_bit() -> None:
    model = TwinModel.of(Servo.preset("paper"), SETTINGS, estimator=known_gap)
    state, kinds, factors = model.initial_state("axis"), [], [1.05, 1.05, 1.3, 1.05]
    for number, factor in enumerate(factors):
        result = step(model, state, WindowArrival(motor_window(number, factor), 10.0 * number), 10.0 * number)
        state = decode_state("axis", encode_state(result.state))
        assert state == result.state
        kinds += [row.kind for row in rows(result.evidence, 1, "") if row.kind in ("motor", "alarm")]
    assert kinds == ["motor", "motor", "alarm", "motor"]
    assert state.wear.motor is not None
    assert state.wear.motor.mean[BACK_EMF] == pytest.approx(0.05, abs=5e-3)
    unlearning = TwinModel.of(Servo.preset("paper"), replace(SETTINGS, learning=LearningSettings(learn=False)))
    assert unlearning.motor is None
