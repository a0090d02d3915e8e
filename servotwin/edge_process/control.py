"""The role control: read a sample, tick the law, write the voltage; then the agent takes the sample."""

from __future__ import annotations

from math import isfinite

from servotwin.control.running_law import RunningLaw, RunningState, command_of, is_finite
from servotwin.edge.drive import ControlDrive, DriveSample
from servotwin.edge.parameters import Parameters
from servotwin.edge_process.edge import EdgeRuntime

_UNREAD = 0.0
"""rad, angle of a motor without encoder: no law reads it there, and it is not recorded."""


class GuardedLaw:
    """The law in force and its state, guarded against samples that are not finite.

    It holds the last voltage for a while, then applies the safe one; with the first good sample after that the law
    begins anew, as after a start. A law whose state is not finite begins anew at once.

    Parameters
    ----------
    law : RunningLaw
    hold : int
        Number of bad samples in a row during which the last voltage is held.
    safe : float
        V.
    """

    def __init__(self, law: RunningLaw, hold: int, safe: float) -> None:
        self.law = law
        self.state: RunningState | None = None
        self.bad = 0
        self._hold, self._safe, self.voltage = hold, safe, safe

    def change(self, law: RunningLaw, reference: float, theta_m: float, position: float) -> None:
        """Change the law from the next tick on; the voltage does not jump."""
        if self.state is not None:
            self.state = law.take_over(self.law, self.state, reference, theta_m, position)
        self.law = law

    def is_good(self, theta_m: float, position: float) -> bool:
        """True for a sample on which the law can act: what it reads is finite."""
        return isfinite(position if self.law.reads_load_only else theta_m + position)

    def tick(self, reference: float, theta_m: float, position: float) -> float:
        """Return the voltage (V) for a sample (m, rad, m)."""
        if not (isfinite(reference) and self.is_good(theta_m, position)):
            return self._bad_sample()
        before = self.law.start(theta_m, position) if self.state is None else self.state
        state = self.law.tick(before, reference, theta_m, position)
        if not is_finite(state):
            self.state, self.voltage = None, self._safe
            return self._safe
        self.bad, self.state, self.voltage = 0, state, command_of(state)
        return self.voltage

    def _bad_sample(self) -> float:
        self.bad += 1
        if self.bad > self._hold:
            self.state, self.voltage = None, self._safe
        return self.voltage


class ControlRole:
    """Runs the law on a drive.

    Parameters
    ----------
    edge : EdgeRuntime
    drive : ControlDrive
        The caller connects it.
    """

    def __init__(self, edge: EdgeRuntime, drive: ControlDrive) -> None:
        self._edge, self._drive = edge, drive
        sensor, rate = edge.config.sensor, edge.config.agent.sample_rate
        self._applied = edge.agent.parameters
        self.law = GuardedLaw(self._law(self._applied), round(sensor.hold_s * rate), sensor.safe_voltage)
        self._safe = sensor.safe_voltage
        self._machine, self._drive_lost = drive.machine, False
        self._reference, self._motor_encoder = edge.config.agent.reference, edge.config.agent.motor_encoder

    def step(self) -> bool:
        """Control one sample; False: the run is over. Raises `DriveLost`."""
        sample = self._drive.read()
        # After `read`, which waits for the sample instant: the tick's time is that of the computation.
        began = self._edge.clock()
        if sample is None:
            return False
        if not self._motor_encoder:
            sample = sample._replace(theta_m=_UNREAD)
        if sample.number != self._edge.due or self._drive_lost:
            self._jumped(sample.number)
        self._edge.due = sample.number + 1
        self._tick(sample)
        self._edge.exchange()
        ended = self._edge.clock()
        self._edge.ticks.add(ended - began)
        self._edge.supervise()
        return True

    def lost(self) -> None:
        """Note that the drive is lost; the law begins anew, since the machine's motion meanwhile is not known."""
        self.law.state, self._drive_lost = None, True

    def stop(self) -> None:
        """Apply the safe voltage; raises `DriveLost`."""
        if self._drive.read() is not None:
            self._drive.write(self._safe)

    def _tick(self, sample: DriveSample) -> None:
        edge, agent = self._edge, self._edge.agent
        if isfinite(sample.reference):
            self._reference = sample.reference  # the last one holds where this one is bad
        reference = self._reference + agent.offset
        # The transfer between two laws needs the measurement of this tick, so it waits for a good sample.
        if agent.parameters is not self._applied and self.law.is_good(sample.theta_m, sample.position):
            self._apply(agent.parameters, reference, sample)
        voltage = self.law.tick(reference, sample.theta_m, sample.position)
        # Before anything is recorded or sent: the voltage must not wait for that.
        self._drive.write(voltage)
        if not isfinite(sample.reference + sample.theta_m + sample.position):
            edge.counts["bad samples"] += 1
        edge.send(agent.absorb(reference, sample.theta_m, sample.position, voltage))

    def _jumped(self, number: int) -> None:
        """Continue after missing samples, during which the voltage was held, or where the count began anew."""
        if self._edge.due is None:
            return
        same = self._drive.machine == self._machine
        self._machine, self._drive_lost = self._drive.machine, False
        if not same or number != self._edge.due:
            missing = number - self._edge.due if same else -1
            self._edge.skip(missing, self._reference + self._edge.agent.offset, self.law.voltage)

    def _apply(self, parameters: Parameters, reference: float, sample: DriveSample) -> None:
        """Change the law to these parameters, unless it has them already, as after a new boot."""
        self._applied, law = parameters, self._law(parameters)
        if law != self.law.law:
            self.law.change(law, reference, sample.theta_m, sample.position)

    def _law(self, parameters: Parameters) -> RunningLaw:
        return self._edge.config.law(self._edge.agent.controller, parameters.setting.tolerance)
