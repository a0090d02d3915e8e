"""Novelty detector: state and cut window in, state and verdict out.

It measures the change of the gap since the last window that was sent as news; that window begins a new baseline. After
an accepted update the baseline counts as a few windows only, and where the update stands on a window that did not show
the gap here, the baseline moves with the update's gap. A window that does not show the gap changes no baseline.
News on which no update stands is sent again, ever more rarely: the twin may have rejected the window.
A response that the twin has learnt takes the place of the configured one, and begins another baseline.
"""

from dataclasses import replace
from functools import lru_cache
from math import hypot, inf, sqrt
from typing import NamedTuple

import msgspec
from msgspec import Struct, structs

from servotwin.edge.recorder import Cut
from servotwin.errors import InvalidInput
from servotwin.estimation.core.visible import least_travel
from servotwin.messages import PROBE, TEACHING, LearntResponse
from servotwin.novelty.chart import Chart, add_window, restarted, with_fewer_windows
from servotwin.novelty.score import EncoderOffset, Score, leads_at_rest, score
from servotwin.novelty.settings import NoveltyModel, NoveltyRules, NoveltySettings, ResponseMode

FIRST, PERIODIC = "first", "periodic"
LOST_MOTION, SCORE, CUSUM = "novelty: lost motion", "novelty: score", "novelty: cusum"

# Names under which the states of earlier versions are stored.
_STORED = {
    "unconditional": "owed",
    "update_gap": "told",
    "last_sent": "sent",
    "uninformative": "silent",
    "reported_lost_motion": "bound",
}
_RECENT = 8  # windows that an update may stand on
_WIDEST = 1.0  # rad: a gap with a larger spread does not count as an estimate
_STILL = 0.2  # of the margin: a signal that moves less is at rest


class NoveltyState(Struct, frozen=True, omit_defaults=True, tag="novelty/1", rename=_STORED):
    """State of the detector, which the link process stores.

    Attributes
    ----------
    gap : float
        rad, where the next score begins.
    unconditional : int
        Windows still to be sent whatever they show.
    chart : Chart
    version : int
        Of the parameters in force.
    update_gap : float or None
        rad, the last update's gap.
    last_sent : float or None
        s of this boot, end of the last window sent.
    uninformative : int
        Windows in a row that did not show the gap.
    recent : tuple of int
        Sequences of the last windows that showed the gap.
    low, high : float
        rad, leads at rest; high below low: none yet.
    reported_lost_motion : float
        rad, lost motion of the windows that were sent.
    offset : (float, float) or None
        rad, the encoder's, and its standard deviation; None: no window of this boot has shown it.
    noise : float
        m, residual (rms) of the last fit; 0: not known.
    response : LearntResponse or None
        Learnt by the twin; None: the configured one is used.
    unanswered : int or None
        Sequence of the last news on which no update stands yet; None: there is none.
    since : int
        Windows that showed the gap since then; negative: so many unconditional ones come first.
    """

    gap: float
    unconditional: int
    chart: Chart = Chart()
    version: int = 0
    update_gap: float | None = None
    last_sent: float | None = None
    uninformative: int = 0
    recent: tuple[int, ...] = ()
    low: float = inf
    high: float = -inf
    reported_lost_motion: float = 0.0
    offset: tuple[float, float] | None = None
    noise: float = 0.0
    response: LearntResponse | None = None
    unanswered: int | None = None
    since: int = 0

    @property
    def response_version(self) -> int:
        """Version of the response in use; 0: the configured one."""
        return 0 if self.response is None else self.response.version


class NoveltyVerdict(NamedTuple):
    """Reason to send a window, and the detector's measurements.

    Attributes
    ----------
    reason : str
        Empty: the window is not sent.
    score : Score or None
        None: the window does not show the gap.
    change : float
        From the baseline, standard deviations.
    lost_motion : float
        rad, since the boot or the last update.
    """

    reason: str
    score: Score | None
    change: float
    lost_motion: float


def start(settings: NoveltySettings) -> NoveltyState:
    """Return the state before the first window."""
    return _awaiting(NoveltyState(settings.gap, settings.rules.learn), 0)


def booted(state: NoveltyState, rules: NoveltyRules) -> NoveltyState:
    """Return the state after a restart: the baseline stays; sample times and the encoder's offset begin anew."""
    begun = NoveltyState(state.gap, rules.learn, state.chart, state.version, state.update_gap)
    begun = structs.replace(begun, response=state.response)
    return begun if state.update_gap is not None and state.unanswered is None else _awaiting(begun, 0)


def adopted(state: NoveltyState, response: LearntResponse, settings: NoveltySettings) -> NoveltyState:
    """Return the state with a learnt response; one that is not newer, or for another rate, changes nothing.

    Baseline and scatter were those of the response before, and a wrong one may have led the search astray. Unless an
    update comes first, the next window that shows the gap is sent: no baseline tells what has changed meanwhile.
    """
    if response.version <= state.response_version or response.rate != settings.model.rate:
        return state
    unconditional = max(state.unconditional, min(1, settings.rules.learn))
    return structs.replace(
        state, response=response, gap=response.gap, chart=Chart(), unconditional=unconditional, noise=0.0
    )


@lru_cache(maxsize=8)
def _model(configured: NoveltyModel, response: LearntResponse | None) -> NoveltyModel:
    """The model in use."""
    if response is None:
        return configured
    modes = tuple(ResponseMode(complex(*mode[:2]), complex(*mode[2:])) for mode in response.modes)
    return replace(
        configured, modes=modes, direct=response.direct, static_gain=response.static_gain, unseen=response.unseen
    )


def judge(state: NoveltyState, cut: Cut, settings: NoveltySettings) -> tuple[NoveltyState, NoveltyVerdict]:
    """Decide about a cut window.

    Parameters
    ----------
    state : NoveltyState
    cut : Cut
        Its `reason` is the reason for the cut.
    settings : NoveltySettings
    """
    if state.response is not None:
        settings = replace(settings, model=_model(settings.model, state.response))
    rules, model = settings.rules, settings.model
    theta_m, position, rate = cut.signals["theta_m"], cut.signals["position"], model.rate * model.second
    leads = leads_at_rest(theta_m, position, rate, model.static_gain, _still(rules))
    state = _rested(_updated(state, cut, rules), leads)
    estimate = _read(state, cut, settings)
    if estimate is None:
        return _without_score(state, cut, settings)
    # What is open of a learnt response differs from window to window, as noise does.
    std = estimate.std if state.response is None else hypot(estimate.std, state.response.gap_std)
    charted = add_window(state.chart, estimate.gap, std, rules)
    far = abs(estimate.gap - state.chart.anchor) > rules.outlier
    news = SCORE if charted.sudden else CUSUM if charted.slow else LOST_MOTION if _lost(state, rules) else ""
    state = _repeating(structs.replace(_after_score(state, cut, estimate, rules), chart=charted.chart), rules)
    reason = _reason(state, cut, settings, news)
    if news:
        state = _awaiting(structs.replace(state, unconditional=rules.confirm if far else 0), cut.sequence)
    elif state.unconditional and reason:
        state = structs.replace(state, unconditional=state.unconditional - 1)
    return _sent(state, cut, settings, reason), NoveltyVerdict(reason, estimate, charted.change, _range(state))


def _awaiting(state: NoveltyState, sequence: int) -> NoveltyState:
    """Await an update that stands on a window as new as this one, from the end of the unconditional ones on."""
    return structs.replace(state, unanswered=sequence, since=-state.unconditional)


def _repeating(state: NoveltyState, rules: NoveltyRules) -> NoveltyState:
    """Have windows sent again after 2, 6, 14 ... without an update: the twin may have rejected the news.

    Each time as many as after a start, because steps to and fro show one flank and the other by turns.
    """
    if state.unanswered is None:
        return state
    since = state.since + 1
    due = since > 1 and (since + 1) & (since + 2) == 0
    return structs.replace(state, since=since, unconditional=max(state.unconditional, rules.learn if due else 0))


def _after_score(state: NoveltyState, cut: Cut, estimate: Score, rules: NoveltyRules) -> NoveltyState:
    """Update all but the chart with a window's score."""
    return structs.replace(
        state,
        gap=max(0.0, estimate.gap),
        uninformative=0,
        recent=(*state.recent, cut.sequence)[-_RECENT:],
        offset=_carried(state.offset, estimate.offset, rules),
        noise=estimate.noise,
    )


def _read(state: NoveltyState, cut: Cut, settings: NoveltySettings) -> Score | None:
    """Score a window by itself, or else with the encoder's offset from earlier ones; None: it does not show the gap."""
    theta_m, position, stated = cut.signals["theta_m"], cut.signals["position"], settings.rules.travel
    least = least_travel(state.gap, settings.model.encoder_resolution) if stated is None else stated
    alone = score(theta_m, position, settings.model, state.gap, usual=state.noise)
    if alone is not None and min(alone.travel) >= least and alone.std < _WIDEST:
        return alone
    if state.offset is None:
        return None
    carried = score(theta_m, position, settings.model, state.gap, EncoderOffset(*state.offset), state.noise)
    return carried if carried is not None and max(carried.travel) >= least and carried.std < _WIDEST else None


def _carried(known: tuple[float, float] | None, read: EncoderOffset, rules: NoveltyRules) -> tuple[float, float] | None:
    """Combine the offset with one more reading; it may have moved by the resolution since the last."""
    if not read.std < inf:
        return known
    if known is None:
        return read.value, hypot(read.std, rules.resolution)
    before, new = (std * std + rules.resolution * rules.resolution for std in (known[1], read.std))
    share = before / (before + new)
    return known[0] + share * (read.value - known[0]), sqrt(share * new)


def _without_score(state: NoveltyState, cut: Cut, settings: NoveltySettings) -> tuple[NoveltyState, NoveltyVerdict]:
    """Decide about a window that shows at most the lost motion at rest."""
    rules = settings.rules
    news = LOST_MOTION if _lost(state, rules) else ""
    patient = state.uninformative >= rules.patience
    reason = _reason(structs.replace(state, unconditional=0) if patient else state, cut, settings, news)
    state = structs.replace(state, uninformative=state.uninformative + 1)
    return _sent(state, cut, settings, reason), NoveltyVerdict(reason, None, 0.0, _range(state))


def _reason(state: NoveltyState, cut: Cut, settings: NoveltySettings, news: str) -> str:
    """Reason to send, the most important first; empty: none."""
    if cut.reason in (PROBE, TEACHING):
        return cut.reason
    if news or state.unconditional:
        return news or FIRST
    late = cut.last / settings.model.rate - (state.last_sent or 0.0) >= settings.rules.period_s
    return PERIODIC if late else ""


def _sent(state: NoveltyState, cut: Cut, settings: NoveltySettings, reason: str) -> NoveltyState:
    """Update the state with a window that is sent, if there is a reason."""
    if not reason:
        return state
    reported = max(state.reported_lost_motion, _range(state))
    return structs.replace(state, last_sent=cut.last / settings.model.rate, reported_lost_motion=reported)


def _updated(state: NoveltyState, cut: Cut, rules: NoveltyRules) -> NoveltyState:
    """Update the state with the parameters accepted since the last window."""
    if cut.parameter_version == state.version:
        return state
    state = structs.replace(state, version=cut.parameter_version)
    if cut.gap is None:
        return state
    state = structs.replace(state, chart=_relearnt(state, cut, rules), update_gap=cut.gap, unconditional=0)
    earlier = state.unanswered is not None and cut.basis is not None and cut.basis < state.unanswered
    return state if earlier else structs.replace(state, unanswered=None, since=0)


def _relearnt(state: NoveltyState, cut: Cut, rules: NoveltyRules) -> Chart:
    """Give the baseline the weight of few windows; move it with the update's gap if that window was not scored here."""
    if cut.basis in state.recent or state.chart.weight == 0.0:
        return with_fewer_windows(state.chart, rules.relearn)
    if state.update_gap is None or cut.gap is None:
        return restarted(state.chart)
    return restarted(
        state.chart, state.chart.gap + cut.gap - state.update_gap, 1.0 / (rules.baseline_move * rules.baseline_move)
    )


def _rested(state: NoveltyState, leads: list[float]) -> NoveltyState:
    return structs.replace(state, low=min(state.low, *leads), high=max(state.high, *leads)) if leads else state


def _still(rules: NoveltyRules) -> float:
    return _STILL * rules.margin


def _range(state: NoveltyState) -> float:
    return max(0.0, state.high - state.low)


def _lost(state: NoveltyState, rules: NoveltyRules) -> bool:
    """Tell whether the lost motion exceeds the gap and the lost motion that the twin knows of."""
    known = state.update_gap if state.update_gap is not None else max(0.0, state.chart.gap)
    return _range(state) > max(known, state.reported_lost_motion) + max(rules.margin, rules.worth)


def dumps(state: NoveltyState) -> bytes:
    """Encode the state (MessagePack, which holds infinities)."""
    return msgspec.msgpack.encode(state)


def loads(data: bytes) -> NoveltyState:
    """Decode a state.

    Raises
    ------
    InvalidInput
        The bytes are not a state.
    """
    try:
        return msgspec.msgpack.decode(data, type=NoveltyState)
    except (msgspec.MsgspecError, ValueError) as error:
        raise InvalidInput(f"not the state of a novelty detector: {error}") from None


class NoveltyDetector:
    """Window filter that keeps the detector's state.

    Parameters
    ----------
    settings : NoveltySettings
    state : NoveltyState, optional
        From an earlier boot; None: no window has been seen.
    """

    def __init__(self, settings: NoveltySettings, state: NoveltyState | None = None) -> None:
        self.settings = settings
        self.state = start(settings) if state is None else booted(state, settings.rules)
        self.verdict: NoveltyVerdict | None = None

    @property
    def response_version(self) -> int:
        """Version of the learnt response in use; 0: the configured one."""
        return self.state.response_version

    def adopt(self, response: LearntResponse) -> None:
        """Use a learnt response from the next window on; one that is not newer, or for another rate, is ignored."""
        self.state = adopted(self.state, response, self.settings)

    def dumps(self) -> bytes:
        """Encode the state."""
        return dumps(self.state)

    def __call__(self, cut: Cut) -> Cut | None:
        """Return the window with the reason to send it; None: it is not sent."""
        self.state, self.verdict = judge(self.state, cut, self.settings)
        return cut._replace(reason=self.verdict.reason) if self.verdict.reason else None
