"""The role control: a sample comes, the law ticks, the voltage goes; then the agent sees what happened."""

from __future__ import annotations

from math import isfinite

from servotwin.control.law import LawParameters, LawState, start, tick, transfer
from servotwin.edge.drive import ControlDrive, Sample
from servotwin.edge.parameters import Parameters
from servotwin.edge_process.edge import Edge


class Law:
    """The law in force and its state, safe against samples that are no numbers.

    The last voltage is held for a while, then the safe one is given; with the first good sample after that the law
    begins anew, as after a start. A law whose state is no number any more begins anew at once.

    Parameters
    ----------
    law : LawParameters
    hold : int
        Bad samples in a row through which the last voltage is held.
    safe : float
        V.
    """

    def __init__(self, law: LawParameters, hold: int, safe: float) -> None:
        self.law = law
        self.state: LawState | None = None
        self.bad = 0
        self._hold, self._safe, self.voltage = hold, safe, safe

    def change(self, law: LawParameters, reference: float, position: float) -> None:
        """Another law from the tick that is due on; the voltage stays."""
        if self.state is not None:
            self.state = transfer(self.law, law, self.state, reference, position)
        self.law = law

    def tick(self, reference: float, position: float) -> float:
        """The voltage (V) for a sample."""
        if not isfinite(reference + position):
            return self._without()
        state = tick(self.law, start(position) if self.state is None else self.state, reference, position)
        if not isfinite(state.voltage + state.integral + state.derivative):
            self.state, self.voltage = None, self._safe
            return self._safe
        self.bad, self.state, self.voltage = 0, state, state.voltage
        return state.voltage

    def _without(self) -> float:
        self.bad += 1
        if self.bad > self._hold:
            self.state, self.voltage = None, self._safe
        return self.voltage


class Controlling:
    """Runs the law on a drive.

    Parameters
    ----------
    edge : Edge
    drive : ControlDrive
        Connected by whoever runs this.
    """

    def __init__(self, edge: Edge, drive: ControlDrive) -> None:
        self._edge, self._drive = edge, drive
        sensor, rate = edge.config.sensor, edge.config.agent.sample_rate
        self._in_force = edge.agent.parameters
        self.law = Law(self._law(self._in_force), round(sensor.hold_s * rate), sensor.safe_voltage)
        self._safe = sensor.safe_voltage
        self._machine, self._away = drive.machine, False
        self._reference = edge.config.agent.reference

    def step(self) -> bool:
        """One sample; whether the run goes on. Raises `DriveLost`."""
        sample = self._drive.read()
        began = self._edge.clock()
        if sample is None:
            return False
        if sample.number != self._edge.due or self._away:
            self._jumped(sample.number)
        self._edge.due = sample.number + 1
        self._tick(sample)
        self._edge.exchange()
        ended = self._edge.clock()
        self._edge.ticks.add(ended - began)
        self._edge.tend()
        return True

    def lost(self) -> None:
        """The drive is away: what it does meanwhile is not known."""
        self.law.state, self._away = None, True

    def stop(self) -> None:
        """Leave the machine with the safe voltage; raises `DriveLost`."""
        if self._drive.read() is not None:
            self._drive.write(self._safe)

    def _tick(self, sample: Sample) -> None:
        edge, agent = self._edge, self._edge.agent
        if isfinite(sample.reference):
            self._reference = sample.reference  # where there is none, the last one holds
        wanted = self._reference + agent.offset
        if agent.parameters is not self._in_force and isfinite(sample.position):
            self._follow(agent.parameters, wanted, sample.position)
        voltage = self.law.tick(wanted, sample.position)
        self._drive.write(voltage)
        if not isfinite(sample.reference + sample.theta_m + sample.position):
            edge.counts["bad samples"] += 1
        edge.send(agent.absorb(wanted, sample.theta_m, sample.position, voltage))

    def _jumped(self, number: int) -> None:
        """Samples are missing, in which the voltage was held, or they are counted anew."""
        if self._edge.due is None:
            return
        same = self._drive.machine == self._machine
        self._machine, self._away = self._drive.machine, False
        if not same or number != self._edge.due:
            missing = number - self._edge.due if same else -1
            self._edge.skip(missing, self._reference + self._edge.agent.offset, self.law.voltage)

    def _follow(self, parameters: Parameters, wanted: float, position: float) -> None:
        """Run on these; a new boot brings the old ones once more, or what came with the last sample before it."""
        self._in_force, law = parameters, self._law(parameters)
        if law != self.law.law:
            self.law.change(law, wanted, position)

    def _law(self, parameters: Parameters) -> LawParameters:
        return self._edge.config.law(self._edge.agent.controller, parameters.setting.tolerance)
