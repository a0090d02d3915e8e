"""A setting that the edge has already is sent again only for a gap that it was not told."""

from twin_messages import receipt, twin_of, window_message

from servotwin.control.gains import gains_of
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.window import Window
from servotwin.messages import Reason, Setting
from servotwin.plant.servo import Servo
from servotwin.redesign.policy import PaperPolicy
from servotwin.twin.twin import Twin

SERVO = Servo.preset("paper")
STD = 0.01
"""rad, standard deviation of each estimate, with the model's floor."""


def twin_that_sees(gaps: list[float], k_dz: float = 0.0) -> Twin:
    """A twin with the paper's rule whose windows show these gaps (rad)."""
    shown = iter(gaps)

    def estimate(window: Window, _expected: Expectation) -> GapEstimate:
        gap = next(shown)
        return GapEstimate(gap, 0.1 * STD, STD, (gap - STD, gap + STD), GapStatus.OK, window.mid_time)

    return twin_of(estimate, PaperPolicy(SERVO, k_dz), start=Setting(0.0, gains_of(SERVO.controller)))


class Edge:
    """An edge's answers to a twin."""

    def __init__(self, twin: Twin) -> None:
        self.twin, self.sequence, self.in_force = twin, 0, 0

    def told(self, reason: Reason = Reason.APPLIED) -> list[float | None]:
        """Send a window, answer the update that follows, and return its gap; empty: none follows."""
        self.sequence += 1
        time = 10.0 * self.sequence
        sent = self.twin.receive(window_message(self.sequence, time, version=self.in_force), time)[1:]
        for update in sent:
            self.in_force = update.version if reason is Reason.APPLIED else self.in_force
            self.twin.receive(receipt(update, reason, self.in_force), time + 1.0)
        return [update.gap for update in sent]


def test_an_equal_setting_is_not_sent_again_while_the_gap_is_the_one_that_was_told() -> None:
    """Within one standard deviation, the model's floor included. A gap that moves is told, slowly or faster."""
    gaps = [0.1, 0.105, 0.095, 0.109, 0.112, 0.12, 0.14, 0.135]
    edge = Edge(twin_that_sees(gaps))
    assert [edge.told() for _ in gaps] == [[0.1], [], [], [], [0.112], [], [0.14], []]
    redesign = edge.twin.log.redesigns["axis", "boot-1", 2]
    assert (redesign.setting, redesign.gap) == (None, 0.105)
    assert "in force already" in redesign.reason


def test_an_equal_setting_that_the_edge_did_not_take_is_sent_again() -> None:
    edge = Edge(twin_that_sees([0.1, 0.1, 0.1]))
    assert edge.told(Reason.EXPIRED) == [0.1]
    assert edge.told() == [0.1]
    assert edge.told() == []


def test_a_twin_that_waits_for_the_answer_sends_the_newest_gap() -> None:
    twin = twin_that_sees([0.1, 0.1])
    for k in (1, 2):
        assert len(twin.receive(window_message(k, 10.0 * k), 10.0 * k)) == 2


def test_a_dead_zone_follows_every_estimate() -> None:
    gaps = [0.1, 0.101, 0.1005]
    edge = Edge(twin_that_sees(gaps, k_dz=1.0))
    assert [edge.told() for _ in gaps] == [[gap] for gap in gaps]
