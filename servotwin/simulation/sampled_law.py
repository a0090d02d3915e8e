"""The sampled loop of a linear law: two measurements, the edge's own tick compiled, on the exact plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_tick import LinearParameters, LinearState
from servotwin.hybrid.automaton import Array
from servotwin.simulation.inputs import quantised
from servotwin.simulation.law_ticks import TwoSensors, law_tick_and_record, run_law_ticks
from servotwin.simulation.sampled import SampledEngine
from servotwin.simulation.start import linear_start
from servotwin.simulation.ticks import Port, TickInputs


@dataclass
class SampledLawEngine(SampledEngine):
    """Engine of a `Simulation` whose controller is a linear law with a sample rate."""

    controller: LinearLaw  # type: ignore[assignment]

    def _started(self, command: float) -> tuple[LinearState, LinearParameters]:
        start = linear_start(self.controller, self._motor_reading(0), self._reading(self._encoder_error()), command)
        return start, _with_arrays(self.controller.parameters())

    @property
    def _applied(self) -> float:
        return float(self.law_state.command)

    @property
    def sensors(self) -> TwoSensors:
        """Port with the motor's encoder."""
        counted = 1 if self.servo.encoder_resolution > 0.0 else 0
        return TwoSensors(self.port, self.servo.encoder_resolution, counted, self.motor_late)

    def _make_port(self, searches: int) -> Port:
        late = self.servo.sensors.motor.late(self.tick_rate)
        self.motor_late = np.full(late, self._motor_reading(0))
        return super()._make_port(searches)

    def _motor_errors(self, first: int, count: int) -> Array:
        if self.readings is None:
            return np.zeros(1)
        return np.ravel(self.readings.motor.at(self.tick_every * np.arange(first, first + count)))

    def _motor_reading(self, tick: int) -> float:
        """Reading of the motor's encoder in the present state, at a tick."""
        angle = self.plant.rows["theta_m"][0] @ self.state + self._motor_errors(tick, 1)[0]
        return float(quantised(np.array(angle), self.servo.encoder_resolution))

    def _motor_shown(self) -> float:
        """Reading of the motor's encoder that the tick that is due gets."""
        tick, late = -(-self.base // self.tick_every), self.motor_late
        return float(late[tick % late.size]) if late.size else self._motor_reading(tick)

    def flow(self, end: int, tick_inputs: TickInputs) -> None:
        """Advance to a base step; `tick_inputs` covers the ticks on the way, while the gap's cubic stays the same."""
        while self.base < end:
            status, self.base, self.mode, self.law_state = run_law_ticks(
                self.tables,
                self.state,
                self.base,
                end,
                self.mode,
                self.parameters,
                self.law_state,
                self.sensors,
                tick_inputs,
                self.output,
                self.record,
                self.scratch,
            )
            self._check(status)

    def _tick_and_record(self, base: int) -> None:
        tick_inputs = self.tick_inputs(-(-base // self.tick_every), base // self.tick_every + 1)
        self.law_state = law_tick_and_record(
            base, self.state, self.parameters, self.law_state, self.sensors, tick_inputs, self.output
        )

    def set_controller(self, controller: LinearLaw, tolerance: float | None) -> None:  # type: ignore[override]
        """Change the law from the tick that is due on, without a jump of its command; a constant tolerance unless
        None."""
        time = -(-self.base // self.tick_every) / self.tick_rate
        planned = None if self.inputs.tolerance is None else float(self.inputs.tolerance.value(time))
        inputs = (float(self.inputs.reference.value(time)), self._motor_shown(), self._shown(self._noise_ahead()))
        tolerances = (planned, planned if tolerance is None else tolerance)
        self.law_state = controller.transfer(self.controller, self.law_state, inputs, tolerances)
        self.controller, self.parameters = controller, _with_arrays(controller.parameters())


def _with_arrays(parameters: LinearParameters) -> LinearParameters:
    """The same numbers as arrays, for compiled code: one version of it for laws of equally many states."""
    advance, output = (np.array(values) for values in (parameters.advance, parameters.output))
    return parameters._replace(advance=advance, output=output)  # type: ignore[arg-type]
