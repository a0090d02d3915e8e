"""The gap of a recording, by all that is known of its machine: `gap_of_recording`."""

from __future__ import annotations

from collections.abc import Callable

from servotwin.estimation.driven_load.estimate import swings, with_dynamics
from servotwin.estimation.driven_load.flanks import with_forces
from servotwin.estimation.kinematic.lost_motion import LostMotion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.wind_up import TransmissionGap, gap_of_machine, gap_within
from servotwin.plant.plants import Plant


def gap_of_recording(
    recording: EncoderRecording,
    lost: LostMotion,
    machine: Plant | None = None,
    *,
    stiff: bool = False,
    dynamics: bool = False,
    tell: Callable[[str], object] = str,
) -> TransmissionGap:
    """Take the wind-up off a lost motion, or fit the load's dynamics where the motion alone does not do.

    Parameters
    ----------
    recording : EncoderRecording
    lost : LostMotion
        Of that recording, without dynamics.
    machine : Servo or Axis, optional
        Takes its wind-up off, and doubts a fit without dynamics that its load's forces contradict.
    stiff : bool
        Instead of a machine: nothing winds up.
    dynamics : bool
        Fit the load's dynamics also where it does not swing.
    tell : callable
        Called with what is being done, in words.

    Raises
    ------
    InvalidInput
        As `gap_of_machine`.
    """
    if machine is None:
        found = gap_within(lost, 0.0 if stiff else None)
    else:
        found = with_forces(recording, gap_of_machine(recording, lost, machine), machine)
    if dynamics or swings(found):
        tell("dynamics of the load")
        found = with_dynamics(recording, found, machine)
    return found
