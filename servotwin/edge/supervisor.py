"""Supervisor of the parameters in force: it joins the switch, the watch, the twin's silence and the parameter store.

It checks at multiples of its period, and only when there is something to check; so its decisions are the same whether
samples come one by one or in blocks.
"""

from dataclasses import replace
from math import ceil, inf

import msgspec

from servotwin.control.gains import gains_of
from servotwin.edge import switch
from servotwin.edge.guard import Instant
from servotwin.edge.parameters import Parameters
from servotwin.edge.recorder import Recorder
from servotwin.edge.settings import AgentSettings
from servotwin.edge.store import ParameterStore
from servotwin.edge.switch import Rules, Switch, Transition
from servotwin.edge.watch import Violation, Watch
from servotwin.messages import Cause, Fallback, Receipt, Update

Messages = tuple[Receipt | Fallback, ...]


class Supervisor:
    """Decides about parameters; the agent reports updates, windows sent, and answers of the twin.

    Parameters
    ----------
    settings : AgentSettings
    recorder : Recorder
        Samples of the agent.
    store : ParameterStore, optional
        Its parameters, where it has some, replace the configured ones.
    """

    def __init__(self, settings: AgentSettings, recorder: Recorder, store: ParameterStore | None = None) -> None:
        self._settings, self._recorder, self._store = settings, recorder, store
        self._rules = Rules(settings.limits, settings.controller, settings.own)
        self._state = Switch(self._first_parameters())
        self._fallback = settings.supervision.fallback
        self._watch = self._new_watch()
        self._unanswered_since: float | None = None
        self._saved = True

    @property
    def parameters(self) -> Parameters:
        """Parameters in force from the next sample on."""
        return self._state.current

    @property
    def next_check(self) -> float:
        """Number of samples at which it checks next; inf: nothing to check."""
        period, samples = self._settings.period_samples, self._recorder.samples
        next_one = (samples // period + 1) * period
        if self._watching or self._state.pending is not None:
            return next_one
        if (
            self._unanswered_since is None
            or self._fallback is None
            or self._fallback.silence_s == inf
            or self.parameters.fallback
        ):
            return inf
        late = (self._unanswered_since + self._fallback.silence_s) * self._settings.sample_rate
        return max(next_one, ceil(late / period - 1e-9) * period)  # 1e-9: rounding of a time that is a multiple

    def offer(self, update: Update) -> Messages:
        """Take an update from the twin."""
        return self._advance(switch.offer(self._state, update, self._rules, self._here, self._error))

    def restore(self, former: Parameters) -> Messages:
        """Put former parameters in force again, since the drive has refused the present ones."""
        return self._advance(switch.restore(self._state, former, self._here))

    def window_sent(self, now: float) -> None:
        """Note that a window is on its way to the twin."""
        self._unanswered_since = now if self._unanswered_since is None else self._unanswered_since

    def twin_answered(self, now: float, more: bool) -> None:
        """Note an answer of the twin's; `more` windows may still wait for theirs."""
        self._unanswered_since = now if more else None

    def check(self) -> Messages:
        """Check the loop and the twin, if a check is due at this sample."""
        if self._recorder.samples % self._settings.period_samples != 0:
            return ()
        violation = self._violation()
        if violation is not None and self._fallback is not None:
            return self._advance(switch.fall_back(self._state, self._fallback, violation, self._here))
        self._store_verified()
        return self._advance(switch.apply_pending(self._state, self._rules, self._here, self._error))

    @property
    def _watching(self) -> bool:
        return self._watch is not None and not self.parameters.fallback

    @property
    def _here(self) -> Instant:
        s = self._settings
        return Instant(s.servo, s.boot, self._recorder.samples, s.sample_rate)

    @property
    def _error(self) -> float | None:
        samples = self._recorder.samples
        if samples == 0:
            return None
        last = self._recorder.cut(samples - 1, samples)
        return last["reference"][0] - last["position"][0]

    def _first_parameters(self) -> Parameters:
        """Parameters stored by the last boot, otherwise the configured ones."""
        stored = None if self._store is None else self._store.load()
        first = self._settings.parameters if stored is None else stored
        if first.setting.gains is None and self._settings.controller is not None:
            setting = msgspec.structs.replace(first.setting, gains=gains_of(self._settings.controller))
            return replace(first, setting=setting)
        return first

    def _new_watch(self) -> Watch | None:
        s = self._settings
        if self._fallback is None or s.supervision.watch is None:
            return None
        watch = Watch(s.supervision.watch, s.sample_rate, s.reference, self._fallback.setting.band)
        watch.restart(self.parameters.setting.band, 0)
        return watch

    def _advance(self, transition: Transition) -> Messages:
        """Take over the state after a decision, and return its messages."""
        before, self._state = self._state, transition.state
        if self._state.current is not before.current:
            self._saved = False
            if self._watch is not None:
                self._watch.restart(self.parameters.setting.band, self.parameters.sample)
            self._store_verified()
        return transition.messages

    def _store_verified(self) -> None:
        """Store the parameters in force once the loop has kept their band; the fallback set at once."""
        if self._store is None or self._saved:
            return
        if not self._watching or (self._watch is not None and self._watch.verified):
            self._store.save(self.parameters)
            self._saved = True

    def _violation(self) -> Violation | None:
        """Evidence against the parameters in force; never against the fallback set, which nothing can replace."""
        if self._fallback is None or self.parameters.fallback:
            return None
        return self._watch_loop() or self._silence()

    def _watch_loop(self) -> Violation | None:
        if self._watch is None:
            return None
        last = self._recorder.samples
        first = last - self._settings.period_samples
        part = self._recorder.cut(first, last)
        return self._watch.update(first, part["reference"], part["position"], part["voltage"])

    def _silence(self) -> Violation | None:
        if self._fallback is None or self._unanswered_since is None:
            return None
        waited, allowed = self._here.time - self._unanswered_since, self._fallback.silence_s
        return Violation(Cause.SILENCE, waited, allowed) if waited >= allowed else None
