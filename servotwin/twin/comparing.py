"""Comparison of windows with what is stated beside the load: the controller, and the drive's torque. Pure."""

from __future__ import annotations

from msgspec.structs import replace

from servotwin.twin.estimating import OTHER_CONTROLLER, DecodedWindow
from servotwin.twin.model import TwinModel
from servotwin.twin.state import TwinState

_OTHER_DRIVE = 2  # windows in a row that raise an alarm
_CONTROLLER = "the voltage is not that of the stated controller: a setting follows when that of a window is"
_DRIVE = "the command does not move the axis as strongly as stated: a setting follows when it does in a window"


def compare(model: TwinModel, state: TwinState, decoded: DecodedWindow) -> tuple[TwinState, list[str]]:
    """Compare a window's voltage with that of the controller stated for it, and its motion with the voltage.

    The second not where the first differs: another channel is no command. Returned with the alarms.
    """
    made = decoded.compare_controller(model.controller, state.known.get(decoded.message.parameter_version))
    if made is None:
        return _compare_drive(model, state, decoded)
    before, count = state.other_controller, 0 if made.agrees else state.other_controller + 1
    count = max(count, OTHER_CONTROLLER) if made.misread else count  # one such window is enough
    state = replace(state, other_controller=count)
    if made.agrees:
        return _compare_drive(model, state, decoded)
    return state, [made.sentence] if count == OTHER_CONTROLLER > before else []


def _compare_drive(model: TwinModel, state: TwinState, decoded: DecodedWindow) -> tuple[TwinState, list[str]]:
    if model.drive is None or decoded.window is None or (made := model.drive.compared(decoded.window)) is None:
        return state, []
    count = 0 if made.agrees else state.other_drive + 1
    return replace(state, other_drive=count), [made.sentence] if count == _OTHER_DRIVE else []


def not_as_stated(state: TwinState) -> str:
    """Reason for which no setting follows; empty: controller and drive are as stated."""
    if state.other_controller >= OTHER_CONTROLLER:
        return _CONTROLLER
    return _DRIVE if state.other_drive >= _OTHER_DRIVE else ""
