"""Whether a cut window is worth sending: state and cut in, state and verdict out.

What counts is the change since the twin was last told: the baseline begins anew at each window that was sent as news.
An accepted update has it learnt again: what was learnt before counts as a few windows, and where the update stands on a
window that said nothing here, it moves with the update's gap. A window that says nothing of the gap moves nothing.
"""

from math import hypot, inf, sqrt
from typing import NamedTuple

import msgspec
from msgspec import Struct, structs

from servotwin.edge.cut import Cut
from servotwin.edge.novelty.chart import Chart, begun, look, relearning
from servotwin.edge.novelty.lost_motion import rests
from servotwin.edge.novelty.score import Offset, Score, score
from servotwin.edge.novelty.settings import NoveltyRules, NoveltySettings
from servotwin.errors import InvalidInput

PROBE, FIRST, PERIODIC = "probe", "first", "periodic"
LOST_MOTION, SCORE, CUSUM = "novelty: lost motion", "novelty: score", "novelty: cusum"
NEWS = LOST_MOTION, SCORE, CUSUM

_KEPT = 8  # windows that an update may stand on
_WIDEST = 1.0  # rad: a spread beyond says nothing
_STILL = 0.2  # of the margin: what moves less rests


class NoveltyState(Struct, frozen=True, tag="novelty/1"):
    """What the edge knows of what the twin knows.

    Attributes
    ----------
    gap : float
        rad, where the next score begins.
    chart : Chart
    version : int
        Of the parameters in force.
    told : float or None
        rad, the last update's gap.
    sent : float or None
        s of this boot, end of the last window sent.
    owed, silent : int
        Windows still to be sent whatever they say; windows in a row that said nothing.
    recent : tuple of int
        Sequences of the last windows that said something.
    low, high : float
        rad, leads at rest; high below low: none yet.
    bound : float
        rad, lost motion that the twin was told of.
    offset : (float, float) or None
        rad, the encoder's, and its standard deviation; None: no window of this boot has shown it.
    noise : float
        m, what the last fit left; 0: not known.
    """

    gap: float
    owed: int
    chart: Chart = Chart()
    version: int = 0
    told: float | None = None
    sent: float | None = None
    silent: int = 0
    recent: tuple[int, ...] = ()
    low: float = inf
    high: float = -inf
    bound: float = 0.0
    offset: tuple[float, float] | None = None
    noise: float = 0.0


class Verdict(NamedTuple):
    """Why a window is to be sent, and what it said.

    Attributes
    ----------
    reason : str
        Empty: it is not to be sent.
    score : Score or None
        None: it says nothing of the gap.
    change : float
        From the baseline, standard deviations.
    lost_motion : float
        rad, since the boot or the last update.
    """

    reason: str
    score: Score | None
    change: float
    lost_motion: float


class Judged(NamedTuple):
    """State and verdict."""

    state: NoveltyState
    verdict: Verdict


def start(settings: NoveltySettings) -> NoveltyState:
    """Of an edge that knows nothing yet."""
    return NoveltyState(settings.gap, settings.rules.learn)


def booted(state: NoveltyState, rules: NoveltyRules) -> NoveltyState:
    """After a restart: the baseline stays, what counts samples or the encoder's turns begins anew."""
    return NoveltyState(state.gap, rules.learn, state.chart, state.version, state.told)


def judge(state: NoveltyState, cut: Cut, settings: NoveltySettings) -> Judged:
    """Look at a cut window.

    Parameters
    ----------
    state : NoveltyState
    cut : Cut
        Its `reason` is why it was cut.
    settings : NoveltySettings
    """
    rules, model = settings.rules, settings.model
    leads = rests(cut.signals["theta_m"], cut.signals["position"], model.rate, model.static_gain, _still(rules))
    state = _rested(_updated(state, cut, rules), leads)
    found = _read(state, cut, settings)
    if found is None:
        return _silent(state, cut, settings)
    seen = look(state.chart, found.gap, found.std, rules)
    far = abs(found.gap - state.chart.anchor) > rules.outlier
    news = SCORE if seen.sudden else CUSUM if seen.slow else LOST_MOTION if _lost(state, rules) else ""
    state = structs.replace(_taught(state, cut, found, rules), chart=seen.chart)
    reason = _reason(state, cut, settings, news)
    if news:
        state = structs.replace(state, owed=rules.confirm if far else 0)
    elif state.owed and reason:
        state = structs.replace(state, owed=state.owed - 1)
    return Judged(_sent(state, cut, settings, reason), Verdict(reason, found, seen.change, _range(state)))


def _taught(state: NoveltyState, cut: Cut, found: Score, rules: NoveltyRules) -> NoveltyState:
    """What a window says beside the chart."""
    return structs.replace(
        state,
        gap=max(0.0, found.gap),
        silent=0,
        recent=(*state.recent, cut.sequence)[-_KEPT:],
        offset=_carried(state.offset, found.offset, rules),
        noise=found.noise,
    )


def _read(state: NoveltyState, cut: Cut, settings: NoveltySettings) -> Score | None:
    """What it says by itself, otherwise with the encoder's offset as known; None: nothing."""
    signals, least = (cut.signals["theta_m"], cut.signals["position"]), settings.rules.travel
    alone = score(*signals, settings.model, state.gap, usual=state.noise)
    if alone is not None and min(alone.travel) >= least and alone.std < _WIDEST:
        return alone
    if state.offset is None:
        return None
    carried = score(*signals, settings.model, state.gap, Offset(*state.offset), state.noise)
    return carried if carried is not None and max(carried.travel) >= least and carried.std < _WIDEST else None


def _carried(known: tuple[float, float] | None, read: Offset, rules: NoveltyRules) -> tuple[float, float] | None:
    """The offset with one more reading, which may have moved by the resolution since the last."""
    if not read.std < inf:
        return known
    if known is None:
        return read.value, hypot(read.std, rules.resolution)
    before, new = (std * std + rules.resolution * rules.resolution for std in (known[1], read.std))
    share = before / (before + new)
    return known[0] + share * (read.value - known[0]), sqrt(share * new)


def _silent(state: NoveltyState, cut: Cut, settings: NoveltySettings) -> Judged:
    """A window that says nothing of the gap, but for the lost motion at rest."""
    rules = settings.rules
    news = LOST_MOTION if _lost(state, rules) else ""
    patient = state.silent >= rules.patience
    reason = _reason(structs.replace(state, owed=0) if patient else state, cut, settings, news)
    state = structs.replace(state, silent=state.silent + 1)
    return Judged(_sent(state, cut, settings, reason), Verdict(reason, None, 0.0, _range(state)))


def _reason(state: NoveltyState, cut: Cut, settings: NoveltySettings, news: str) -> str:
    """Why to send, the weightiest first."""
    if cut.reason == PROBE:
        return PROBE
    if news or state.owed:
        return news or FIRST
    late = cut.last / settings.model.rate - (state.sent or 0.0) >= settings.rules.period_s
    return PERIODIC if late else ""


def _sent(state: NoveltyState, cut: Cut, settings: NoveltySettings, reason: str) -> NoveltyState:
    """What the twin knows once it has the window."""
    if not reason:
        return state
    return structs.replace(state, sent=cut.last / settings.model.rate, bound=max(state.bound, _range(state)))


def _updated(state: NoveltyState, cut: Cut, rules: NoveltyRules) -> NoveltyState:
    """With the update accepted since the last window."""
    if cut.parameter_version == state.version:
        return state
    state = structs.replace(state, version=cut.parameter_version)
    if cut.gap is None:
        return state
    return structs.replace(state, chart=_relearnt(state, cut, rules), told=cut.gap, owed=0)


def _relearnt(state: NoveltyState, cut: Cut, rules: NoveltyRules) -> Chart:
    """A baseline that stands on few windows; where the update's own said nothing here, moved by as much as its gap."""
    if cut.basis in state.recent or state.chart.weight == 0.0:
        return relearning(state.chart, rules.relearn)
    if state.told is None or cut.gap is None:
        return begun(state.chart)
    return begun(state.chart, state.chart.gap + cut.gap - state.told, 1.0 / (rules.settle * rules.settle))


def _rested(state: NoveltyState, leads: list[float]) -> NoveltyState:
    return structs.replace(state, low=min(state.low, *leads), high=max(state.high, *leads)) if leads else state


def _still(rules: NoveltyRules) -> float:
    return _STILL * rules.margin


def _range(state: NoveltyState) -> float:
    return max(0.0, state.high - state.low)


def _lost(state: NoveltyState, rules: NoveltyRules) -> bool:
    """Whether the lost motion exceeds what the twin knows."""
    known = state.told if state.told is not None else max(0.0, state.chart.gap)
    return _range(state) > max(known, state.bound) + max(rules.margin, rules.worth)


def dumps(state: NoveltyState) -> bytes:
    """The state as bytes (MessagePack: infinities travel too)."""
    return msgspec.msgpack.encode(state)


def loads(data: bytes) -> NoveltyState:
    """The state from bytes.

    Raises
    ------
    InvalidInput
        They are not a state.
    """
    try:
        return msgspec.msgpack.decode(data, type=NoveltyState)
    except (msgspec.MsgspecError, ValueError) as error:
        raise InvalidInput(f"not the state of a novelty detector: {error}") from None


class Novelty:
    """The judge of an outlet: keeps the state, and counts.

    Parameters
    ----------
    settings : NoveltySettings
    state : NoveltyState, optional
        Kept from an earlier boot; None: nothing is known.
    """

    def __init__(self, settings: NoveltySettings, state: NoveltyState | None = None) -> None:
        self.settings = settings
        self.state = start(settings) if state is None else booted(state, settings.rules)
        self.verdict: Verdict | None = None

    def dumps(self) -> bytes:
        """Encode the state."""
        return dumps(self.state)

    def __call__(self, cut: Cut) -> Cut | None:
        """The window with the reason why it is to be sent; None: it is not."""
        self.state, self.verdict = judge(self.state, cut, self.settings)
        return cut._replace(reason=self.verdict.reason) if self.verdict.reason else None
