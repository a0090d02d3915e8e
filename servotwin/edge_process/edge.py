"""What both roles have in common: the agent of each boot, its outlet, the link process, and what is told of them."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import Protocol

from servotwin.control.controller import Controller
from servotwin.edge.agent import Agent, Outgoing
from servotwin.edge.parameters import Parameters
from servotwin.edge.store import StoredParameters
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.frames import TicksFrame, Value
from servotwin.edge_process.log import say
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.ticks import Counts

Clock = Callable[[], float]
CHILD_S, TOLD_S, PIECE_S = 0.1, 1.0, 0.005
LET_UP_S = 1.0
BRIDGED_S = 1.0
"""Time without samples after which a new boot begins."""


class Child(Protocol):
    """Whatever takes what the outlet sends."""

    def tend(self, now: float) -> None:
        """See that it runs."""


class Carried:
    """The store of an agent whose disk is the link process's: begins with what it is given, hands on what is proved."""

    def __init__(self, first: Parameters | None, outlet: PipeOutlet) -> None:
        self._first, self._outlet = first, outlet

    def save(self, parameters: Parameters) -> None:
        """Let it be kept."""
        self._outlet.save(parameters)

    def load(self) -> Parameters | None:
        """What to begin with."""
        return self._first


class Edge:
    """One servo's edge, without its drive.

    Parameters
    ----------
    config : EdgeConfig
    boot : str
        This start's name; where samples are missing a boot begins within it, named after it.
    outlet : PipeOutlet
    child : Child
    first : Parameters, optional
        Kept from an earlier start.
    clock, pause : callable
        Monotonic, s; wait for so long, s.

    Attributes
    ----------
    due : int or None
        The drive's number of the sample that comes next; None: none has come yet.
    """

    def __init__(
        self,
        config: EdgeConfig,
        boot: str,
        outlet: PipeOutlet,
        child: Child,
        first: Parameters | None,
        clock: Clock,
        pause: Callable[[float], None],
    ) -> None:
        self.config, self.clock, self.pause = config, clock, pause
        self.counts: Counter[str] = Counter()
        self.due: int | None = None
        self.ticks = Counts()
        self._boot, self._boots = boot, 0
        self._outlet, self._child = outlet, child
        self._child_due = self._told_due = clock()
        self.agent = self._begun(first)

    def skip(self, missing: int, wanted: float, voltage: float) -> None:
        """Other samples than those that were due: a few that are missing cost the windows that they were in.

        Parameters
        ----------
        missing : int
            Samples; negative: they are counted anew.
        wanted, voltage : float
            m and V meanwhile, as far as known.
        """
        if not 0 < missing <= BRIDGED_S * self.config.agent.sample_rate:
            self._begin("samples missing" if missing > 0 else "machine counts anew")
            return
        self.counts["samples missed"] += missing
        unseen = array("d", [nan]) * missing
        held, given = array("d", [wanted]) * missing, array("d", [voltage]) * missing
        self.send(self.agent.absorb_block(held, unseen, unseen, given))

    def _begin(self, why: str) -> None:
        """Too many samples are missing, or they are counted anew: a new boot, on the parameters in force."""
        self._boots += 1
        self.counts[f"boot: {why}"] += 1
        self.agent = self._begun(StoredParameters.of(self.agent.parameters).parameters())

    def exchange(self) -> None:
        """Send a piece of what waits, and let the agent hear what has come."""
        heard = self._outlet.exchange()
        if heard is None:
            return
        for message in heard.messages:
            self.send(self.agent.receive(message))
        if heard.standing:
            self.agent.outlet_changed()
        if heard.back:
            self._outlet.say(self.agent.hello())

    def send(self, sent: list[Outgoing]) -> None:
        """What the agent says."""
        for each in sent:
            self._outlet.say(each.message)

    def tend(self) -> None:
        """Now and then: the link process, and the status."""
        now = self.clock()
        if now < self._child_due:
            return
        self._child_due = now + CHILD_S
        self._child.tend(now)
        if now >= self._told_due:
            self._told_due = now + TOLD_S
            self._outlet.tell(self._told())

    def wait_for_link(self) -> None:
        """Until the link process is not far behind, a while at most; for a drive whose samples wait."""
        end = self.clock() + LET_UP_S
        while self._outlet.behind and self.clock() < end:
            self.exchange()
            self.tend()
            self.pause(PIECE_S)

    def finish(self, seconds: float) -> None:
        """Give the link process a while to take what is left, while it takes any, and a last word on how it went."""
        end, told, left = self.clock() + seconds, False, self._outlet.untaken
        while self.clock() < end and not (told and self._outlet.settled):
            if self._outlet.untaken < left:
                end, left = self.clock() + seconds, self._outlet.untaken
            if self._outlet.settled:
                self._outlet.tell(self._told())
                told = True
            self.exchange()
            self._child.tend(self.clock())
            self.pause(PIECE_S)

    def _begun(self, first: Parameters | None) -> Agent:
        boot = f"{self._boot}.{self._boots}" if self._boots else self._boot
        self._outlet.boot = boot
        settings = replace(self.config.agent, boot=boot)
        agent = Agent(settings, store=Carried(first, self._outlet), outlet=self._outlet)
        self._outlet.say(agent.hello())
        say("boot", boot=boot, version=agent.parameters.version, tolerance_m=agent.parameters.setting.tolerance)
        return agent

    def _told(self) -> TicksFrame:
        agent, p = self.agent, self.agent.parameters
        values: dict[str, Value] = {
            "version": p.version,
            "tolerance_m": p.setting.tolerance,
            "gap_rad": p.gap,
            "fallback": p.fallback,
            "windows_cut": agent.windows_cut,
            "longest_tick_s": self.ticks.longest,
            "drive_sample": self.due,
            **_gains(agent.controller or self.config.controller),
            **self.counts,
        }
        return TicksFrame(agent.settings.boot, agent.samples, values, dict(self._outlet.lost), self.ticks.dumps())


def _gains(law: Controller | None) -> dict[str, Value]:
    """Of the controller in force, as far as it is known here."""
    if law is None:
        return {}
    return {
        "kp_v_per_m": law.Kp,
        "ki_v_per_m_s": law.Ki,
        "kd_v_s_per_m": law.Kd,
        "feedforward_v": law.feedforward,
    }
