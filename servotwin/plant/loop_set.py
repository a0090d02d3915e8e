"""Margins of one law on many plants at once, without a gap: continuous, or sampled at the law's own rate with a delay.

A sampled plant is the exact zero-order hold, and the law is the edge's own tick. Both kinds are evaluated in the same
way: the points on the stability boundary are s = j omega, or the delta operator's (exp(j omega T) - 1) / T, in which a
fast rate loses no digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController, filtered_pid
from servotwin.control.retuning import integrates
from servotwin.hybrid.exponential import expm1
from servotwin.plant.frequency_curves import distances, encirclements, least_values, squares
from servotwin.plant.late_readings import late_readings
from servotwin.plant.linear import Complex, LinearSystem
from servotwin.plant.loop import StateMatrices, continuous_law, sampled_law
from servotwin.plant.margins import Margins, margins_of_response
from servotwin.plant.schur_response import SchurForms, response_at, schur_forms
from servotwin.plant.signals import Array

_PER_DECADE = 60
# Beyond the outermost corner of a plant a loop is its asymptote; it crosses over within this factor of the corners.
_BEYOND = 1e2
# Frequencies about each pole, in its half widths.
_ABOUT = np.array([-8.0, -4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0, 8.0])
_NARROWEST = 1e-6
# Poles below this part of the fastest one's size are integrators.
_ZERO = 1e-9
# Logarithm, per sample, of a decay that is taken for one at once.
_AT_ONCE = 700.0


class SetMargins(NamedTuple):
    """Margins of one law on each of P plants, (P,) arrays.

    Attributes
    ----------
    stable : array of bool
        Stability of the closed loop; the other margins mean nothing without it.
    Ms : array
        Largest abs(1 / (1 + L)); inf where the loop is not stable.
    gain_margin : array
        Least factor, up or down, on the loop gain that reaches the stability boundary; inf: none does.
    phase_margin, delay_margin : array
        rad, either way, and s of additional delay at the worst crossover; pi and inf where there is none.
    decay : array
        1/s, rate at which the slowest closed-loop mode decays; negative: it grows.
    passivity : array
        Least 1 + Re L(j omega); beside more than one integrator it has no end.
    """

    stable: NDArray[np.bool_]
    Ms: Array
    gain_margin: Array
    phase_margin: Array
    delay_margin: Array
    decay: Array
    passivity: Array


@dataclass(frozen=True, eq=False)
class PlantSet:
    """Linear plants of one structure, as a law with this rate meets them.

    Attributes
    ----------
    A, B, C : (P, n, n), (P, n), (P, n) arrays
        In continuous time, or of the delta operator at `rate`.
    rate : float or None
        Hz; None: continuous.
    """

    A: Array
    B: Array
    C: Array
    rate: float | None

    @staticmethod
    def of(plants: Sequence[LinearSystem], rate: float | None, late: int = 0) -> PlantSet:
        """Discretise plants, by zero-order hold where there is a rate; their sensor is so many samples late."""
        A, B, C = (np.array([getattr(plant, name) for plant in plants]) for name in ("A", "B", "C"))
        if rate is not None:
            flows = np.zeros((len(A), B.shape[1] + 1, B.shape[1] + 1))
            flows[:, :-1, :-1], flows[:, :-1, -1] = A, B
            discrete = rate * np.array([expm1(flow, 1.0 / rate) for flow in flows])
            A, B = discrete[:, :-1, :-1], discrete[:, :-1, -1]
            A, B, (C,) = late_readings(A, B, [C], [late], rate)
        return PlantSet(A, B, C, rate)

    @property
    def count(self) -> int:
        """Number of plants."""
        return len(self.A)

    @property
    def omega(self) -> Array:
        """(P, F) rad/s, ascending: frequencies that resolve the poles of each plant."""
        return self._grid.omega

    @cached_property
    def _grid(self) -> FrequencyGrid:
        poles = self.frequencies(eigenvalues(self.A))
        sizes = np.abs(poles)
        # The integrator's pole is zero only to within rounding.
        real = sizes > _ZERO * sizes.max(axis=1, keepdims=True)
        low, high = float(sizes[real].min()) / _BEYOND, float(sizes[real].max()) * _BEYOND
        high = high if self.rate is None else math.pi * self.rate
        low = min(low, 1e-3 * high)
        common = np.geomspace(low, high, int(_PER_DECADE * math.log10(high / low)) + 2)
        about = np.clip(about_poles(poles), low, high)
        both = np.concatenate([np.broadcast_to(common, (len(poles), common.size)), about], axis=1)
        order = np.argsort(both, axis=1, kind="stable")
        omega = np.take_along_axis(both, order, axis=1)
        return FrequencyGrid(omega, order, self.points(common), self.points(about), np.sum(~real, axis=1))

    @cached_property
    def response(self) -> Complex:
        """(P, F) response at `omega`."""
        grid = self._grid
        common = np.broadcast_to(grid.common, (len(self.A), grid.common.size))
        return response_at(self._schur, 0.0, grid.sorted(common, grid.about))

    def at(self, omega: Array) -> Complex:
        """(P, K) response at (P, K) frequencies, rad/s."""
        return response_at(self._schur, 0.0, self.points(omega))

    @cached_property
    def _schur(self) -> SchurForms:
        return schur_forms(self.A, self.B, self.C)

    def points(self, omega: Array) -> Complex:
        """Points of the stability boundary for frequencies in rad/s."""
        if self.rate is None:
            return np.asarray(1j * omega, dtype=np.complex128)
        return np.asarray(self.rate * np.expm1(1j * np.asarray(omega) / self.rate), dtype=np.complex128)

    def loop(self, law: AnyController, delay: int, omega: Array) -> Complex:
        """(P, K) response of the open loop at (P, K) frequencies, rad/s."""
        return np.asarray(self.at(omega) * self._law_response(law, delay, omega))

    @cached_property
    def _law(self) -> Callable[[AnyController], LawForms]:
        return lru_cache(maxsize=8)(self._forms_of)

    def _forms_of(self, law: AnyController) -> LawForms:
        law = filtered_pid(law)
        A, B, C, D = continuous_law(law) if self.rate is None else sampled_law(law)
        if self.rate is not None:
            A, B = self.rate * (A - np.eye(len(A))), self.rate * B
        forms = SchurForms(*(each[None].astype(np.complex128) for each in (A, B, C)))
        if not np.array_equal(A, np.triu(A)):
            forms = schur_forms(A[None], B[None], C[None])
        return LawForms(StateMatrices(A, B, C, D), forms)

    @cached_property
    def _stored(self) -> dict[tuple[str, AnyController | None, int], NDArray[Any]]:
        """Results that are asked for more than once."""
        return {}

    def _once(self, name: str, law: AnyController | None, delay: int, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        key = name, law, delay
        if key not in self._stored:
            self._stored[key] = make()
        return self._stored[key]

    def _returned(self, law: AnyController, delay: int) -> Complex:
        """(P, F) return difference 1 + L at `omega`."""
        loop = self.response * self._law_on_grid(law)
        if delay:
            loop *= self._once("late", None, delay, lambda: self.late(delay, self.omega))
        loop += 1.0
        return np.asarray(loop)

    @cached_property
    def _law_on_grid(self) -> Callable[[AnyController], Complex]:
        # One law is asked for with several delays, and never again.
        return lru_cache(maxsize=1)(self._at_grid)

    def _at_grid(self, law: AnyController) -> Complex:
        grid, (matrices, forms) = self._grid, self._law(law)
        # The frequencies that all plants share are most of them.
        common = response_at(forms, matrices.D, grid.common[None])
        about = response_at(forms, matrices.D, grid.about.reshape(1, -1)).reshape(grid.about.shape)
        return grid.sorted(np.broadcast_to(common, (len(self.A), common.shape[1])), about)

    def peaks(self, law: AnyController, delay: int = 0) -> Array:
        """(P,) sensitivity peaks on the stored frequencies: at most what `margins` finds, and much cheaper."""
        return self._once("peak", law, delay, lambda: 1.0 / np.sqrt(squares(self._returned(law, delay)).min(axis=1)))

    def stable(self, law: AnyController, delay: int = 0) -> NDArray[np.bool_]:
        """(P,) stability of the closed loop, from the turns of 1 + L about zero (Nyquist); by its poles where a plant's
        frequencies do not resolve them."""
        return self._once("stable", law, delay, lambda: self._stable(law, delay))

    def _stable(self, law: AnyController, delay: int) -> NDArray[np.bool_]:
        integrators = self._grid.integrators + integrates(law)
        circled, resolved = encirclements(self._returned(law, delay), integrators)
        stable = circled == 0
        if not resolved.all():
            few = PlantSet(self.A[~resolved], self.B[~resolved], self.C[~resolved], self.rate)
            stable[~resolved] = few.decays(law, delay) > 0.0
        return np.asarray(stable)

    def decays(self, law: AnyController, delay: int = 0) -> Array:
        """(P,) 1/s, rate at which the slowest closed-loop mode decays; negative: it grows."""
        return self._once("decay", law, delay, lambda: self._decays(law, delay))

    def _decays(self, law: AnyController, delay: int) -> Array:
        return np.asarray(-self.frequencies(eigenvalues(self._closed(law, delay))).real.max(axis=1))

    def margins(self, law: AnyController, delay: int = 0) -> SetMargins:
        """Margins of the loop with a law.

        Parameters
        ----------
        law : Controller
            With the sample rate of this set.
        delay : int
            Whole samples between a measurement and its voltage; 0 for a continuous law.
        """
        poles = eigenvalues(self._closed(law, delay))
        growth = self.frequencies(poles).real.max(axis=1)
        extra = with_closed_loop(self.omega, self.frequencies(poles))
        omega = np.concatenate([self.omega, extra], axis=1)
        order = np.argsort(omega, axis=1, kind="stable")
        omega = np.take_along_axis(omega, order, axis=1)
        plant = np.take_along_axis(np.concatenate([self.response, self.at(extra)], axis=1), order, axis=1)
        loop = plant * self._law_response(law, delay, omega)

        def value(omega: Array) -> Complex:
            return self.loop(law, delay, omega)

        return margins_of_responses(omega, loop, value, growth)

    def frequencies(self, poles: Complex) -> Complex:
        """Poles in 1/s."""
        if self.rate is None:
            return np.asarray(poles)
        with np.errstate(divide="ignore"):
            logarithm = np.log1p(poles / self.rate)
        # A pole z = 0 decays at once; the clip keeps its infinity out of the arithmetic.
        return np.asarray(self.rate * (np.maximum(logarithm.real, -_AT_ONCE) + 1j * logarithm.imag))

    def _law_response(self, law: AnyController, delay: int, omega: Array) -> Complex:
        """Response of law and delay from measurement to minus the voltage."""
        matrices, forms = self._law(law)
        value = response_at(forms, matrices.D, self.points(omega).reshape(1, -1)).reshape(omega.shape)
        return value if delay == 0 else np.asarray(value * self.late(delay, omega))

    def late(self, delay: int, omega: Array) -> Complex:
        """Response of a delay of so many samples."""
        assert self.rate is not None
        return np.asarray(np.exp(-1j * delay * omega / self.rate))

    def _closed(self, law: AnyController, delay: int) -> Array:
        """(P, N, N) closed loop of plant, law and delayed voltages; the delta operator's where there is a rate."""
        A, B, C, D = self._law(law).matrices
        return self.closed_by(A, B[:, None] * self.C[:, None, :], -D * self.C, -C, delay)

    def closed_by(self, A: Array, inputs: Array, direct: Array, C: Array, delay: int) -> Array:
        """(P, N, N) loop closed by a law of k states.

        Its states advance by A and `inputs` (P, k, n) times the plant's states; the command is `direct` (P, n) times
        the plant's states and C times its own.
        """
        n, k = self.B.shape[1], len(A)
        closed = np.zeros((len(self.A), n + k + delay, n + k + delay))
        closed[:, :n, :n] = self.A
        closed[:, n : n + k, n : n + k] = A
        closed[:, n : n + k, :n] = inputs
        output = np.zeros((len(self.A), n + k + delay))
        output[:, :n], output[:, n : n + k] = direct, C
        if delay == 0:
            closed[:, :n] += self.B[:, :, None] * output[:, None, :]
            return closed
        assert self.rate is not None
        closed[:, :n, -1] += self.B
        # Shifts z x = y become (y - x) rate.
        line = np.arange(n + k, n + k + delay)
        closed[:, line, line] = -self.rate
        closed[:, line[1:], line[:-1]] = self.rate
        closed[:, line[0]] += self.rate * output
        return closed


def margins_of_responses(omega: Array, loop: Complex, value: Callable[[Array], Complex], growth: Array) -> SetMargins:
    """Margins of loops from their (P, F) responses at (P, F) frequencies, and of their slowest modes' growth, 1/s.

    `value` gives the responses at other (P, K) frequencies.
    """
    stable = growth < 0.0
    gain, phase, late = distances(omega, loop, value)
    closest = least_values(omega, np.abs(1.0 + loop), lambda w: np.abs(1.0 + value(w)))
    peak = np.where(stable, 1.0 / closest, np.inf)
    passivity = 1.0 + least_values(omega, loop.real, lambda w: value(w).real)
    return SetMargins(stable, peak, gain, phase, late, -growth, passivity)


def sampled_margins(plant: LinearSystem, law: Controller, late: int = 0) -> Margins:
    """Margins of a law on one plant at the law's own rate (Hz), whose sensor is so many samples late."""
    plants = PlantSet.of([plant], law.sample_rate, late)
    poles = plants.frequencies(eigenvalues(plants._closed(law, 0)))
    return margins_of_response(
        lambda omega: plants.loop(law, 0, np.atleast_1d(omega)[None])[0],
        np.unique(np.concatenate([plants.omega, with_closed_loop(plants.omega, poles)], axis=1)),
        stable=bool(plants.margins(law).stable[0]),
    )


class FrequencyGrid(NamedTuple):
    """Frequencies at which the plants of a set are stored.

    Attributes
    ----------
    omega : (P, F) array
        rad/s, ascending.
    order : (P, F) array of int
        Places of them among those that all plants share, followed by those about the poles of each.
    common, about : (F - K,), (P, K) arrays
        Points of the stability boundary at these.
    integrators : (P,) array of int
        Number of poles of each plant at zero.
    """

    omega: Array
    order: NDArray[np.int64]
    common: Complex
    about: Complex
    integrators: NDArray[np.int64]

    def sorted(self, common: Complex, about: Complex) -> Complex:
        """(P, F) values in the order of `omega`, from those at the shared (P, F - K) and the other (P, K) points."""
        return np.take_along_axis(np.concatenate([common, about], axis=1), self.order, axis=1)


class LawForms(NamedTuple):
    """A law in continuous time, or the delta operator's, and its triangular form."""

    matrices: StateMatrices
    forms: SchurForms


def eigenvalues(matrices: Array) -> Complex:
    """(P, N) eigenvalues of (P, N, N) matrices."""
    return np.asarray(np.linalg.eigvals(matrices), dtype=np.complex128)


def about_poles(poles: Complex) -> Array:
    """(P, K) rad/s: frequencies about poles (1/s)."""
    poles = np.where(np.isfinite(poles), poles, 0.0)
    width = np.maximum(np.abs(poles.real), _NARROWEST * np.abs(poles))
    near = np.abs(poles.imag)[..., None] + width[..., None] * _ABOUT
    return np.asarray(np.abs(near).reshape(len(poles), -1))


def with_closed_loop(omega: Array, poles: Complex) -> Array:
    """(P, K) rad/s, beside (P, F) frequencies of plants: about the poles of their closed loops (1/s), whose resonances
    are others, and from below the slowest of these, where a slow law crosses over."""
    sizes, first = np.abs(poles), float(omega[:, 0].min())
    slowest = float(sizes[sizes > _ZERO * sizes.max(axis=1, keepdims=True)].min(initial=math.inf))
    low = min(slowest / _BEYOND, first)
    about = np.clip(about_poles(poles), low, omega[:, -1:])
    below = np.geomspace(low, first, int(_PER_DECADE * math.log10(first / low)) + 1)[:-1]
    return np.concatenate([about, np.broadcast_to(below, (len(poles), below.size))], axis=1)
