"""The role supervise: the drive controls by itself; its samples come in blocks, its parameters are written."""

from __future__ import annotations

from math import nan

from servotwin.edge.drive import Block, DriveRefused, SupervisedDrive
from servotwin.edge.parameters import Parameters
from servotwin.edge_process.edge import Edge
from servotwin.edge_process.log import say

LONGEST_BLOCK_S = 0.05
"""What comes from the twin waits no longer than this for the drive."""


class Supervising:
    """Records a drive and writes its parameters.

    Parameters
    ----------
    edge : Edge
    drive : SupervisedDrive
        Connected by whoever runs this.
    """

    def __init__(self, edge: Edge, drive: SupervisedDrive) -> None:
        self._edge, self._drive = edge, drive
        self._most = max(1, round(LONGEST_BLOCK_S * edge.config.agent.sample_rate))
        self._machine = drive.machine
        self._written: Parameters | None = None
        self._taken: Parameters | None = None
        self._moved, self._reference = 0.0, edge.config.agent.reference

    def step(self) -> bool:
        """One block; whether the run goes on. Raises `DriveLost`."""
        self._follow()
        if self._drive.patient:
            self._edge.wait_for_link()
        block = self._drive.read(self._until())
        began = self._edge.clock()
        if block is None:
            return False
        if len(block.reference) > 0:
            self._absorb(block)
        self._edge.exchange()
        self._edge.ticks.add(self._edge.clock() - began)
        self._edge.tend()
        return True

    def lost(self) -> None:
        """The drive is away: what it runs on when it comes back is not known."""
        self._written, self._moved = None, 0.0

    def stop(self) -> None:
        """The drive runs on by itself, on its parameters; a probing move ends. Raises `DriveLost`."""
        if self._moved:
            self._drive.move(0.0)

    def _absorb(self, block: Block) -> None:
        due = block.first if self._edge.due is None else self._edge.due
        same, self._machine = self._drive.machine == self._machine, self._drive.machine
        if not same or block.first != due:
            self._edge.skip(block.first - due if same else -1, self._reference, nan)
        self._edge.due, self._reference = block.last, block.reference[-1]
        self._edge.send(self._edge.agent.absorb_block(block.reference, block.theta_m, block.position, block.voltage))

    def _until(self) -> int:
        """Samples to read: no further than to where the agent acts."""
        agent = self._edge.agent
        return self._most if agent.deadline is None else max(1, min(self._most, agent.deadline - agent.samples))

    def _follow(self) -> None:
        """Let the drive run as the agent wants it to."""
        agent = self._edge.agent
        if agent.parameters is not self._written:
            try:
                self._drive.write(agent.parameters)
                self._taken = agent.parameters
            except DriveRefused as refusal:
                self._refused(str(refusal))
            self._written = agent.parameters
        if agent.offset != self._moved:
            self._drive.move(agent.offset)
            self._moved = agent.offset

    def _refused(self, why: str) -> None:
        """The drive runs on what it took last: so does the agent, and the twin is told. At first nobody knows what that
        is."""
        self._edge.counts["parameters refused by the drive"] += 1
        say("drive refused", version=self._edge.agent.parameters.version, why=why)
        if self._taken is not None:
            self._edge.send(self._edge.agent.put_back(self._taken))
