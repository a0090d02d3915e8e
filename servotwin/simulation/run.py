"""Result of a simulation: channels at the samples, evaluated on demand, and the table of events."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.plant.plants import Plant
from servotwin.runtime.notebook import html_table
from servotwin.simulation.inputs import RunInputs
from servotwin.simulation.readings import Readings, motor_readings
from servotwin.simulation.views import Panel, arrow_table, pandas_table, stacked_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVENT_TYPE = np.dtype([("time", float), ("kind", "U10"), ("side", np.int8), ("state_triggered", bool)])


@dataclass(repr=False)
class Run:
    """A simulated run, N samples from time 0; arrays are ``(N,)`` unless stated otherwise, right-continuous at jumps.

    Channels are evaluated at first access and cached.
    """

    servo: Plant
    inputs: RunInputs
    samples: int
    channel: Callable[[str, int, int], Array] = field(repr=False)
    list_events: Callable[[], list[tuple[float, str, int, bool]]] = field(repr=False)
    readings: Readings | None = field(default=None, repr=False)
    _cache: dict[str, Array] = field(default_factory=dict, repr=False)

    def _get(self, name: str, make: Callable[[], Array]) -> Array:
        if name not in self._cache:
            self._cache[name] = make()
        return self._cache[name]

    @property
    def sample_rate(self) -> float:
        """Hz."""
        return self.inputs.sample_rate

    @property
    def time(self) -> Array:
        """Sample times, s."""
        return self._get("time", lambda: self.inputs.times(0, self.samples))

    @property
    def q(self) -> Array:
        """Positions of the masses, m, ``(N, n)``."""
        return self._get("q", lambda: np.column_stack([self._column(f"q{i + 1}") for i in range(self.servo.n)]))

    @property
    def position(self) -> Array:
        """Position of the last mass, m."""
        return self._column("position")

    @property
    def q3(self) -> Array:
        """Position of the last mass, the paper's name for it, m."""
        return self.position

    @property
    def theta_m(self) -> Array:
        """Motor angle, rad."""
        return self._column("theta_m")

    @property
    def theta_d(self) -> Array:
        """Screw angle behind the gap, rad."""
        return self._column("theta_d")

    @property
    def voltage(self) -> Array:
        """Voltage of the controller, V, or another actuator's command; an input bias comes on top of it."""
        return self._column("voltage")

    @property
    def reference(self) -> Array:
        """Reference of the position, m."""
        return self._get("reference", lambda: self.inputs.reference.on(self.time))

    @property
    def gap(self) -> Array:
        """Total gap, rad."""
        return self._get("gap", lambda: self.inputs.gap.on(self.time))

    @property
    def tolerance(self) -> Array:
        """Half-width of the dead zone, m; zero without one."""
        pieces = self.inputs.tolerance
        return self._get("tolerance", lambda: np.zeros(self.samples) if pieces is None else pieces.on(self.time))

    @property
    def measured_position(self) -> Array:
        """Output of the position sensor, noise and quantisation included, m; also between two ticks."""
        return self._column("measured_position")

    @property
    def measured_theta_m(self) -> Array:
        """Output of the motor's encoder, rad; NaN where it has none."""

        def channel(name: str, first: int, last: int) -> Array:
            return self.theta_m[first:last] if name == "theta_m" else self.channel(name, first, last)

        return self._get(
            "measured theta_m", lambda: motor_readings(self.servo, self.readings, channel, 0, self.samples)
        )

    @property
    def events(self) -> np.recarray[tuple[int], np.dtype[np.void]]:
        """Table of (time s, kind, side, state_triggered), in time order.

        Kinds: contact and release of the backlash (with an elastic screw also hold: the motor stops at the flank),
        stick and slip of the motor under friction (side: its direction; a reversal without a stop is both at once),
        stribeck (something slides faster than its Stribeck speed, side 0: slower again), limit (of the drive, side 0:
        ends), enter and leave of the dead zone, saturate (side 0: ends; continuous law only), reference and parameter
        (jumps of the inputs). `state_triggered` is false for those two and for what they flip at once.
        """
        end = (self.samples - 1) / self.sample_rate
        jumps = [(time, kind, 0, False) for time, kind in self.inputs.jumps(end)]
        rows = sorted(jumps + self.list_events(), key=lambda event: event[0])
        return np.array(rows, dtype=EVENT_TYPE).view(np.recarray)

    def measured(self, name: str) -> Array:
        """A channel as its sensor measures it: theta_m, position, voltage or reference."""
        return np.asarray(getattr(self, name if name in ("voltage", "reference") else f"measured_{name}"))

    def __repr__(self) -> str:
        """Length, rate, model and kind of loop in one line."""
        duration = (self.samples - 1) / self.sample_rate
        return f"<Run {duration:g} s, {self.samples} samples at {self.sample_rate:g} Hz, model {self.servo.version}>"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        unit = position_unit(self.servo)
        return html_table(
            "Run",
            {
                "duration": f"{(self.samples - 1) / self.sample_rate:g} s",
                "samples": f"{self.samples} at {self.sample_rate:g} Hz",
                "servo": repr(self.servo),
                "gap": f"{np.degrees(self.gap[0]):.3f} to {np.degrees(self.gap[-1]):.3f} deg",
                "largest error": f"{unit.factor * np.abs(self.reference - self.position).max():.4f} {unit.name}",
                "events": str(len(self.events)),
            },
        )

    @property
    def columns(self) -> dict[str, Array]:
        """Signals by name with their unit, as log files name them; each ``(N,)``.

        Positions of a rotary axis end with ``_rad``, and the command with its actuator's unit. The motor's angle is
        absent where it has no encoder: who reads the log would take it for a reading.
        """
        position, command = position_unit(self.servo).si, command_unit(self.servo).lower()
        command = f"command_{command.replace(' ', '_').replace('/', '_per_')}"
        motor = {"theta_m_rad": self.theta_m, "measured_theta_m_rad": self.measured_theta_m}
        return {
            "time_s": self.time,
            f"position_{position}": self.position,
            f"measured_position_{position}": self.measured_position,
            f"reference_{position}": self.reference,
            **(motor if self.servo.sensors.motor_encoder else {}),
            "theta_d_rad": self.theta_d,
            "voltage_v" if command == "command_v" else command: self.voltage,
            "gap_rad": self.gap,
            f"tolerance_{position}": self.tolerance,
            **{f"q{i + 1}_{position}": np.ascontiguousarray(self.q[:, i]) for i in range(self.servo.n)},
        }

    def plot(self) -> Figure:
        """Figure of position, tracking error, gap and voltage over time.

        Raises
        ------
        InvalidInput
            matplotlib is not installed.
        """
        name, factor, _ = position_unit(self.servo)
        drive = "voltage" if command_unit(self.servo) == "V" else "command"
        errors = {"error": factor * (self.reference - self.position)}
        if self.tolerance.any():
            errors |= {"dead zone": factor * self.tolerance, "_": -factor * self.tolerance}
        panels = (
            Panel(f"position, {name}", {"reference": factor * self.reference, "position": factor * self.position}),
            Panel(f"error, {name}", errors),
            Panel("gap at the motor, deg", {"gap": np.degrees(self.gap)}),
            Panel(f"{drive}, {command_unit(self.servo)}", {drive: self.voltage}),
        )
        return stacked_figure(repr(self).strip("<>"), self.time, panels)

    def to_pandas(self) -> Any:
        """``pandas.DataFrame`` of `columns`, one row per sample.

        Raises
        ------
        InvalidInput
            pandas is not installed.
        """
        return pandas_table(self.columns)

    def to_arrow(self) -> Any:
        """``pyarrow.Table`` of `columns`, one row per sample.

        Raises
        ------
        InvalidInput
            pyarrow is not installed.
        """
        return arrow_table(self.columns)

    def _column(self, name: str) -> Array:
        return self._get(name, lambda: self.channel(name, 0, self.samples))
