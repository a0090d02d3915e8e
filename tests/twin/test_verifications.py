"""Verification of what was looked up: queued with the update, kept as evidence, and what fails it is withdrawn."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import pytest

from servotwin.control.gains import gains_of
from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.messages import Cause, Fallback, Reason, Receipt, Setting, Update, WindowMessage, decode, encode
from servotwin.messages.acts import Act, ActKind, encode_act
from servotwin.plant.servo import Servo
from servotwin.redesign.certified import policy as certified_module
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.lookup import Grid, TablePolicy
from servotwin.redesign.certified.lookup_file import build
from servotwin.redesign.registry import certified_policy
from servotwin.store.records import Incoming, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin.lookups import VerificationRequest, decode_request
from servotwin.twin.model_registry import ModelRegistry, ServoModel
from servotwin.twin.settings import TriageSettings, TwinSettings
from servotwin.twin.work import work

DEG = math.pi / 180.0
GRID = Grid(finest=30.0 * DEG, biases=(1e-2,), noises=(0.0,))
SETTINGS = TwinSettings(demands=Demands(machines=16, conditions=4, screened=2, settled=0.8), triage=TriageSettings())
SERVO = Servo.preset("paper")


@cache
def scenario() -> Scenario:
    certified = Scenario.preset("certified")
    # Its windows stand for those of other settings too: they must not tell the laws apart.
    twin = certified.twin.replace(demands=replace(SETTINGS.demands, notch=False))
    return certified.replace(gap=12.0 * DEG, duration=43.0, name="axis", twin=twin)


@cache
def windows() -> tuple[WindowMessage, ...]:
    return cosimulate(scenario()).windows


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tables") / "axis.table"
    for _ in build(path, certified_policy(SERVO, SETTINGS), GRID):
        pass
    return path


@pytest.fixture(scope="module")
def fleet(file: Path) -> ModelRegistry:
    start = Setting(scenario().start_tolerance, gains_of(scenario().start_law))
    return ModelRegistry((ServoModel("m", SERVO, SETTINGS.replace(table=str(file)), start),), (("axis", "m"),))


class Queue:
    """What the store does between outcomes, without a store."""

    def __init__(self, fleet: ModelRegistry) -> None:
        self.fleet, self.state, self.serial, self.outcomes = fleet, b"", 0, []

    def give(self, message: WindowMessage | Receipt | Fallback | Incoming) -> WorkResult:
        body, kind = (
            (message.body, message.kind) if isinstance(message, Incoming) else (encode(message), MessageKind.WINDOW)
        )
        self.serial += 1
        stored = StoredMessage(self.serial, kind, body, "", float(self.serial))
        outcome = work(self.fleet, Lease("axis", self.state, self.serial - 1, (stored,)), float(self.serial))
        self.state = outcome.state
        self.outcomes.append(outcome)
        return outcome

    def window(self, number: int, version: int = 0, **changes) -> WorkResult:
        return self.give(msgspec.structs.replace(windows()[number], parameter_version=version, **changes))

    def act(self, act: Act) -> WorkResult:
        return self.give(Incoming("axis", MessageKind.ACT, "", encode_act(act), "", b"", 0.0))

    def applied(self, update: Update) -> WorkResult:
        sample = round(update.data_time * 5000.0) + 20000
        return self.give(
            Receipt("axis", update.version, True, sample, Reason.APPLIED, update.version, update.window[0])
        )


def sent(outcome: WorkResult) -> Update:
    (body,) = outcome.outgoing
    update = decode(body)
    assert isinstance(update, Update)
    return update


def kinds(outcome: WorkResult) -> list[str]:
    return [row.kind for row in outcome.evidence]


def failing(monkeypatch) -> None:
    def refuted(_policy, _region, _setting, _machine, _motor):
        return NotVerified("the setting settles on 3.0 % of the members, and 99 % are asked")

    monkeypatch.setattr(certified_module.CertifiedPolicy, "confirm", refuted)


def begun(fleet: ModelRegistry) -> tuple[Queue, Update, Incoming]:
    """After the first window: what was sent, and the verification that is queued."""
    queue = Queue(fleet)
    outcome = queue.window(0)
    update = sent(outcome)
    queue.applied(update)
    (queued,) = outcome.enqueue
    return queue, update, queued


@pytest.mark.slow
def test_an_update_from_the_table_queues_the_verification_for_its_own_evidence(fleet: ModelRegistry) -> None:
    _, update, queued = begun(fleet)
    question = decode_request(queued.body)
    assert (queued.servo, queued.kind, queued.encoding) == ("axis", MessageKind.VERIFICATION, "")
    assert (question.version, question.window) == (update.version, update.window)
    assert gains_of(question.setting.controller) == update.setting.gains
    assert question.region.gap[0] < 12.0 * DEG < question.region.gap[1]
    assert question.region.gap[1] - question.region.gap[0] < 1.0 * DEG


@pytest.mark.slow
def test_a_verification_that_passes_is_stored_and_changes_nothing(fleet: ModelRegistry) -> None:
    queue, update, queued = begun(fleet)
    before = queue.state
    outcome = queue.give(queued)
    assert kinds(outcome) == ["verification"]
    (row,) = outcome.evidence
    assert (row.version, row.status, row.window) == (update.version, "", "{}/{}".format(*update.window))
    body = msgspec.msgpack.decode(row.body)
    assert body["certificate"]["gap"] == list(decode_request(queued.body).region.gap)
    assert body["certificate"]["settled"] >= 0.99
    assert queue.state == before
    assert not outcome.outgoing


@pytest.mark.slow
def test_equal_questions_are_one_message_and_equal_claims_equal_outcomes(fleet: ModelRegistry) -> None:
    one, other = begun(fleet), begun(fleet)
    assert one[2] == other[2]
    assert one[0].give(one[2]) == other[0].give(other[2])


@pytest.mark.slow
def test_a_verification_that_fails_sends_the_fallback_set_with_the_next_window(
    fleet: ModelRegistry, monkeypatch
) -> None:
    queue, update, queued = begun(fleet)
    with monkeypatch.context() as patched:
        failing(patched)
        outcome = queue.give(queued)
    assert kinds(outcome) == ["verification", "withdrawn"]
    assert "settles on 3.0 %" in outcome.evidence[0].status
    assert f"the verification of version {update.version} failed" in outcome.evidence[1].status
    assert not outcome.outgoing  # the edge takes nothing that stands on no newer window
    following = queue.window(1, update.version)
    back = sent(following)
    fallback_certificate = certified_policy(SERVO, fleet.models[0].settings).fallback()
    assert back.base_version == update.version
    assert back.data_time > update.data_time
    law = fallback_certificate.setting.controller.replace(feedforward=back.setting.gains.feedforward)
    assert back.setting.gains == gains_of(law)
    assert not following.enqueue
    statuses = {row.kind: row.status for row in following.evidence}
    assert "the verification of version" in statuses["glance"]
    assert statuses["redesign"].endswith("are asked; the fallback set is sent")


@pytest.mark.slow
def test_after_a_withdrawal_everything_is_verified_before_it_is_sent(fleet: ModelRegistry, monkeypatch) -> None:
    queue, update, queued = begun(fleet)
    with monkeypatch.context() as patched:
        failing(patched)
        queue.give(queued)
    back = sent(queue.window(1, update.version))
    queue.applied(back)
    looked_up, made = [], []
    plain, exact = TablePolicy.verify, certified_module.certify
    monkeypatch.setattr(TablePolicy, "verify", lambda *given: looked_up.append(1) or plain(*given))
    monkeypatch.setattr(certified_module, "certify", lambda *given: made.append(1) or exact(*given))
    # The first window is of the fallback set, which was sent.
    outcome = queue.window(0, back.version, sequence=2, start=windows()[2].start, reason="asked for")
    assert "redesign" in kinds(outcome)
    assert (len(looked_up), len(made)) == (0, 1)
    assert not outcome.enqueue


@pytest.mark.slow
def test_a_held_machine_says_that_its_setting_failed_until_the_fallback_set_was_sent(
    fleet: ModelRegistry, monkeypatch
) -> None:
    queue, update, queued = begun(fleet)
    queue.act(Act("axis", ActKind.HOLD, "eva", "inspection", 1.0))
    with monkeypatch.context() as patched:
        failing(patched)
        queue.give(queued)

    held = {row.kind: row.status for row in queue.window(1, update.version, reason="asked for").evidence}
    assert "roll back to the fallback set" in held["redesign"]
    assert b" failed" in queue.state
    queue.act(Act("axis", ActKind.ROLL_BACK, "eva", "as advised", 2.0))
    assert sent(queue.window(2, update.version, reason="asked for")).base_version == update.version
    assert b" failed" not in queue.state


@pytest.mark.slow
def test_what_is_no_longer_in_force_is_not_verified_any_more(fleet: ModelRegistry, monkeypatch) -> None:
    queue, _, queued = begun(fleet)
    question = decode_request(queued.body)
    law = question.setting.controller.replace(Kp=2.0 * question.setting.controller.Kp)
    other = msgspec.structs.replace(question, setting=replace(question.setting, controller=law))
    failing(monkeypatch)
    before = queue.state
    outcome = queue.give(queued._replace(body=msgspec.msgpack.encode(other)))
    assert kinds(outcome) == ["verification"]
    assert outcome.evidence[0].status == "not verified: another setting is in force by now"
    assert queue.state == before


@pytest.mark.slow
def test_a_fallback_of_the_edge_has_the_next_window_estimated(fleet: ModelRegistry) -> None:
    queue, update, _ = begun(fleet)
    quiet = queue.window(1, update.version)
    assert kinds(quiet) == ["glance"]
    notice = Fallback(
        "axis", update.window[0], 1000, Cause.ERROR, 1.0, 0.5, update.version, update.version + 1, Setting(0.0)
    )
    queue.give(notice)
    outcome = queue.window(2, update.version + 1)
    assert "estimate" in kinds(outcome)
    assert {row.kind: row.status for row in outcome.evidence}["glance"] == "the edge has fallen back"


@pytest.mark.slow
def test_an_update_on_its_way_is_not_sent_again_once_its_verification_failed(fleet: ModelRegistry, monkeypatch) -> None:
    queue = Queue(fleet)
    outcome = queue.window(0)
    assert outcome.wake is not None
    failing(monkeypatch)
    after = queue.give(outcome.enqueue[0])
    assert kinds(after) == ["verification", "withdrawn"]
    assert after.wake is None


@pytest.mark.slow
def test_what_is_no_question_fails_alone(fleet: ModelRegistry) -> None:
    queue, _, queued = begun(fleet)
    before = queue.state
    outcome = queue.give(queued._replace(body=b"\x93"))
    assert outcome.evidence[0].status.startswith("failed: InvalidInput: the verification request is not understood")
    assert queue.state == before


@pytest.mark.slow
def test_without_a_table_a_question_fails_alone(fleet: ModelRegistry) -> None:
    queue, _, queued = begun(fleet)
    model = replace(fleet.models[0], settings=SETTINGS)
    queue.fleet = replace(fleet, models=(model,))
    assert "the twin uses no table any more" in queue.give(queued).evidence[0].status


@pytest.mark.slow
def test_a_question_comes_back_from_its_bytes(fleet: ModelRegistry) -> None:
    _, _, queued = begun(fleet)
    question = decode_request(queued.body)
    assert isinstance(question, VerificationRequest)
    assert msgspec.msgpack.encode(question) == queued.body
    policy = certified_policy(SERVO, fleet.models[0].settings)
    assert isinstance(policy.confirm(question.region, question.setting), Certificate)


@pytest.mark.slow
def test_an_earlier_setting_is_verified_again_before_it_is_sent(
    fleet: ModelRegistry, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue, update, _ = begun(fleet)
    act = Act("axis", ActKind.ROLL_BACK, "eva", "it hums", 1.0, version=update.version)
    assert [row.status for row in queue.act(act).evidence] == ["rolled back by eva: it hums"]
    again = sent(queue.window(1, version=update.version))
    assert again.verification is not None
    assert (again.version, again.base_version) == (update.version + 1, update.version)
    assert again.setting.same_loop(update.setting)
    queue.applied(again)
    queue.act(msgspec.structs.replace(act, version=None))
    outcome = queue.window(2, version=again.version)
    assert sent(outcome).verification is not None
    (reason,) = (row.status for row in outcome.evidence if row.kind == "redesign")
    assert reason == "rolled back by eva: it hums; the fallback set is sent"
    queue, update, _ = begun(fleet)
    queue.act(act)
    failing(monkeypatch)
    refused = queue.window(1, version=update.version)
    assert refused.outgoing == ()
    (reason,) = (row.status for row in refused.evidence if row.kind == "redesign")
    assert reason.startswith(f"version {update.version} is not sent again: the setting settles on 3.0 %")
