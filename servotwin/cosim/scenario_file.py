"""Scenario file: kinds of reference and gap, and the tables that depend on the servo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from servotwin.commissioning.edge_settings import Recording
from servotwin.config.keys import Maker, key, name_of
from servotwin.config.own_units import AT_LOAD
from servotwin.config.table import Table, named, read_inner
from servotwin.config.toml import changes, made, part, read
from servotwin.config.units import unit_of
from servotwin.control.controller import Controller
from servotwin.control.gains import read_gains
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.settings import Supervision
from servotwin.edge.settings_file import read_supervision
from servotwin.link.simulated import LinkSettings
from servotwin.messages import AnyGains
from servotwin.novelty.settings import NoveltyRules
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Samples, SCurve, SignalLike, SquareWave, Step
from servotwin.twin.settings import TwinSettings, check_gaps, read_twin_settings

CONTROLLER, RECORDING, PROBE, NOVELTY, LINK, TWIN = (
    name_of(each) for each in (Controller, Recording, ProbeLimits, NoveltyRules, LinkSettings, TwinSettings)
)
EDGE, UP, DOWN = "edge", "up", "down"
"""Tables of the file, beside those that `Scenario` declares."""
GAP = "gap"
PAPER = "paper"
"""Policy that begins with the servo's own controller, and needs nothing verified."""


def square_wave(
    amplitude: Annotated[float, key("amplitude_mm", "amplitude_deg", help="Half the difference of the two levels.")],
    period: Annotated[float, key("period_s", above=0.0, help="Period.")],
    offset: Annotated[float, key("offset_mm", "offset_deg", help="Mean of the two levels.")] = 0.0,
) -> SignalLike:
    """Square wave."""
    return SquareWave(amplitude, period, offset)


def step(
    size: Annotated[float, key("size_mm", "size_deg", help="Size of the step.")],
    at: Annotated[float, key("at_s", minimum=0.0, help="Time of the step.")] = 0.0,
) -> SignalLike:
    """One step."""
    return Step(size, at)


def s_curve(
    begin_value: Annotated[float, key("from_mm", "from_deg", help="First value.")],
    end_value: Annotated[float, key("to_mm", "to_deg", help="Last value.")],
    over: Annotated[float, key("over_s", above=0.0, help="Time from the first to the last value.")],
    begin: Annotated[float, key("begin_s", help="Time at which it begins.")] = 0.0,
) -> SignalLike:
    """Smooth change from one value to another."""
    return SCurve(begin_value, end_value, over, begin)


def samples(
    times: Annotated[tuple[float, ...], key("times_s", help="Times.")],
    values: Annotated[tuple[float, ...], key("values_mm", "values_deg", help="Values, as many.")],
) -> SignalLike:
    """Values at given times; the last one holds."""
    return Samples(times, list(values))


def constant(value: Annotated[float, key("value_mm", "value_deg", help="Value.")]) -> SignalLike:
    """One value at all times."""
    return value


REFERENCES: Mapping[str, Maker] = {
    "square": square_wave, "step": step, "s-curve": s_curve, "samples": samples, "constant": constant,
}  # fmt: skip


def constant_gap(
    total: Annotated[float, key("total_deg", minimum=0.0, at_load=True, help="Total gap.")],
) -> SignalLike:
    """Constant gap."""
    return total


def growing_gap(
    begin_value: Annotated[float, key("from_deg", minimum=0.0, at_load=True, help="First total gap.")],
    end_value: Annotated[float, key("to_deg", minimum=0.0, at_load=True, help="Last total gap.")],
    over: Annotated[float, key("over_s", above=0.0, help="Time from the first to the last.")],
    begin: Annotated[float, key("begin_s", help="Time at which the growth begins.")] = 0.0,
) -> SignalLike:
    """Gap that grows as an S-curve."""
    return SCurve(begin_value, end_value, over, begin)


GAPS: Mapping[str, Maker] = {"constant": constant_gap, "growing": growing_gap}


def gap_maker(table: Table) -> Maker:
    """Choose the kind of gap that a table describes."""
    # In whatever unit: keys of another one are refused by name.
    first = {name.split("_", 1)[0] for name in table.values}
    return GAPS["growing" if first & {"from", "to", "over", "begin"} and "total" not in first else "constant"]


def _gap(table: Table, servo: Plant) -> SignalLike:
    """Read [gap], which counts at the motor from here on."""
    inner = table.table(GAP, required=True)
    check_gaps(inner, [name for name in inner.values if unit_of(name).si in ("m", "rad")], servo)
    ends = [name for name in ("from_deg", "to_deg") if name in inner.values]
    if len(ends) == 1 and any(AT_LOAD in name for name in inner.values):
        raise inner.invalid(ends[0], "both ends of the growth at the load, or both at the motor")
    gap: SignalLike = part(table, GAP, gap_maker(inner))
    return gap


def read_parts(table: Table, folder: Path, servo: Plant) -> dict[str, Any]:
    """Read the values of a `Scenario` that depend on its servo or on one another.

    Raises
    ------
    InvalidInput
        A key is unknown or missing, or its value is not allowed.
    """
    gap = _gap(table, servo)
    inner = table.table(CONTROLLER)
    with named(inner):
        controller = _changed(inner, servo.controller)
    inner.done()
    edge = table.table(EDGE)
    edge.known(PROBE)
    probe = part(edge, PROBE, ProbeLimits) if PROBE in edge.values else None
    supervision = _supervision(edge, controller or servo.controller)
    edge.done()
    novelty = part(table, NOVELTY, NoveltyRules) if NOVELTY in table.values else None
    link = table.table(LINK)
    both: LinkSettings = read(link, LinkSettings)
    uplink, downlink = part(link, UP, LinkSettings, base=both), part(link, DOWN, LinkSettings, base=both)
    link.done()
    table.known(NOVELTY)
    return {
        "gap": gap,
        "controller": controller,
        "supervision": supervision,
        "recording": replace(_recording(table, controller or servo.controller), probe=probe, novelty=novelty),
        "uplink": uplink,
        "downlink": downlink,
        "twin": read_inner(table, TWIN, lambda inner: _twin(inner, folder, servo)),
    }


def _twin(table: Table, folder: Path, servo: Plant) -> TwinSettings:
    """Read [twin]; one that is switched off and has no policy leaves the servo its own controller."""
    twin = read_twin_settings(table, folder, servo)
    return twin if twin.enabled or "policy" in table.values else twin.replace(policy=PAPER)


def _recording(table: Table, controller: AnyController) -> Recording:
    """Read [recording]; its rate is that of a sampled controller where it gives none."""
    given = table.table(RECORDING)
    recording: Recording = read(given, Recording)
    given.done()
    rate = controller.sample_rate
    return replace(recording, sample_rate=rate) if rate and "sample_rate_hz" not in given.values else recording


def _changed(table: Table, controller: AnyController) -> AnyController | None:
    """Read the changes of the servo's controller, keys as in a servo's file; None: there are none."""
    if isinstance(controller, LinearLaw):
        return None
    changed = changes(table, type(controller))
    return made(table, type(controller), controller.replace, changed) if changed else None


def _supervision(edge: Table, controller: AnyController) -> Supervision | None:
    """Read [edge]: with it updates may set gains and the edge supervises the loop; without it they set the tolerance.

    Its table `probe` changes nothing of this.
    """
    if not edge.values.keys() - {PROBE}:
        return None

    def gains(inner: Table) -> AnyGains:
        return read_gains(inner, controller)

    with named(edge):
        return read_supervision(edge, gains)
