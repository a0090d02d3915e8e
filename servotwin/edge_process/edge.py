"""Runtime of one edge, the same in both roles: the agent of each boot, its outlet, the link process, the status."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import Protocol

import msgspec

from servotwin.control.cascade import Cascade
from servotwin.control.gains import gains_of, written_gains
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.edge.agent import Agent, ScheduledMessage
from servotwin.edge.parameters import Parameters
from servotwin.edge.recorder import Recorder
from servotwin.edge.store import StoredParameters
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.frames import StatusFrame, Value
from servotwin.edge_process.monitoring import TickHistogram, log
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.shared_samples import MakeRecorder
from servotwin.runtime.service_manager import ServiceManager
from servotwin.runtime.token_bucket import TokenBucket

Clock = Callable[[], float]
CHECK_PERIOD_S, STATUS_PERIOD_S, PAUSE_S = 0.1, 1.0, 0.005
_LONGEST_WAIT_FOR_LINK_S = 1.0
_LONGEST_GAP_S = 1.0
"""Time without samples after which a new boot begins."""
_NAMES, _NAMES_PER_S = 10.0, 1.0
"""Boots without a window that are named at once, and later on."""


class _LinkProcessChild(Protocol):
    """The link process, seen from the control process."""

    def check(self, now: float) -> None:
        """Restart it where it has ended."""


class _LinkParameterStore:
    """Parameter store of an agent that leaves the disk to the link process."""

    def __init__(self, first: Parameters | None, outlet: PipeOutlet) -> None:
        self._first, self._outlet = first, outlet

    def save(self, parameters: Parameters) -> None:
        """Have parameters stored by the link process."""
        self._outlet.save(parameters)

    def load(self) -> Parameters | None:
        """Return the parameters stored by an earlier boot."""
        return self._first


class EdgeRuntime:
    """One servo's edge, without its drive.

    Parameters
    ----------
    config : EdgeConfig
    boot : str
        Name of this start; a boot that begins within it, after missing samples, is named after it.
    outlet : PipeOutlet
    child : LinkChild
    first : Parameters, optional
        Parameters stored by an earlier start.
    clock, pause : callable
        Returns monotonic seconds; waits for a number of seconds.
    manager : ServiceManager, optional
        Gets a sign of life while samples, or tries to reach the drive, follow each other.
    recorder : callable, optional
        Makes the ring buffer of each boot.

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
        child: _LinkProcessChild,
        first: Parameters | None,
        clock: Clock,
        pause: Callable[[float], None],
        manager: ServiceManager | None = None,
        recorder: MakeRecorder = Recorder,
    ) -> None:
        self.config, self.clock, self.pause = config, clock, pause
        self.counts: Counter[str] = Counter()
        self.due: int | None = None
        self.ticks = TickHistogram()
        self._boot, self._boots, self._superseded = boot, 0, False
        self._outlet, self._child, self._recorder = outlet, child, recorder
        self._manager = manager or ServiceManager({})
        self._check_due = self._status_due = clock()
        self._names = TokenBucket(_NAMES, _NAMES_PER_S, clock)
        self.agent = self._new_agent(first)

    def skip(self, missing: int, reference: float, voltage: float) -> None:
        """Continue after missing samples: a few cost the windows that they were in, more begin a new boot.

        Parameters
        ----------
        missing : int
            Number of missing samples; negative: the count began anew.
        reference, voltage : float
            Reference and voltage meanwhile, m and V; NaN where not known.
        """
        if not 0 < missing <= _LONGEST_GAP_S * self.config.agent.sample_rate:
            self._new_boot("samples missing" if missing > 0 else "machine counts anew")
            return
        self.counts["samples missed"] += missing
        # Not a number, so that a window with them is dropped: a guess would be estimated as if it were measured.
        unknown = array("d", [nan]) * missing
        references, voltages = array("d", [reference]) * missing, array("d", [voltage]) * missing
        self.send(self.agent.absorb_block(references, unknown, unknown, voltages))

    def _new_boot(self, why: str) -> None:
        """Begin a new boot, on the parameters in force."""
        self.counts[f"boot: {why}"] += 1
        # Samples count from 0 again, so the boot needs another name: the twin must not confuse their windows. Where a
        # drive misnumbers every sample, one without windows keeps its name, or its boots would fill log and store.
        named = self.agent.windows_cut > 0 or self._names.take()
        self._boots += named
        self.agent = self._new_agent(StoredParameters.of(self.agent.parameters).parameters(), named)
        if self._superseded:
            self.send(self.agent.superseded())

    def exchange(self) -> None:
        """Exchange a piece with the link process, and give the agent the messages that have arrived."""
        received = self._outlet.exchange()
        if received is None:
            return
        for message in received.messages:
            self.send(self.agent.receive(message))
        if received.pending_changed:
            self.agent.outlet_changed()
        if received.superseded:
            log("conflict", boot=self.agent.settings.boot)
            self._superseded = True
            self.send(self.agent.superseded())
        if received.reconnected:
            self._outlet.send_letter(self.agent.hello())

    def send(self, messages: list[ScheduledMessage]) -> None:
        """Send the agent's messages to the twin."""
        for each in messages:
            self._outlet.send_letter(each.message)

    def supervise(self) -> None:
        """Check the link process and send the status, each when it is due."""
        now = self.clock()
        if now < self._check_due:
            return
        self._check_due = now + CHECK_PERIOD_S
        self._manager.alive(now)
        self._child.check(now)
        if now >= self._status_due:
            self._status_due = now + STATUS_PERIOD_S
            self._outlet.send_status(self._status())

    def wait_for_link(self) -> None:
        """Wait while the link process is far behind, a second at most; only for a drive whose samples wait."""
        end = self.clock() + _LONGEST_WAIT_FOR_LINK_S
        while self._outlet.congested and self.clock() < end:
            self.exchange()
            self.supervise()
            self.pause(PAUSE_S)

    def finish(self, seconds: float) -> None:
        """Wait until the link process has taken all windows, and send it a last status.

        Parameters
        ----------
        seconds : float
            Time after which this gives up where the link process takes no further window.
        """
        end, status_sent, left = self.clock() + seconds, False, self._outlet.untaken
        while self.clock() < end and not (status_sent and self._outlet.idle):
            if self._outlet.untaken < left:
                # Each window that is taken gives more time: a slow disk is not a dead link process.
                end, left = self.clock() + seconds, self._outlet.untaken
            if self._outlet.idle:
                self._outlet.send_status(self._status())
                status_sent = True
            self.exchange()
            self._child.check(self.clock())
            self.pause(PAUSE_S)

    def _new_agent(self, first: Parameters | None, named: bool = True) -> Agent:
        boot = f"{self._boot}.{self._boots}" if self._boots else self._boot
        self._outlet.boot = boot
        settings = replace(self.config.agent, boot=boot)
        store = _LinkParameterStore(first, self._outlet)
        agent = Agent(settings, store=store, outlet=self._outlet, recorder=self._recorder)
        if named:
            self._outlet.send_letter(agent.hello())
            tolerance = {self.config.units.key("tolerance_m"): agent.parameters.setting.tolerance}
            log("boot", boot=boot, version=agent.parameters.version, **tolerance)
        return agent

    def _status(self) -> StatusFrame:
        agent, p = self.agent, self.agent.parameters
        law, units = agent.controller or self.config.controller, self.config.units
        values: dict[str, Value] = {
            "version": p.version,
            units.key("tolerance_m"): p.setting.tolerance,
            "gap_rad": p.gap,
            "fallback": p.fallback,
            "windows_cut": agent.windows_cut,
            "longest_tick_s": self.ticks.longest,
            "drive_sample": self.due,
            **units.named(_gains(law)),
            **self.counts,
        }
        return StatusFrame(agent.settings.boot, agent.samples, values, dict(self._outlet.lost), self.ticks.dumps())


def _gains(law: AnyController | None) -> dict[str, Value]:
    """Gains of the controller in force, for the status; empty where the drive's own controller is not known."""
    if law is None:
        return {}
    if isinstance(law, LinearLaw):
        gains = msgspec.structs.asdict(gains_of(law))
        return {"feedforward_v" if name == "feedforward" else name: value for name, value in gains.items()}
    if isinstance(law, Cascade):
        return written_gains(gains_of(law), law)
    return {
        "kp_v_per_m": law.Kp,
        "ki_v_per_m_s": law.Ki,
        "kd_v_s_per_m": law.Kd,
        "feedforward_v": law.feedforward,
        "velocity_feedforward_v_s_per_m": law.velocity_feedforward,
        "friction_feedforward_v": law.friction_feedforward,
        "notch_hz": law.notch_hz,
    }
