"""Limit cycles of the loop with backlash, exact, with or without a dead zone: shooting on the hybrid automaton.

Three measures keep Newton's method well-conditioned. Lengths are divided by the gap, since the loop is homogeneous: so
the amplitude is exactly proportional to the gap. Neutral directions are removed: states that no flow changes stay
fixed, and a constant reference is shifted away where the loop allows it. And a symmetric orbit is closed after half a
period by its mirror image. The orbit is then verified: the event simulation runs it for a period on half its search
step, and only an orbit that closes there is returned.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np

from servotwin.analysis.limit_cycles.orbit import ClosedOrbit, Orbit, closed_orbit
from servotwin.analysis.limit_cycles.poincare import GuardId, LostOrbit, Section, guard_events
from servotwin.analysis.limit_cycles.scaled import LOOKS, ScaledLoop, scaled_loop
from servotwin.control.laws import AnyController, Law, filtered_pid, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.control.retuning import check_zone_acts
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.trajectory import Trajectory, ZenoError
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant

# The first part of the run is 32 characteristic times of the loop long, each of the others twice as long as the one
# before: with little integral action a cycle is that slow.
_FIRST_PART, _PARTS = 32, 8
# Motion below this part of the gap (or of the tolerance) is rest; above this part it runs away.
_REST, _AWAY = 1e-9, 1e9
# Of the largest command: a motor at rest whose command moves by more is held by friction, until the command breaks it
# loose.
_WINDS = 1e-6
# Share of the gap (or of the dead zone, or of the step) within which motor and position count as settled.
_SETTLED = 0.01
# Without integral action the motor crosses the gap ever more slowly, and never rests. It counts as settling when the
# position moves by less than this part of p gap in the later half of all parts, and by less than a quarter of before.
_CREEP = 1e-3
# Distance, in parts of each state's size, within which the run is taken to converge to a stable orbit: at once, or
# where it was twice as far away before, since another motion may pass by. And within which it is on an orbit that does
# not attract.
_CLOSE, _NEAR, _ON_IT = 1e-3, 0.1, 1e-6


class CycleStatus(Enum):
    """End of a search."""

    CYCLE = "limit cycle"
    SETTLES = "settles"
    DIVERGES = "diverges"
    IRREGULAR = "does not repeat"
    CHATTERS = "chatters"


@dataclass(frozen=True, repr=False)
class CycleResult:
    """Result of a search.

    Attributes
    ----------
    status : CycleStatus
    orbit : Orbit or None
        Only with `CycleStatus.CYCLE`.
    reason : str
        Reason why there is no orbit; empty otherwise.
    settling : float, optional
        s, where the run came to rest: from then on motor and position stay within 1 % of the gap (without one of the
        dead zone, or of the step) of their ends.
    """

    status: CycleStatus
    orbit: Orbit | None
    reason: str
    settling: float | None = None

    def __repr__(self) -> str:
        """Status, and the orbit or the reason, in one line."""
        if self.orbit is None:
            return f"<CycleResult {self.status.value}: {self.reason}>"
        swing = self.orbit.highest - self.orbit.lowest
        stable = "stable" if self.orbit.stable else "not stable"
        return (
            f"<CycleResult {self.status.value}: {self.orbit.frequency:.4g} Hz, {swing:.4g} from peak to peak, {stable}>"
        )


def limit_cycle(
    servo: Plant,
    gap: float,
    tolerance: float | None = None,
    controller: AnyController | None = None,
    step: float = 1e-3,
) -> CycleResult:
    """Find the limit cycle on which the loop ends after a reference step from rest.

    Parameters
    ----------
    servo : Servo or Axis
    gap : float
        rad, total gap, constant.
    tolerance : float, optional
        m, half-width of the dead zone; None or 0: no dead zone.
    controller : Controller, Cascade or LinearLaw, optional
        Continuous; the servo's own by default.
    step : float
        m, size of the step; the reference is constant after it. With a dead zone the loop has several ends, and
        which one is reached depends on it.

    Returns
    -------
    CycleResult

    Raises
    ------
    InvalidInput
        The controller is sampled or has a rate limit, or a number is outside its range.
    """
    if not (math.isfinite(step) and step != 0.0):
        raise InvalidInput(f"step = {step!r} m: must be finite and not 0, or the loop never leaves its rest")
    loop = scaled_loop(servo, gap, tolerance, controller, step)
    own = servo.controller if controller is None else controller
    law = law_of(own)
    if tolerance:
        check_zone_acts(own, "tolerance: the dead zone")
    limit = law.voltage_limit
    if gap == 0.0 and not tolerance and limit is None and servo.command_limit is None:
        return _linear(servo, law)
    try:
        return _searched(loop, "gap" if gap else "dead zone" if tolerance else "step")
    except ZenoError as error:
        return CycleResult(CycleStatus.CHATTERS, None, str(error))


def _linear(servo: Plant, law: Law) -> CycleResult:
    """Result without gap, dead zone and limit: the poles decide, nothing is simulated."""
    axis = isinstance(servo, Axis) and isinstance(law, LinearLaw)
    closed = servo.closed_loop(law) if axis else servo.closed_loop(filtered_pid(law))  # type: ignore[arg-type]
    if closed.is_stable():
        return CycleResult(CycleStatus.SETTLES, None, "without gap, dead zone and limit the loop is linear and stable")
    return CycleResult(CycleStatus.DIVERGES, None, "without gap, dead zone and limit the loop is linear and not stable")


def _searched(loop: ScaledLoop, extent: str) -> CycleResult:
    """Search the run's end; `extent` is what `loop.extent` is the size of, in a word."""
    reason, elapsed, moved, travels, largest, held, before = "", 0.0, [], [], 0.0, False, 0.0
    for run, travel in _parts(loop):
        elapsed += run.time
        if travel is None:
            reason = f"the motion grows beyond any bound within {elapsed:.4g} s"
            return CycleResult(CycleStatus.DIVERGES, None, reason)
        travels.append(travel)
        moved.append(float(np.ptp(travel[0])))
        command = run.sampled(loop.loop.rows["voltage"])
        largest = max(largest, float(np.max(np.abs(command))))
        rests = _late(travel) <= _REST * loop.extent
        held = rests and _late(command[None]) > _WINDS * largest
        if rests and not held:
            time = _settling(loop, travels)
            reason = f"motor and position stay within 1 % of the {extent} from {time:.3g} s on"
            return CycleResult(CycleStatus.SETTLES, None, reason, time)
        try:
            closed = _followed(loop, run)
        except LostOrbit as error:
            reason, before = str(error), 0.0
            continue
        near = max(_CLOSE, min(0.5 * before, _NEAR)) if closed.orbit.stable else _ON_IT
        if closed.distance < near:
            return CycleResult(CycleStatus.CYCLE, closed.orbit, "")
        before = closed.distance if closed.orbit.stable else 0.0
        kind = "a stable" if closed.orbit.stable else "an unstable"
        reason = f"{kind} orbit at {closed.orbit.frequency:.6g} Hz is {closed.distance:.2g} of its size away"
    if held:
        reason = (
            f"friction holds motor and load after {elapsed:.4g} s, until the command, which still grows, frees them"
        )
        return CycleResult(CycleStatus.IRREGULAR, None, reason)
    late = max(moved[_PARTS // 2 :])
    if late < _CREEP * loop.extent and late < 0.25 * max(moved[1 : _PARTS // 2]):
        reason = f"the motor still creeps across the gap, but the position moves by {late * loop.unit:.2g} m at last"
        return CycleResult(CycleStatus.SETTLES, None, reason)
    return CycleResult(CycleStatus.IRREGULAR, None, f"no orbit is reached within {elapsed:.4g} s: {reason}")


def _parts(loop: ScaledLoop) -> Iterator[tuple[Trajectory, Array | None]]:
    """Parts of one run, each twice as long as the one before, with half the travel of position and motor, (2, samples).

    The motor's is in the position's unit: the position rests while the motor crosses the gap. None: it runs away.
    """
    state, mode = loop.state, loop.mode
    rows = loop.loop.rows
    for number in range(_PARTS):
        run = Trajectory(loop.loop.automaton, state, mode, loop.sample_step)
        samples = _FIRST_PART * 2**number * LOOKS
        # Checked 32 times on the way, so that a diverging run stops before it overflows.
        for check in range(1, _FIRST_PART + 1):
            run.advance(samples // _FIRST_PART * check)
            if not float(np.max(np.abs(run.state))) <= _AWAY * float(np.max(np.abs(loop.state))):
                yield run, None
                return
        yield run, 0.5 * np.array([run.sampled(rows["position"]), loop.extent * run.sampled(rows["theta_m"])])
        state, mode = run.state, run.mode


def _late(rows: Array) -> float:
    """Largest range of rows (k, samples) in their later half."""
    return float(np.ptp(rows[:, rows.shape[1] // 2 :], axis=1).max())


def _settling(loop: ScaledLoop, travels: list[Array]) -> float:
    """Time (s) of the first sample from which position and motor stay near where the last part ends."""
    # The first sample of each part is the last one of the part before.
    travel = np.concatenate([travels[0], *(each[:, 1:] for each in travels[1:])], axis=1)
    away = np.abs(travel - travel[:, -1:]).max(axis=0) > 0.5 * _SETTLED * loop.extent
    return float(loop.sample_step * (np.flatnonzero(away).max(initial=-1) + 1))


def _followed(loop: ScaledLoop, run: Trajectory) -> ClosedOrbit:
    """Find the orbit that the events at the end of a run suggest."""
    times, guards = guard_events(run)
    length = _repeating(guards)
    last, last_times = guards[-length - 1 :], times[-length - 1 :]
    # An event set off by another at the same instant has no guard of its own to section the flow with.
    own = [last[i] for i in range(1, length + 1) if last_times[i] > last_times[i - 1]]
    first = min(own, key=last[1:].count)
    horizon = 3.0 * (last_times[-1] - last_times[0]) + loop.time
    section = Section(loop.loop.automaton, first, first, last[1:].count(first), loop.sample_step, horizon)
    start = section.approach(run.state, run.mode)
    states = run.record.state[: run.record.size[0]]
    scale = np.max(np.abs(states[len(states) // 2 :]), axis=0)
    scale[scale == 0.0] = 1.0
    half = loop.mirror is not None and _mirrored(last[1:], loop.mirror.guards)
    try:
        closed = closed_orbit(loop, section, start, scale, half)
        if closed.orbit.stable or not half:
            return closed
    except LostOrbit:
        if not half:
            raise
    return closed_orbit(loop, section, start, scale, False)


def _repeating(guards: list[GuardId]) -> int:
    """Length of the shortest pattern that the last events repeat twice after its first time."""
    for length in range(1, len(guards) // 3 + 1):
        if guards[-length:] == guards[-2 * length : -length] == guards[-3 * length : -2 * length]:
            return length
    raise LostOrbit(f"the last {len(guards)} events do not repeat")


def _mirrored(pattern: list[GuardId], guards: dict[GuardId, GuardId]) -> bool:
    half, odd = divmod(len(pattern), 2)
    return not odd and [guards[guard_id] for guard_id in pattern[:half]] == pattern[half:]
