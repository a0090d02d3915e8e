"""The evidence chain as text."""

import math
import re
from typing import Any

import pytest

from servotwin.cli.audit_report import Units, _sent_update, lines_of, servo_lines
from servotwin.messages import Cause, Reason

SERVO = {
    "servo": "ax-1",
    "gap": math.radians(7.5),
    "std": math.radians(0.02),
    "status": "ok",
    "version": 3,
    "receipt": "applied",
    "windows": 42,
    "waiting": 1,
    "last_message": 0.0,
}
UPDATE = {"tolerance": 61.25e-6, "controller": {"Kp": 1377.7, "Ki": 0.0, "Kd": -135.1, "Tf": 0.1, "feedforward": -0.02,
                                                 "velocity_feedforward": 94.248},
          "proof": {"members": 256}}  # fmt: skip


HEAD = Units().head


def found(kind: str, status: str = "", **values: Any) -> dict[str, Any]:
    nothing = {"id": 0, "message": 0, "version": None, "gap": None, "std": None, "tail": None, "created": 0.0,
               "body": None}  # fmt: skip
    return {"kind": kind, "status": status, **nothing, **values}


def estimate(status: str = "ok", **values: Any) -> dict[str, Any]:
    return found("estimate", status, **{"version": 2, "gap": math.radians(7.5), "tail": 12.34e-6, **values})


def link(
    number: int, *of: dict[str, Any], boot: str = "b1", done: float | None = 1.0, steps: Any = ()
) -> dict[str, Any]:
    window = {"id": 60 * number, "boot": boot, "sequence": number, "received": 60.0 * number, "done": done}
    return {"window": window, "evidence": list(of), "steps": list(steps)}


def step(effect: Any = None, *answers: dict[str, Any]) -> dict[str, Any]:
    return {"update": found("update", "ok", version=3, body=UPDATE), "answers": list(answers), "effect": effect}


def report_of(*links: dict[str, Any], events: Any = (), changes: bool = False, **servo: Any) -> list[str]:
    lines = list(lines_of({**SERVO, **servo}, links[::-1], events, Units(), changes))
    assert lines[lines.index(HEAD) - 1] == ""
    return lines


def chain(*links: dict[str, Any], **other: Any) -> list[str]:
    lines = report_of(*links, **other)
    return lines[lines.index(HEAD) + 1 :]


def test_the_head_summarises_the_servo() -> None:
    trend = found("trend", body={"mean": [0.1, math.radians(0.5) / 3600.0, 0.0], "covariance": [0.0] * 9})
    head = report_of(link(1, estimate(), trend, found("disturbance", body={"bias": 0.02, "noise": 2e-6})))[:3]
    assert head == [
        "servo ax-1: gap 7.500 ± 0.039 deg (95 %; ok), version 3 (applied)",
        "  windows: 42 stored, 1 messages pending, last message 1970-01-01 00:00:00 UTC",
        "  wear 0.5 ± 0 deg/h (95 %), input bias 20.0 mV, noise 2.0 um",
    ]
    assert report_of(link(1), gap=None, version=None, receipt="", last_message=None)[:2] == [
        "servo ax-1: no gap known, no version sent",
        "  windows: 42 stored, 1 messages pending",
    ]


def test_the_names_column_is_as_wide_as_the_longest_name() -> None:
    head, short, long = servo_lines([SERVO, {**SERVO, "servo": "gantry-left-y", "gap": None}])
    assert head.startswith("servo          gap ± 95 %, deg  status")
    assert short.startswith("ax-1             7.500 ± 0.039  ok")
    assert long.startswith("gantry-left-y                -  ok")


def test_a_version_from_its_window_to_its_effect() -> None:
    """In the order of time: window, version, receipt, effect; each thing on a line of its own."""
    after = estimate(tail=5e-6, version=3)
    effect = {"window": {"sequence": 2}, "before": estimate(), "after": after}
    receipt = found("receipt", "applied", version=3, body={"applied": True, "sample": 5000})
    first = link(1, estimate(), found("redesign", "", body={}), steps=[step(effect, receipt)])
    lines = chain(first, link(2, after, found("redesign", "what was verified is in force already")))
    assert lines[0] == "boot b1"
    assert [line[HEAD.index("what followed") :] for line in lines[1:]] == [
        "version 3 sent: dead zone 61.25 um, Kp 1377.7 V/m, Ki 0 V/(m s), Kd -135.1 V s/m, Tf 0.1 s, "
        "feedforward -20.0 mV, velocity feedforward 94.25 V s/m, verified on 256 "
        "simulated machines",
        "version 3 applied at sample 5000",
        "version 3 in window 2: error 12.3 -> 5.0 um",
        "what was verified is in force already",
    ]
    assert lines[1].split()[:6] == ["1970-01-01", "00:01:00", "1", "7.500", "12.3", "2"]


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        (link(1, done=None), "waits to be processed"),
        (link(1, found("estimate", "failed: ValueError: no")), "failed: ValueError: no"),
        (link(1, found("glance", "nothing moved", gap=0.1)), "screening was enough: no new information"),
        (link(1, found("glance", "it moved"), estimate()), ""),
        (
            link(1, found("glance", "no window was estimated yet", body={"moved": True})),
            "not estimated, for a newer window had come; screening: no window was estimated yet",
        ),
        (link(1, estimate("lower bound", body={"estimate": {"reasons": ["one side"]}})), "lower bound: one side"),
        (link(1, estimate("lower bound")), "lower bound: no reason noted"),
        (link(1, estimate("lower bound"), found("redesign", "it is a lower bound")), "it is a lower bound"),
        (link(1, estimate(), found("trend", "an outlier")), "trend: an outlier"),
        (link(1, estimate(), found("redesign", "")), "a setting was found and waits to be sent"),
        (link(1, estimate(), found("excitation", "the window shows the gap")), ""),
        (link(1, estimate(), found("request", "windows tell too little")), "request: windows tell too little"),
        (link(1, estimate(), found("verification", "", version=3)), "version 3 is verified for this evidence"),
        (
            link(1, estimate(), found("verification", "two fail", version=3)),
            "version 3 FAILED its verification: two fail",
        ),
        (link(1, estimate(), found("withdrawn", "two fail", version=3)), "version 3 WITHDRAWN: two fail"),
    ],
)  # fmt: skip
def test_the_remarks_on_a_window(of: dict[str, Any], expected: str) -> None:
    _, line = chain(of)
    assert line[HEAD.index("what followed") :] == expected


def test_a_refused_version_shows_why() -> None:
    receipt = found("receipt", "expired", version=3, body={"applied": False})
    assert (
        chain(link(1, estimate(), steps=[step(None, receipt)]))[-1].strip() == "version 3 REFUSED by the edge: expired"
    )
    body = {"applied": False, "detail": "kp_v_per_m = 5: must be within 1 and 2"}
    receipt = found("receipt", Reason.GAINS_OUT_OF_BOUNDS, version=3, body=body)
    expected = "version 3 REFUSED by the edge: gains out of bounds: kp_v_per_m = 5: must be within 1 and 2"
    assert chain(link(1, estimate(), steps=[step(None, receipt)]))[-1].strip() == expected


def test_a_version_that_met_a_fallback_is_no_error() -> None:
    body = {"applied": False, "parameter_version": 3}
    receipt = found("receipt", Reason.FELL_BACK.value, version=3, body=body)
    line = chain(link(1, estimate(), steps=[step(None, receipt)]))[-1].strip()
    assert line == "version 3 not applied: the edge fell back meanwhile, as version 3"


@pytest.mark.parametrize(
    ("cause", "measured", "allowed", "expected"),
    [
        (Cause.SILENCE, 41.0, 40.0, "41 s where 40 s are allowed"),
        (Cause.EFFORT, 0.5, 0.2, "0.5 V where 0.2 V are allowed"),
        (Cause.LIMIT_CYCLE, 3e-4, 1e-5, "300 um where 10 um are allowed"),
        (Cause.ERROR, 3e-4, 1e-5, "300 um where 10 um are allowed"),
        (Cause.ERROR_ENERGY, 3e-4, 1e-5, "300 um where 10 um are allowed"),
    ],
)
def test_a_fallback_is_listed_at_its_time(cause: Cause, measured: float, allowed: float, expected: str) -> None:
    body = {"cause": cause.value, "measured": measured, "allowed": allowed}
    events = [found("fallback", cause.value, version=3, body=body, created=95.0, received=90.0, message=90)]
    lines = chain(link(1, estimate()), link(2, estimate()), events=events)
    assert lines[2] == f"1970-01-01 00:01:30  FALLBACK from version 3: {cause.value}, {expected}"


def test_a_fallback_after_a_drive_s_refusal_shows_no_values() -> None:
    event = found(
        "fallback", Cause.DRIVE.value, version=3, body={"cause": Cause.DRIVE.value, "measured": 0.0, "allowed": 0.0}
    )
    assert chain(link(1), events=[event])[0].endswith(f"FALLBACK from version 3: {Cause.DRIVE.value}")


def test_starts_of_the_edge_and_faults_of_the_twin_are_listed() -> None:
    events = [
        found("hello", "b2", version=3, created=70.0, message=70, id=2),
        found("answer", "taken", created=80.0, message=80, id=3),
        found("estimate", "failed: the state is not understood; the twin begins anew", created=90.0, id=4),
    ]
    lines = chain(link(1, estimate(id=1)), link(2, estimate(id=5), boot="b2"), events=events)
    assert [line[21:] for line in lines if line.startswith("1970") and "7.5" not in line] == [
        "edge connected: boot b2, version 3 in force",
        "the edge answers a request: taken",
        "failed: the state is not understood; the twin begins anew",
    ]
    assert [line for line in lines if line.startswith("boot")] == ["boot b1", "boot b2"]


def test_changes_leaves_out_what_led_to_nothing() -> None:
    quiet, failed = link(1, estimate(), found("redesign", "no")), link(2, found("estimate", "failed: no"))
    requesting, sent = link(3, estimate(), found("request", "more")), link(4, estimate(), steps=[step()])
    lines = chain(quiet, failed, requesting, sent, changes=True)
    assert [line.split()[2] for line in lines if line.startswith("1970")] == ["2", "3", "4"]
    none = "  none of the newest 1 windows led to more than an estimate; --limit 1000 looks further"
    assert none in report_of(quiet, changes=True)
    assert not any("--limit" in line for each in (True, False) for line in report_of(sent, changes=each))


def test_an_invalid_body_does_not_fail_the_report() -> None:
    for body in (None, {}, {"mean": []}, {"mean": None, "bias": "x", "noise": None}):
        of = [
            found(kind, "odd", version=1, body=body) for kind in ("trend", "disturbance", "estimate", "update", "new")
        ]
        receipt = found("receipt", "odd", body=body)
        update = {"update": found("update", body=body), "answers": [receipt], "effect": None}
        events = [found(kind, "odd", body=body) for kind in ("fallback", "hello", "answer")]
        assert chain(link(1, *of, steps=[update]), events=events)


def test_an_update_of_a_cascade_shows_its_numbers() -> None:
    law = {"type": "cascade", "position_gain": 20.0, "integral_time": 0.0, "velocity_feedforward": 0.9}
    update = {"version": 4, "body": {"setting": {"tolerance": 2e-5, "law": law}}}
    assert _sent_update(update, Units()) == (
        "version 4 sent: dead zone 20 um, position_gain 20 1/s, velocity_feedforward 0.9"
    )


def test_an_update_of_a_linear_law_says_that_nothing_integrates() -> None:
    law = {"type": "linear", "gain": 0.6, "integral_share": 0.0, "feedforward": 0.02}
    update = {"version": 5, "body": {"setting": {"tolerance": 0.0, "law": law}}}
    units = Units.of({"travel_unit": "rad", "command_unit": "N m"})
    assert _sent_update(update, units) == (
        "version 5 sent: no dead zone, gain 0.6, integral_share 0, feedforward 0.02 N m"
    )


def test_a_rotary_axis_is_shown_in_its_own_units() -> None:
    """Its position is in rad, its command in N m."""
    units = Units.of({"travel_unit": "rad", "command_unit": "N m"})
    effect = {"window": {"sequence": 4}, "before": {"tail": 2e-4, "version": 2}, "after": {"tail": 1e-4, "version": 3}}
    disturbed = found("disturbance", body={"bias": 0.02, "noise": 2e-6})
    fallen = found("fallback", "too large", version=3, body={"cause": Cause.EFFORT, "measured": 9.0, "allowed": 8.0})
    one = link(1, estimate(tail=2e-4), disturbed, steps=[step(effect)])
    lines = list(lines_of(SERVO, [one], [fallen], units))
    head = units.head
    assert "error, mdeg" in head
    assert head in lines
    text = "\n".join(lines)
    assert "input bias 0.02 N m, noise 0.1 mdeg" in text
    assert "dead zone 3.509 mdeg" in text
    assert "Kp 1377.7 N m/rad, Ki 0 N m/(rad s)" in text
    assert "feedforward -0.02 N m, velocity feedforward 94.25 N m s/rad" in text
    assert "error 11.5 -> 5.7 mdeg" in text
    assert ", 9 N m where 8 N m are allowed" in text
    window = next(line for line in lines if "version 3 sent" in line)
    assert window[: head.index("what followed")].split()[-2:] == ["11.5", "2"]
    assert Units.of({"travel_unit": "m", "command_unit": "V"}) == Units()


@pytest.mark.parametrize("machine", [{}, {"travel_unit": "", "command_unit": ""}])
def test_before_the_machine_is_known_nothing_has_a_unit(machine: dict[str, str]) -> None:
    """Neither those of a linear servo, which a rotary axis does not have."""
    unknown = estimate("failed: ValueError: no", gap=None, tail=None)
    fallen = [
        found("fallback", cause.value, version=0, body={"cause": cause, "measured": 9.0, "allowed": 8.0})
        for cause in (Cause.EFFORT, Cause.LIMIT_CYCLE, Cause.SILENCE)
    ]
    disturbed = found("disturbance", body={"bias": 0.02, "noise": 2e-6})
    text = "\n".join(
        lines_of(SERVO, [link(1, unknown, disturbed, done=None, steps=[step(None)])], fallen, Units.of(machine))
    )
    assert "error " in text
    assert "9 s where 8 s are allowed" in text
    assert not re.search(r"\b(um|mdeg|mV|V|N m|m|rad)\b", text), text


def test_a_zero_has_no_sign() -> None:
    assert Units.of({"travel_unit": "m", "command_unit": "rad/s"}).of_command(-0.0) == "0 rad/s"
    assert Units().of_command(-1e-6) == "0.0 mV"


def test_one_window_alone_tells_no_wear() -> None:
    numbers = {"mean": [0.1, 1e-6, 0.0], "covariance": [0.0, 0.0, 0.0, 0.0, 1e-8, 0.0, 0.0, 0.0, 0.0]}
    for updates in (1, 2):
        lines = report_of(link(1, estimate(), found("trend", body={**numbers, "updates": updates})))
        assert any("wear" in line for line in lines) is (updates > 1)


def test_the_summary_shows_the_answer_to_the_newest_version() -> None:
    earlier = found("receipt", Reason.FELL_BACK.value, version=2, body={"applied": False})
    applied = found("receipt", "applied", version=3, body={"applied": True})
    for answers, shown in (((), "version 3 (not answered yet)"), ((applied,), "version 3 (applied)")):
        head = report_of(link(1, estimate(), steps=[step(None, *answers)]), receipt=earlier["status"])[0]
        assert head.endswith(shown)


FALLEN = found(
    "fallback", "limit cycle", version=3, id=20, message=110, created=230.0, received=200.0,
    body={"cause": Cause.LIMIT_CYCLE, "measured": 3e-4, "allowed": 1e-5, "parameter_version": 4, "boot": "b1"},
)  # fmt: skip


@pytest.mark.parametrize(
    ("applied", "boot", "version", "runs"),
    [
        (10, "b1", 0, True),
        (30, "b1", 0, False),
        (10, "b2", 4, True),  # the edge begins with what it stored
        (10, "b2", 0, False),
    ],
)
@pytest.mark.parametrize("ahead", [0.0, 5e6])
def test_the_summary_says_that_the_fallback_set_runs(
    applied: int, boot: str, version: int, runs: bool, ahead: float
) -> None:
    """Whatever the clock said: of two letters the later one of the store counts."""
    clock = {n: {"id": n, "created": 10.0 * n + (ahead if n < 20 else 0.0) - (ahead if n > 20 else 0.0)}
             for n in (5, 10, 30)}  # fmt: skip
    receipt = found("receipt", "applied", version=3, body={"applied": True}, **clock[applied])
    hello = found("hello", boot, version=version, **clock[5 if boot == "b1" else 30])
    lines = report_of(link(1, estimate(), steps=[step(None, receipt)]), events=[FALLEN, hello])
    said = "  the edge runs its fallback set since 1970-01-01 00:03:20 UTC: limit cycle"
    assert [line for line in lines if "runs its fallback set" in line] == ([said] if runs else [])
    reported = "FALLBACK from version 3: limit cycle, 300 um where 10 um are allowed; version 4 in force"
    assert sum(reported in line for line in lines) == 1


def test_letters_of_one_turn_are_in_the_order_in_which_they_came() -> None:
    """At the time of their receipt, though both were processed later, and after a window that came after them."""
    hello = found("hello", "b1", version=4, id=21, message=111, created=230.0, received=201.0)
    mended = found("estimate", "failed: the state is not understood; the twin begins anew", id=22, created=230.0)
    windows = link(1, estimate(id=1)), link(2, estimate(id=19)), link(3, estimate(id=23))
    lines = chain(*windows, events=[mended, hello, FALLEN])
    told = [line[11:] for line in lines if line.startswith("1970")]
    assert [line[:30] for line in told] == [
        told[0][:30],
        "00:03:20  FALLBACK from versio",
        "00:03:21  edge connected: boot",
        told[3][:30],
        "00:03:50  failed: the state is",
        told[5][:30],
    ]


def test_an_earlier_service_tells_no_time_of_receipt() -> None:
    fallen = {key: value for key, value in FALLEN.items() if key != "received"}
    lines = report_of(link(1, estimate()), events=[fallen])
    assert any("fallback set since 1970-01-01 00:03:50 UTC" in line for line in lines)


def test_the_list_of_servos_cuts_no_word() -> None:
    new = {**SERVO, "servo": "ax-2", "gap": None, "status": "", "version": None, "receipt": "", "last_message": None}
    refused = {**SERVO, "receipt": Reason.GAINS_STEP_TOO_LARGE.value}
    head, *rows = servo_lines([refused, new])
    assert Reason.GAINS_STEP_TOO_LARGE.value in rows[0]
    assert rows[1].split("  ")[0] == "ax-2"
    assert rows[1][head.index("status") :].startswith("no estimate ")
    assert rows[1].endswith("never")
