"""Which parameters are in force: joins the switch, the watch, the twin's silence and the store of what was proved.

It looks every `period` samples, at multiples of the period, and only when there is something to look for; so it decides
the same whether samples come one by one or in blocks.
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
from servotwin.edge.switch import Rules, Step, Switch
from servotwin.edge.verdict import Verdict
from servotwin.edge.watch import Watch
from servotwin.messages import Cause, Fallback, Receipt, Update

Said = tuple[Receipt | Fallback, ...]


class Supervisor:
    """Decides about parameters; the agent tells it what happens.

    Parameters
    ----------
    settings : AgentSettings
    recorder : Recorder
        Where the agent puts its samples.
    store : ParameterStore, optional
        What it holds goes before the configured parameters.
    """

    def __init__(self, settings: AgentSettings, recorder: Recorder, store: ParameterStore | None = None) -> None:
        self._settings, self._recorder, self._store = settings, recorder, store
        self._rules = Rules(settings.limits, settings.controller, settings.own)
        self._state = Switch(self._first_parameters())
        self._fallback = settings.supervision.fallback
        self._watch = self._new_watch()
        self._asked: float | None = None
        self._saved = True

    @property
    def parameters(self) -> Parameters:
        """In force from the next sample on."""
        return self._state.current

    @property
    def next_look(self) -> float:
        """Number of samples at which it looks next; inf: nothing to look for."""
        period, samples = self._settings.period_samples, self._recorder.samples
        next_one = (samples // period + 1) * period
        if self._watching or self._state.waiting is not None:
            return next_one
        if self._asked is None or self._fallback is None or self._fallback.silence_s == inf or self.parameters.fallback:
            return inf
        late = (self._asked + self._fallback.silence_s) * self._settings.sample_rate
        return max(next_one, ceil(late / period - 1e-9) * period)

    def offer(self, update: Update) -> Said:
        """Take an update from the twin."""
        return self._take(switch.offer(self._state, update, self._rules, self._here, self._error))

    def restore(self, former: Parameters) -> Said:
        """The drive runs on those, as it does not take what is in force."""
        return self._take(switch.restore(self._state, former, self._here))

    def asked(self, now: float) -> None:
        """A window is on its way to the twin."""
        self._asked = now if self._asked is None else self._asked

    def answered(self, now: float, more: bool) -> None:
        """The twin was heard; whether windows still wait for its answer."""
        self._asked = now if more else None

    def look(self) -> Said:
        """Decide on what is known, if this is one of the samples to look at."""
        if self._recorder.samples % self._settings.period_samples != 0:
            return ()
        verdict = self._verdict()
        if verdict is not None and self._fallback is not None:
            return self._take(switch.fall_back(self._state, self._fallback, verdict, self._here))
        self._keep()
        return self._take(switch.settle(self._state, self._rules, self._here, self._error))

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
        """As kept by the last boot, otherwise as configured."""
        kept = None if self._store is None else self._store.load()
        first = self._settings.parameters if kept is None else kept
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

    def _take(self, step: Step) -> Said:
        """Go on from a decision."""
        before, self._state = self._state, step.state
        if self._state.current is not before.current:
            self._saved = False
            if self._watch is not None:
                self._watch.restart(self.parameters.setting.band, self.parameters.sample)
            self._keep()
        return step.said

    def _keep(self) -> None:
        """Save the parameters in force once the loop has proved them; the fallback set is proved already."""
        if self._store is None or self._saved:
            return
        if not self._watching or (self._watch is not None and self._watch.proven):
            self._store.save(self.parameters)
            self._saved = True

    def _verdict(self) -> Verdict | None:
        """Evidence against the parameters in force; none against the fallback set, since nothing is left to do."""
        if self._fallback is None or self.parameters.fallback:
            return None
        return self._seen() or self._silence()

    def _seen(self) -> Verdict | None:
        if self._watch is None:
            return None
        last = self._recorder.samples
        first = last - self._settings.period_samples
        part = self._recorder.cut(first, last)
        return self._watch.see(first, part["reference"], part["position"], part["voltage"])

    def _silence(self) -> Verdict | None:
        if self._fallback is None or self._asked is None:
            return None
        waited = self._here.time - self._asked
        return Verdict(Cause.SILENCE, waited, self._fallback.silence_s) if waited >= self._fallback.silence_s else None
