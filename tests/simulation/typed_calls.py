"""Calls that mypy refuses, and calls that it accepts; `make lint` checks them, and nothing runs them.

Each wrong call names the error that it must give: strict mypy reports an ignored error that does not occur.
"""

import servotwin as st


def wrong(servo: st.Servo) -> None:
    """Misspelt keywords and wrong types."""
    st.simulate(servo, 1.0, reffff=1e-3)  # type: ignore[call-arg]
    st.simulate(servo, 1.0, gap="ten")  # type: ignore[arg-type]
    st.simulate(servo, "1 s")  # type: ignore[arg-type]
    st.simulate(servo, 1.0, controller=servo)  # type: ignore[arg-type]
    servo.replace(Kii=500.0)  # type: ignore[call-arg]
    servo.replace(k="9e3")  # type: ignore[arg-type]
    servo.replace(n=2.5)  # type: ignore[arg-type]
    servo.controller.replace(reffff=1.0)  # type: ignore[call-arg]
    servo.controller.replace(sample_rate="fast")  # type: ignore[arg-type]
    st.limit_cycle(servo, gap="ten")  # type: ignore[arg-type]
    st.tune(servo, 10.0, 0.25, kin="PI")  # type: ignore[call-arg]
    st.stability_map(servo, gaap=(0.1,))  # type: ignore[call-arg]
    st.certify(servo, gap=0.1)  # type: ignore[call-arg]


def right(servo: st.Servo) -> tuple[st.Run, st.Servo, st.Controller, st.Controller]:
    """Every result with its type."""
    run: st.Run = st.simulate(servo, 1.0, gap=0.1, reference=st.Step(1e-3), tolerance=None, seed=1)
    other: st.Servo = servo.replace(k=(9e3, 9e3, 9e3), Ki=500.0, sample_rate=None)
    law: st.Controller = servo.controller.replace(voltage_limit=24.0, sample_rate=5000.0)
    gains: st.Controller = st.tune(servo, 10.0, 0.25).controller
    return run, other, law, gains
