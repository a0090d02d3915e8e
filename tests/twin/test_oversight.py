"""Acts of engineers: holds, approvals, and earlier settings that are sent again."""

import msgspec
import pytest
from msgspec.structs import replace
from twin_messages import PITCH, make, receipt, window_message

from servotwin.messages import (
    Cause,
    Fallback,
    Hello,
    InvalidMessage,
    Reason,
    Setting,
    Update,
)
from servotwin.messages.acts import Act, ActKind, decode_act, encode_act


def act(kind, why="the bearing is replaced", **named):
    return Act("axis", kind, "eva", why, 5.0, **named)


class Overseen:
    """A twin to which windows come every 10 s; every update is applied."""

    def __init__(self, **settings):
        self.twin, self.log = make(**settings)
        self.number, self.version = 0, 0

    def window(self, boot="boot-1"):
        """The update that a window leads to; None: none."""
        self.number += 1
        at = 10.0 * self.number
        sent = window_message(self.number, at, boot=boot, version=self.version)
        return self._taken(self.twin.receive(sent, at))

    def do(self, *arguments, **named):
        """Do an act; the update that it leads to, and why it was refused."""
        return self._taken(self.twin._step(act(*arguments, **named), 10.0 * self.number)), self.log.acts[-1].refused

    def _taken(self, answers):
        updates = [each for each in answers if isinstance(each, Update)]
        for update in updates:
            self.twin.receive(receipt(update), 10.0 * self.number)
            self.version = update.version
        return updates[0] if updates else None

    def why(self):
        return list(self.log.redesigns.values())[-1].reason


def test_a_held_machine_gets_no_version_until_it_is_released():
    overseen = Overseen()
    assert overseen.window().version == 1
    assert overseen.do(ActKind.HOLD) == (None, "")
    assert overseen.window() is None
    assert overseen.why() == "held by eva: the bearing is replaced"
    assert len(overseen.log.estimates) == 2  # it is estimated as before
    overseen.twin.restore(overseen.twin.state())
    assert overseen.window() is None
    overseen.do(ActKind.RELEASE)
    assert overseen.window().version == 2
    assert overseen.do(ActKind.RELEASE)[1] == "nobody holds it"


def test_a_hold_ends_the_repetition_of_what_is_on_its_way():
    twin, _ = make(retry=5.0)
    _, update = twin.receive(window_message(1, 10.0), 10.0)
    twin._step(act(ActKind.HOLD), 11.0)
    assert twin.wake(100.0) == []
    assert twin.receive(receipt(update, Reason.BASE_MISMATCH, in_force=7), 101.0) == []


def test_an_earlier_setting_is_sent_as_a_new_version_on_the_next_window_and_stays():
    overseen = Overseen()
    first, second = overseen.window(), overseen.window()
    assert second.setting != first.setting
    assert overseen.do(ActKind.ROLL_BACK, version=first.version) == (None, "")
    again = overseen.window()
    assert (again.version, again.base_version, again.setting) == (3, 2, first.setting)
    assert again.data_time == 30.0  # on new data, which the edge's guard demands
    assert overseen.log.acts[-1] == (overseen.log.acts[-2].act, "", True)
    assert overseen.window() is None
    assert overseen.why().startswith("rolled back by eva")
    overseen.do(ActKind.RELEASE)
    assert overseen.window().setting.tolerance == pytest.approx(PITCH * 0.5)


@pytest.mark.parametrize(("version", "said"), [(9, "the setting of version 9 is not known"), (None, "no fallback set")])
def test_what_cannot_be_sent_again_is_refused_and_nothing_changes(version, said):
    overseen = Overseen()
    overseen.window()
    assert said in overseen.do(ActKind.ROLL_BACK, version=version)[1]
    assert overseen.window() is not None


def test_a_proposal_waits_for_its_approval_and_is_sent_on_what_is_in_force_then():
    overseen = Overseen(validity=100.0)
    overseen.window()
    overseen.do(ActKind.ASK_FIRST)
    assert overseen.window() is None
    (proposal,) = overseen.log.proposals
    assert proposal.update.setting.tolerance == pytest.approx(PITCH * 0.2)
    assert overseen.window() is None
    assert len(overseen.log.proposals) == 1  # it stays while it is looked at
    other = ("boot-1", proposal.update.window[1] + 1)
    assert "another proposal" in overseen.do(ActKind.APPROVE, window=other)[1]
    update, refused = overseen.do(ActKind.APPROVE, window=proposal.update.window)
    assert refused == ""
    assert (update.version, update.base_version, update.setting) == (2, 1, proposal.update.setting)
    assert overseen.do(ActKind.APPROVE, window=proposal.update.window)[1] == "no proposal waits"
    overseen.do(ActKind.ASK_NO_MORE)
    assert overseen.window().version == 3


def test_a_proposal_gives_way_to_a_newer_one_expires_and_ends_with_the_boot():
    overseen = Overseen(validity=25.0)
    overseen.do(ActKind.ASK_FIRST)
    for _ in range(3):
        overseen.window()
    first, second = (each.update for each in overseen.log.proposals)
    assert (first.data_time, second.data_time) == (10.0, 30.0)  # the one at 20 s came within half of the validity
    newest = overseen.twin._state.newest
    for start, said in ((60.0, "expired"), (54.0, "")):
        overseen.twin._state = replace(overseen.twin._state, newest=(newest[0], start))
        assert said in overseen.do(ActKind.APPROVE, window=second.window)[1]
    overseen.number = 6
    overseen.window()
    third = overseen.log.proposals[-1].update
    overseen.twin.receive(Hello("axis", "boot-2", 0.0, 1000.0, 2, Setting(0.0), "m"), 80.0)
    overseen.twin._state = replace(overseen.twin._state, newest=("boot-2", 0.0))
    update, refused = overseen.do(ActKind.APPROVE, window=third.window)
    assert update is None
    assert "started again" in refused


def test_a_proposal_ends_where_the_edge_falls_back():
    overseen = Overseen(validity=100.0)
    overseen.window()
    overseen.do(ActKind.ASK_FIRST)
    overseen.window()
    proposal = overseen.log.proposals[-1].update
    fallback = Fallback("axis", "boot-1", 2100, Cause.LIMIT_CYCLE, 1e-3, 1e-4, 1, 2, Setting(2e-4))
    overseen.twin.receive(fallback, 21.0)
    assert overseen.do(ActKind.APPROVE, window=proposal.window) == (None, "no proposal waits")


def test_another_act_does_not_end_the_repetition_of_a_roll_back():
    twin, log = make(retry=5.0)
    _, first = twin.receive(window_message(1, 10.0), 10.0)
    twin.receive(receipt(first), 10.0)
    twin._step(act(ActKind.ROLL_BACK, version=1), 11.0)
    _, again = twin.receive(window_message(2, 20.0, version=1), 20.0)
    twin._step(act(ActKind.ASK_FIRST), 21.0)
    twin._step(act(ActKind.ROLL_BACK, version=99), 21.0)
    assert "not known" in log.acts[-1].refused
    assert twin.wake(30.0) == [again]


@pytest.mark.parametrize(
    "wrong",
    [
        {"why": " "},
        {"why": "two\nlines"},
        {"why": "x" * 300},
        {"window": ("b", 1)},
        {"version": 1},
        {"act": "destroy"},
        {"who": ""},
        {"act": "approve"},
        {"time": float("inf")},
    ],
)
def test_an_act_that_makes_no_sense_is_refused(wrong):
    body = {"type": "act/1", "servo": "axis", "act": "hold", "who": "eva", "why": "noise", "time": 1.0}
    assert decode_act(encode_act(act(ActKind.HOLD))) == act(ActKind.HOLD)
    decode_act(msgspec.msgpack.encode(body))
    with pytest.raises(InvalidMessage):
        decode_act(msgspec.msgpack.encode(body | wrong))
