"""Settings that an edge starts with, derived from a servo's model and a policy."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

from servotwin.commissioning.guarding import Guarding, guarding, start_of
from servotwin.commissioning.move_time import move_time
from servotwin.config.keys import key, settings
from servotwin.control.gains import gains_of, with_gains
from servotwin.control.laws import AnyController
from servotwin.control.retuning import integrates
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import Parameters
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.errors import InvalidInput
from servotwin.estimation.axis_model import servo_for
from servotwin.estimation.gap import shortest_window
from servotwin.estimation.late_window import samples_late
from servotwin.estimation.output_error import too_slow
from servotwin.estimation.whitened.estimator import SHORTEST
from servotwin.messages import Setting
from servotwin.novelty.score import model_of
from servotwin.novelty.settings import NoveltyRules, NoveltySettings
from servotwin.plant.axis import Axis
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales
from servotwin.runtime.retry import Retry
from servotwin.twin.settings import TwinSettings

# Seconds here are the servo's own (`plant.scales`).
WINDOW = 1.0  # s, section 4.2
CALM_WINDOW, CALM_PRE_TRIGGER = 2.0, 0.3  # s
_LONGEST_REQUEST = 2.0  # windows of a slow loop, at least
_LONGEST_MOVE, _BEYOND_MOVE = 10.0, 1.5  # windows of the machine's own for which a step is followed; times its duration
_MOST_SAMPLES = 1e8  # some 10 GB of signals


@settings("recording")
@dataclass(frozen=True)
class Recording:
    """Settings of the windows that an edge records and sends.

    Parameters
    ----------
    probe : ProbeLimits, optional
        Probing moves of the reference that the twin may request; None: none. In a file, [edge.probe].
    novelty : NoveltyRules, optional
        Rules that select the windows to send; None: the edge sends every one. In a file, [novelty].
    """

    sample_rate: Annotated[
        float,
        key(
            "sample_rate_hz",
            above=0.0,
            help="Rate of the samples; where absent, in a scenario, that of a sampled controller.",
        ),
    ] = 5000.0
    window: Annotated[
        float | None,
        key(
            "window_s",
            above=0.0,
            help="Length of a window; where absent it follows from the controller, and is at least one and a half "
            "times what a step takes with the setting that the servo starts with.",
        ),
    ] = None
    pre_trigger: Annotated[
        float | None,
        key(
            "pre_trigger_s",
            minimum=0.0,
            help="Part of a window before the change of the reference; where absent it follows from the controller.",
        ),
    ] = None
    retry: Annotated[Retry, key(prefix="retry_", help="Repetition of unacknowledged windows.")] = field(
        default_factory=Retry
    )
    limits: Annotated[Limits, key(help="Limits that an update must respect.")] = field(default_factory=Limits)
    fine_angle: Annotated[
        bool,
        key(
            help="Send theta_m with 32 bits. With 16 a window of two turns is resolved to 0.01 deg, which moves the "
            "estimate of the gap by up to 0.02 deg (docs/decisions/0008-int16-planar-windows.md); the paper's do."
        ),
    ] = True
    longest_window: Annotated[
        float | None,
        key("longest_window_s", above=0.0, help="Longest window that the twin may request; window_s where absent."),
    ] = None
    longest_pre_trigger: Annotated[
        float | None,
        key(
            "longest_pre_trigger_s",
            minimum=0.0,
            help="Longest pre-trigger that the twin may request; pre_trigger_s where absent.",
        ),
    ] = None
    probe: ProbeLimits | None = None
    novelty: NoveltyRules | None = None


@dataclass(frozen=True)
class Commissioning:
    """Servo, running controller and twin, from which the settings of an edge follow.

    Parameters
    ----------
    servo : Servo or Axis
        The limits of updates count from its own controller's gains.
    law : Controller, Cascade or LinearLaw
        The controller that runs.
    twin : TwinSettings
    recording : Recording
    supervision : Supervision, optional
        None: derived from the policy.
    noise : float
        m rms on the measured position.
    """

    servo: Plant
    law: AnyController
    twin: TwinSettings
    recording: Recording = field(default_factory=Recording)
    supervision: Supervision | None = None
    noise: float = 0.0

    @cached_property
    def guarding(self) -> Guarding | None:
        """Supervision and limits from the policy; None: `supervision` is set, or the policy needs none.

        Raises
        ------
        InvalidInput
            No fallback set is verified for the whole stated range.
        """
        if self.supervision is not None:
            return None
        return guarding(self.servo.replace(controller=self.law), self.twin, self.noise)

    @property
    def start(self) -> Parameters:
        """Parameters before the first update: the fallback set, or the controller and a dead zone by Eq 21."""
        guarded, own = self.guarding, gains_of(self.law) == gains_of(self.servo.controller)
        if self.twin.policy == "certified":
            fallback = guarded.supervision.fallback if guarded is not None and own else None
            return Parameters() if fallback is None else start_of(fallback)
        return Parameters(setting=Setting(self.twin.initial_tolerance(self.servo)))

    @property
    def calm(self) -> bool:
        """True for a loop with hardly any integral action, which therefore does not hunt through the gap."""
        return not integrates(self.law) or self.twin.policy == "certified"

    @cached_property
    def window(self) -> float:
        """Length of a window, s: the machine's own, or one in which a slow loop does most of a step.

        The load touches the other flank where it is slowed down.
        """
        own = self._own_window
        if self.recording.window is not None:
            return own
        start, step = self.start, self.twin.uncertainty.step[1]
        law = with_gains(self.law, start.setting.gains)
        taken = move_time(self.servo, law, start.setting.tolerance, step, _LONGEST_MOVE * own)
        return max(own, self._whole(_BEYOND_MOVE * taken))

    @property
    def _own_window(self) -> float:
        """Length of a window, s: the one that is given, or as the machine's own time has it."""
        window = self.recording.window
        if window is not None:
            return window
        usual, second = CALM_WINDOW if self.calm else WINDOW, scales(self.servo).time
        # A fast machine needs short windows only, but the estimator needs some samples: of a slow law a long time.
        shortest = self._shortest_window[0]
        needed = shortest if isinstance(self.servo, Axis) else 0.0 if second >= 1.0 else min(usual, shortest)
        wanted, rate = max(usual * second, needed), self.recording.sample_rate
        if wanted * rate < 1.0:
            raise InvalidInput(
                f"sample_rate_hz = {rate!r} Hz: a window of {wanted:g} s has no sample; give a higher rate"
            )
        return self._whole(wanted)

    def with_longest(self, window: float, pre_trigger: float, samples: int) -> Commissioning:
        """The same with the longest window and pre-trigger that the twin may request, in the servo's own seconds.

        For a slow loop that is at least twice its window.

        Raises
        ------
        InvalidInput
            A window has more samples than `samples`, which the twin takes at most.
        """
        rate = self.recording.sample_rate
        if round(self.window * rate) > samples:
            count = f"has {self.window * rate:.15g} samples at {rate!r} Hz"
            raise InvalidInput(
                f"window = {self.window!r} s: {count}; the twin takes at most samples_per_window = {samples}"
            )
        second = scales(self.servo).time
        slow = self.window > self._own_window
        allowed = max(self._whole(window * second), _LONGEST_REQUEST * self.window if slow else 0.0)
        longest = max(min(allowed, samples / rate), self.window)
        before = max(self._whole(min(pre_trigger * second, longest / 2.0)), self.pre_trigger)
        recording = dataclasses.replace(self.recording, longest_window=longest, longest_pre_trigger=before)
        return dataclasses.replace(self, recording=recording)

    def _whole(self, seconds: float) -> float:
        """A time in whole samples, s."""
        return round(seconds * self.recording.sample_rate) / self.recording.sample_rate

    @property
    def pre_trigger(self) -> float:
        """Part of a window before the change of the reference, s."""
        pre_trigger = self.recording.pre_trigger
        calm = self._whole(CALM_PRE_TRIGGER * scales(self.servo).time)
        fits = self.calm and self._own_window > 2.0 * calm
        return pre_trigger if pre_trigger is not None else (calm if fits else 0.0)

    @property
    def _shortest_window(self) -> tuple[float, str]:
        twin, rate = self.twin, self.recording.sample_rate
        model = servo_for(self.servo)
        if model is None:
            needed, why = SHORTEST / rate, f"an estimate, which needs {SHORTEST} samples"
        else:
            needed, why = shortest_window(twin.method, model, rate, twin.estimator)
        late = samples_late(self.servo, rate)
        return needed + late / rate, f"{why} beside {late} by which encoders are late" if late else why

    def check_window(self) -> None:
        """Refuse a window that does not fit into memory or is too short for the estimator, or has too few samples of a
        swing.

        Raises
        ------
        InvalidInput
            Names the allowed length, or the sample rate that is needed.
        """
        slow = "" if self.servo.at_motor else too_slow(self.servo, self.recording.sample_rate)
        if slow:
            raise InvalidInput(f"recording sample_rate_hz: {slow}")
        rate = max(self.recording.sample_rate, self.law.sample_rate or 0.0)
        window = self._own_window
        check_samples("window", self.recording.longest_window or window, rate)
        needed, why = self._shortest_window
        if window < needed * (1.0 - 1e-9):
            raise InvalidInput(
                f"window = {window!r} s is too short for {why}: must be at least {needed:.6g} s at "
                f"{self.recording.sample_rate:g} Hz"
            )

    def agent_settings(self, servo: str, boot: str) -> AgentSettings:
        """Make the settings of the agent of a servo (by name) for one boot.

        Raises
        ------
        InvalidInput
            No fallback set is verified for the whole stated range.
        """
        return self._agent_settings(servo, boot, self.window)

    def check_agent(self, servo: str, boot: str) -> None:
        """Refuse what `agent_settings` does, without a run that tells how long a step takes; raises InvalidInput."""
        self._agent_settings(servo, boot, self._own_window)

    def check_recorder(self, servo: str, boot: str) -> None:
        """Refuse windows that an agent would refuse, without a search for the setting at the start.

        Raises
        ------
        InvalidInput
        """
        self._recorder_settings(servo, boot, self._own_window)

    def _agent_settings(self, servo: str, boot: str, window: float) -> AgentSettings:
        agent = dataclasses.replace(self._recorder_settings(servo, boot, window), parameters=self.start)
        own, guarded = gains_of(self.servo.controller), self.guarding
        if guarded is not None:
            open_limits = self.recording.limits == Limits()
            return dataclasses.replace(
                agent,
                limits=guarded.limits if open_limits else self.recording.limits,
                controller=self.law,
                own=own,
                supervision=guarded.supervision,
            )
        if self.supervision is not None:
            return dataclasses.replace(agent, controller=self.law, own=own, supervision=self.supervision)
        return agent

    def _recorder_settings(self, servo: str, boot: str, window: float) -> AgentSettings:
        """Settings of the agent that concern windows."""
        r = self.recording
        return AgentSettings(
            servo=servo,
            boot=boot,
            sample_rate=r.sample_rate,
            window_s=window,
            pre_trigger_s=self.pre_trigger,
            fine_angle=r.fine_angle,
            retry=r.retry,
            limits=r.limits,
            model_version=self.servo.version,
            window_filter=self._novelty(),
            motor_encoder=self.servo.sensors.motor_encoder,
            longest_window_s=r.longest_window,
            longest_pre_trigger_s=r.longest_pre_trigger,
            probe=r.probe,
            units=own_units(self.servo),
        )

    def _novelty(self) -> NoveltySettings | None:
        rules = self.recording.novelty
        if rules is None:
            return None
        model = servo_for(self.servo)
        if model is None:
            raise InvalidInput(
                "[novelty]: the edge's filter needs an axis that is held in the gap and has two masses or more, and no "
                "friction of the load"
            )
        return NoveltySettings(model_of(model, self.recording.sample_rate), rules, self.twin.initial_gap)


def check_samples(name: str, seconds: float, rate: float) -> None:
    """Refuse a time whose samples do not fit into memory."""
    if not seconds * rate <= _MOST_SAMPLES:
        count = f"has {seconds * rate:.3g} samples at {rate!r} Hz; at most {_MOST_SAMPLES:g} are allowed"
        raise InvalidInput(f"{name} = {seconds!r} s: {count}")
