"""A scenario's TOML: which key, in which unit, becomes which value."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from servotwin.config.table import Table, part
from servotwin.config.toml import changes
from servotwin.control.controller import Controller
from servotwin.control.gains import read_gains
from servotwin.edge import settings_file as edgefile
from servotwin.edge.limits import Limits
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.settings import Supervision
from servotwin.link.simulated import LinkSettings
from servotwin.messages import Gains
from servotwin.novelty import settings_file as noveltyfile
from servotwin.novelty.settings import NoveltyRules
from servotwin.plant.noise import Noise
from servotwin.plant.servo import PRESETS, Servo
from servotwin.plant.signals import Samples, SCurve, SignalLike, SquareWave, Step
from servotwin.runtime.retry import Retry
from servotwin.twin.settings import read_twin_settings

MM = 1e-3
DEG = math.pi / 180.0


@dataclass(frozen=True)
class Recording:
    """What the edge records and sends.

    Parameters
    ----------
    sample_rate : float
        Hz.
    window, pre_trigger : float, optional
        s, length of a window and how much of it lies before the change of the reference; None: as the controller asks
        for, see `Scenario`.
    longest_window, longest_pre_trigger : float, optional
        s, what the twin may request instead; None: no more than that.
    probe : ProbeLimits, optional
        Which probing moves of the reference it may request; None: none. In a file, [edge.probe].
    retry : Retry
        When a window without acknowledgement is sent again.
    limits : Limits
        What an update must respect.
    novelty : NoveltyRules, optional
        Which windows the edge finds worth sending; None: every one. In a file, [novelty].
    fine_angle : bool
        Whether theta_m travels with 32 bits. With 16 a window of two turns is resolved to 0.01 deg, which moves the
        estimate of the gap by up to 0.02 deg (docs/decisions/0008-int16-planar-windows.md); the paper's do.
    """

    sample_rate: float = 5000.0
    window: float | None = None
    pre_trigger: float | None = None
    retry: Retry = field(default_factory=Retry)
    limits: Limits = field(default_factory=Limits)
    fine_angle: bool = True
    longest_window: float | None = None
    longest_pre_trigger: float | None = None
    probe: ProbeLimits | None = None
    novelty: NoveltyRules | None = None

    @property
    def requests(self) -> dict[str, Any]:
        """What the twin may request, as `AgentSettings` call it."""
        before = self.longest_pre_trigger
        return {"longest_window_s": self.longest_window, "longest_pre_trigger_s": before, "probe": self.probe}


def read(table: Table, folder: Path) -> dict[str, Any]:
    """The values of a `Scenario`; a servo's path is relative to `folder`.

    Raises
    ------
    InvalidInput
        A key is unknown or missing, or its value is not allowed.
    """
    servo = _servo(table, folder)
    values: dict[str, Any] = {
        "servo": servo,
        "duration": table.number("duration_s", positive=True),
        "seed": table.integer("seed", 0),
        "name": table.text("name", "servo"),
        "theta_d0": table.number("theta_d0_deg", 0.0) * DEG,
        "reference": part(table, "reference", _reference),
        "gap": part(table, "gap", _gap),
        "recording": replace(part(table, "recording", _recording), probe=_probe(table), novelty=_novelty(table)),
        "twin": part(table, "twin", lambda inner: read_twin_settings(inner, folder)),
        **part(table, "disturbances", _disturbances),
    }
    values["controller"] = part(table, "controller", lambda t: _controller(t, servo.controller))
    values["supervision"] = _supervision(table, values["controller"] or servo.controller)
    values["noise"] = part(table, "noise", _noise) if "noise" in table.values else None
    values["uplink"], values["downlink"] = part(table, "link", _links)
    table.table("noise")
    table.done()
    return values


def _servo(table: Table, folder: Path) -> Servo:
    name = table.text("servo")
    if name not in PRESETS and not (folder / name).is_file():
        raise table.invalid(
            "servo", f"one of {', '.join(PRESETS)}, or the path of a servo's TOML, relative to this file"
        )
    return Servo.resolve(name, folder)


def _reference(table: Table) -> SignalLike:
    return _REFERENCES[table.text("kind", choices=tuple(_REFERENCES))](table)


def _square(table: Table) -> SignalLike:
    amplitude, offset = table.number("amplitude_mm") * MM, table.number("offset_mm", 0.0) * MM
    return SquareWave(amplitude, table.number("period_s", positive=True), offset)


def _step(table: Table) -> SignalLike:
    return Step(table.number("size_mm") * MM, table.number("at_s", 0.0, minimum=0.0))


def _s_curve(table: Table) -> SignalLike:
    ends = table.number("from_mm") * MM, table.number("to_mm") * MM
    return SCurve(*ends, table.number("over_s", positive=True), table.number("begin_s", 0.0))


def _samples(table: Table) -> SignalLike:
    times, values = table.numbers("times_s"), table.numbers("values_mm")
    return Samples(_listed(times), [value * MM for value in _listed(values)])


def _constant(table: Table) -> SignalLike:
    return table.number("value_mm") * MM


_REFERENCES: Mapping[str, Callable[[Table], SignalLike]] = {
    "square": _square,
    "step": _step,
    "s-curve": _s_curve,
    "samples": _samples,
    "constant": _constant,
}


def _listed(numbers: float | tuple[float, ...]) -> tuple[float, ...]:
    return numbers if isinstance(numbers, tuple) else (numbers,)


def _gap(table: Table) -> SignalLike:
    """The total gap: `total_deg`, or an S-curve from `from_deg` to `to_deg` in `over_s`."""
    if "total_deg" in table.values or not table.values:
        return table.number("total_deg", minimum=0.0) * DEG
    ends = table.number("from_deg", minimum=0.0) * DEG, table.number("to_deg", minimum=0.0) * DEG
    return SCurve(*ends, table.number("over_s", positive=True), table.number("begin_s", 0.0))


def _controller(table: Table, controller: Controller) -> Controller | None:
    """The servo's controller with what the scenario changes, keys as in a servo's file; None: it changes nothing."""
    changed = changes(table, Controller)
    return controller.replace(**changed) if changed else None


def _noise(table: Table) -> Noise:
    kind = table.text("kind", "highpass", choices=("highpass", "white"))
    band = _listed(table.numbers("band_hz", (10.0, 50.0), positive=True))
    if len(band) != 2:
        raise table.invalid("band_hz", "two numbers, the stop and the pass edge")
    return Noise(
        table.number("std_mm", minimum=0.0) * MM, (band[0], band[1]), "white" if kind == "white" else "highpass"
    )


def _links(table: Table) -> tuple[LinkSettings, LinkSettings]:
    """Edge to twin and back: [link] for both, [link.up] and [link.down] for what differs."""
    both = _link(table, LinkSettings())
    return part(table, "up", lambda t: _link(t, both)), part(table, "down", lambda t: _link(t, both))


def _link(table: Table, default: LinkSettings) -> LinkSettings:
    def share(key: str) -> float:
        return table.number(key, getattr(default, key), minimum=0.0, maximum=1.0)

    outages = tuple(_outage(each) for each in table.tables("outages"))
    return LinkSettings(
        delay_s=table.number("delay_s", default.delay_s, minimum=0.0),
        jitter_s=table.number("jitter_s", default.jitter_s, minimum=0.0),
        loss=share("loss"),
        duplicate=share("duplicate"),
        reorder=share("reorder"),
        hold_s=table.number("hold_s", default.hold_s, minimum=0.0),
        outages=outages or default.outages,
    )


def _outage(table: Table) -> tuple[float, float]:
    begin, end = table.number("from_s"), table.number("to_s")
    table.done()
    return begin, end


def _recording(table: Table) -> Recording:
    default = Recording()
    return Recording(
        sample_rate=table.number("sample_rate_hz", default.sample_rate, positive=True),
        window=table.number("window_s", None, positive=True),
        pre_trigger=table.number("pre_trigger_s", None, minimum=0.0),
        fine_angle=table.boolean("fine_angle", default.fine_angle),
        retry=_retry(table, default.retry),
        limits=part(table, "limits", edgefile.limits),
        longest_window=table.number("longest_window_s", None, positive=True),
        longest_pre_trigger=table.number("longest_pre_trigger_s", None, minimum=0.0),
    )


def _retry(table: Table, default: Retry) -> Retry:
    return Retry(
        table.number("retry_first_s", default.first_s, positive=True),
        table.number("retry_factor", default.factor, minimum=1.0),
        table.number("retry_longest_s", default.longest_s, positive=True),
    )


def _supervision(table: Table, controller: Controller) -> Supervision | None:
    """[edge]: updates may set gains, and the edge looks after itself; without it, they set the tolerance only.

    What it says of probing moves changes nothing of this.
    """
    if not table.table("edge").values.keys() - {"probe"}:
        return None

    def gains(inner: Table) -> Gains:
        return read_gains(inner, controller)

    def whole(inner: Table) -> Supervision:
        inner.table("probe")
        return edgefile.supervision(inner, gains)

    return part(table, "edge", whole)


def _probe(table: Table) -> ProbeLimits | None:
    """[edge.probe]: the twin may request probing moves of the reference."""
    inner = table.table("edge")
    return part(inner, "probe", edgefile.probe) if "probe" in inner.values else None


def _novelty(table: Table) -> NoveltyRules | None:
    """[novelty]: the edge tells what is worth sending; an empty table takes the defaults."""
    rules = part(table, "novelty", noveltyfile.rules)
    return rules if "novelty" in table.values else None


def _disturbances(table: Table) -> dict[str, float]:
    return {
        "input_bias": table.number("input_bias_v", 0.0),
        "friction": table.number("friction_n_m", 0.0, minimum=0.0),
    }
