"""The role supervise: the drive controls by itself; its samples come in blocks, its parameters are written."""

from __future__ import annotations

from math import nan

from servotwin.edge.drive import Block, DriveRefused, SettingWriter, SupervisedDrive
from servotwin.edge_process.edge import EdgeRuntime
from servotwin.edge_process.monitoring import log

_LONGEST_BLOCK_S = 0.05
"""Length of a block, the longest time for which a message of the twin's waits for the drive."""


class SupervisingRole:
    """Records a drive and writes its parameters.

    Parameters
    ----------
    edge : EdgeRuntime
    drive : SupervisedDrive
        The caller connects it.
    """

    def __init__(self, edge: EdgeRuntime, drive: SupervisedDrive) -> None:
        self._edge, self._drive = edge, drive
        self._most = max(1, round(_LONGEST_BLOCK_S * edge.config.agent.sample_rate))
        self._machine = drive.machine
        self._writer, self._reference = SettingWriter(drive), edge.config.agent.reference

    def step(self) -> bool:
        """Take one block; False: the run is over. Raises `DriveLost`."""
        self._apply()
        if self._drive.patient:
            self._edge.wait_for_link()
        block = self._drive.read(self._block_samples())
        began = self._edge.clock()
        if block is None:
            return False
        if len(block.reference) > 0:
            self._absorb(block)
        self._edge.exchange()
        self._edge.ticks.add(self._edge.clock() - began)
        self._edge.supervise()
        return True

    def lost(self) -> None:
        """Note that the drive is lost: its parameters after that are not known."""
        self._writer.forget()

    def stop(self) -> None:
        """End a probing move; the drive runs on by itself, on its parameters. Raises `DriveLost`."""
        if self._writer.moving:
            self._drive.move(0.0)

    def _absorb(self, block: Block) -> None:
        due = block.first if self._edge.due is None else self._edge.due
        same, self._machine = self._drive.machine == self._machine, self._drive.machine
        if not same or block.first != due:
            self._edge.skip(block.first - due if same else -1, self._reference, nan)
        self._edge.due, self._reference = block.last, block.reference[-1]
        self._edge.send(self._edge.agent.absorb_block(block.reference, block.theta_m, block.position, block.voltage))

    def _block_samples(self) -> int:
        """Number of samples to read: no further than to where the agent acts."""
        agent = self._edge.agent
        return self._most if agent.deadline is None else max(1, min(self._most, agent.deadline - agent.samples))

    def _apply(self) -> None:
        """Write the parameters and the offset to the drive where they have changed."""
        agent = self._edge.agent
        try:
            self._writer.write(agent)
        except DriveRefused as refusal:
            self._restore(str(refusal))
            self._writer.skip(agent.parameters)
            self._writer.write(agent)

    def _restore(self, why: str) -> None:
        """Restore the parameters that the drive accepted last, if any, and report that to the twin."""
        self._edge.counts["parameters refused by the drive"] += 1
        log("drive refused", version=self._edge.agent.parameters.version, why=why)
        if self._writer.accepted is not None:
            self._edge.send(self._edge.agent.restore(self._writer.accepted))
