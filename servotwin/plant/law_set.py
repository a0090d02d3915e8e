"""Margins of one law of two encoders on many axes at once, without a gap, cut at the command; as `loop_set`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotwin.control.laws import AnyController, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.plant.axis import Axis
from servotwin.plant.late_readings import late_readings
from servotwin.plant.law_loop import LawMatrices, law_matrices, ticked_law
from servotwin.plant.linear import Complex
from servotwin.plant.loop_set import (
    PlantSet,
    SetMargins,
    eigenvalues,
    margins_of_responses,
    with_closed_loop,
)
from servotwin.plant.schur_response import response_of
from servotwin.plant.signals import Array


@dataclass(frozen=True, eq=False)
class LawSet:
    """Axes of one structure, as a law with this rate meets them.

    Attributes
    ----------
    motor, load : PlantSet
        Command to the motor's angle and to the load's position, with the same states.
    """

    motor: PlantSet
    load: PlantSet

    @staticmethod
    def of(axes: Sequence[Axis], rate: float | None) -> LawSet:
        """Discretise axes, by zero-order hold where there is a rate, with their late encoders."""
        motors, loads = zip(*(axis.plants() for axis in axes), strict=True)
        motor, load = PlantSet.of(motors, rate), PlantSet.of(loads, rate)
        if rate is None:
            return LawSet(motor, load)
        delays = [encoder.late(rate) for encoder in (axes[0].sensors.motor, axes[0].sensors.load)]
        A, B, rows = late_readings(load.A, load.B, [motor.C, load.C], delays, rate)
        return LawSet(*(PlantSet(A, B, row, rate) for row in rows))

    @property
    def count(self) -> int:
        """Number of axes."""
        return self.load.count

    @property
    def omega(self) -> Array:
        """(P, F) rad/s, ascending: frequencies that resolve the poles of each axis."""
        return self.load.omega

    @cached_property
    def _stored(self) -> dict[tuple[Any, ...], Any]:
        """Results that are asked for more than once."""
        return {}

    def loop(self, controller: AnyController, delay: int, omega: Array) -> Complex:
        """(P, K) response of the open loop at (P, K) frequencies, rad/s: what comes back at minus the command."""
        return self._returned(controller, delay, omega, self.motor.at(omega), self.load.at(omega))

    def _returned(self, controller: AnyController, delay: int, omega: Array, motor: Complex, load: Complex) -> Complex:
        A, B, C, D = self._law(controller)
        points = self.load.points(omega).reshape(1, -1)
        total = np.zeros(omega.shape, dtype=complex)
        for column, plant in ((1, motor), (2, load)):
            total += plant * response_of(A, B[:, column], -C, -float(D[column]), points).reshape(omega.shape)
        return total if delay == 0 else np.asarray(total * self.load.late(delay, omega))

    def peaks(self, controller: AnyController, delay: int = 0) -> Array:
        """(P,) sensitivity peaks on the stored frequencies: at most what `margins` finds, and much cheaper."""
        key = "peak", controller, delay
        if key not in self._stored:
            loop = self._returned(controller, delay, self.omega, self.motor.response, self.load.response)
            self._stored[key] = 1.0 / np.abs(1.0 + loop).min(axis=1)
        return np.asarray(self._stored[key])

    def stable(self, controller: AnyController, delay: int = 0) -> NDArray[np.bool_]:
        """(P,) stability of the closed loop, from its poles."""
        return np.asarray(self.decays(controller, delay) > 0.0)

    def decays(self, controller: AnyController, delay: int = 0) -> Array:
        """(P,) 1/s, rate at which the slowest closed-loop mode decays; negative: it grows."""
        return np.asarray(-self._poles(controller, delay).real.max(axis=1))

    def margins(self, controller: AnyController, delay: int = 0) -> SetMargins:
        """Margins of the loop with a law, at the sample rate of this set, and with a delay in samples."""
        poles = self._poles(controller, delay)
        extra = with_closed_loop(self.omega, poles)
        omega = np.sort(np.concatenate([self.omega, extra], axis=1), axis=1, kind="stable")

        def value(omega: Array) -> Complex:
            return self.loop(controller, delay, omega)

        return margins_of_responses(omega, value(omega), value, poles.real.max(axis=1))

    def _poles(self, controller: AnyController, delay: int) -> Complex:
        """(P, N) closed-loop poles, 1/s."""
        key = "poles", controller, delay
        if key not in self._stored:
            self._stored[key] = self.load.frequencies(eigenvalues(self._closed(controller, delay)))
        return np.asarray(self._stored[key])

    def _law(self, controller: AnyController) -> LawMatrices:
        """Matrices of a law in continuous time, or the delta operator's."""
        law, rate = law_of(controller), self.load.rate
        assert isinstance(law, LinearLaw)
        if rate is None:
            return law_matrices(law)
        A, B, C, D = ticked_law(law)
        return LawMatrices(rate * (A - np.eye(len(A))), rate * B, C, D)

    def _closed(self, controller: AnyController, delay: int) -> Array:
        """(P, N, N) closed loop of plant, law and delayed commands; the delta operator's where there is a rate."""
        A, B, C, D = self._law(controller)
        plant, measured = self.load, np.stack([self.motor.C, self.load.C], axis=1)
        inputs, outputs = B[:, 1:] @ measured, np.einsum("s,psn->pn", D[1:], measured)
        return plant.closed_by(A, inputs, outputs, C, delay)
