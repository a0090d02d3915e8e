"""Quick fits by which windows are glanced at, for each of the ways to estimate a gap. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from servotwin.estimation.axis_model import servo_for
from servotwin.estimation.motor_side import check_reaction
from servotwin.estimation.motor_side import quick as motor_side
from servotwin.estimation.output_error import quick as output_error
from servotwin.estimation.whitened import quick as whitened
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.whitened.quick import QuickFit
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo


class Known(NamedTuple):
    """Knowledge beside which a window is fitted.

    Attributes
    ----------
    gap : float
        rad, total, as estimated last.
    unknowns : tuple of float
        What the fit of the window that was estimated last had beside the gap; empty where the kind needs none, or no
        window was fitted.
    offset : (float, float), optional
        The encoder's offset from earlier windows, mean and standard deviation, rad.
    machine : FactorPrior, optional
        The machine's numbers over the model's, as learnt.
    """

    gap: float
    unknowns: tuple[float, ...] = ()
    offset: tuple[float, float] | None = None
    machine: FactorPrior | None = None


class QuickFits(Protocol):
    """Quick fits of one servo's windows; both raise InvalidInput where the estimator would."""

    def beside(self, window: Window, known: Known) -> QuickFit | None:
        """Fit a window; None: no window was fitted before that it could be compared with."""

    def unknowns_at(self, window: Window, known: Known) -> tuple[float, ...]:
        """Unknowns of a window that was estimated, for the next ones."""


@dataclass(frozen=True)
class ServoFits:
    """Plain fits of a servo's windows."""

    model: Servo

    def beside(self, window: Window, known: Known) -> QuickFit:
        """Fit gap and place of the screw."""
        return whitened.quick_fit(window, self.model, known.gap, known.offset, known.machine)

    def unknowns_at(self, _window: Window, _known: Known) -> tuple[float, ...]:
        """None: the gap is all that windows have in common."""
        return ()


@dataclass(frozen=True)
class AxisFits:
    """Output-error fits of the windows of the axes whose gap `output_error` estimates."""

    axis: Axis

    def beside(self, window: Window, known: Known) -> QuickFit | None:
        """Fit gap and offset beside what the window that was estimated last had."""
        if not known.unknowns:
            return None
        return output_error.quick_fit(window, self.axis, np.array(known.unknowns), known.machine)

    def unknowns_at(self, window: Window, known: Known) -> tuple[float, ...]:
        """Unknowns of the whole model, at the gap."""
        return tuple(output_error.unknowns_at(window, self.axis, known.gap, known.machine).tolist())


@dataclass(frozen=True)
class MotorFits:
    """Output-error fits of windows without the load's position."""

    axis: Axis

    def beside(self, window: Window, known: Known) -> QuickFit | None:
        """Fit the gap beside what the window that was estimated last had."""
        return motor_side.quick_fit(window, self.axis, np.array(known.unknowns)) if known.unknowns else None

    def unknowns_at(self, window: Window, known: Known) -> tuple[float, ...]:
        """Unknowns of the whole model, at the gap."""
        return tuple(motor_side.unknowns_at(window, self.axis, known.gap).tolist())


def quick_fits_of(servo: Plant) -> QuickFits:
    """Make the quick fits of a servo's windows.

    Raises
    ------
    InvalidInput
        Without an encoder at the load no window shows the gap, or the load has friction that its estimator knows not.
    """
    if servo.at_motor:
        check_reaction(servo)
        assert isinstance(servo, Axis)
        return MotorFits(servo)
    model = servo_for(servo)
    if model is not None:
        return ServoFits(model)
    assert isinstance(servo, Axis)
    return AxisFits(servo)
