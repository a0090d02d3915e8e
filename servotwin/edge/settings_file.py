"""Tables of an edge whose gains depend on the controller that runs: what it starts with and falls back to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from servotwin.config.keys import key
from servotwin.config.table import Table
from servotwin.config.toml import Values, read, values_of
from servotwin.control.gains import written_gains
from servotwin.control.laws import AnyController
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.settings import Supervision
from servotwin.messages import AnyGains, Band, Setting

GainsReader = Callable[[Table], AnyGains | None]
"""Reads the gains that a table gives, with those of the running controller for the others; None: gains stay."""


def band_table(
    error: Annotated[float, key("error_mm", "error_m", minimum=0.0, help="Largest tracking error.")],
    error_rms: Annotated[float, key("error_rms_mm", "error_rms_m", minimum=0.0, help="Its root mean square.")],
    effort: Annotated[float, key("effort_v", minimum=0.0, help="Root mean square of the voltage.")],
    settling: Annotated[
        float, key("settling_s", minimum=0.0, help="Time after a change of the reference from which on the band holds.")
    ],
) -> Band:
    """Band that the loop is predicted to stay within while its reference rests."""
    return Band(error, error_rms, effort, settling)


def setting_table(
    gains: AnyGains | None = None,
    tolerance: Annotated[
        float, key("tolerance_mm", "tolerance_m", minimum=0.0, help="Half-width of the dead zone; 0: none.")
    ] = 0.0,
    band: Annotated[
        Band | None,
        key(
            makers={"": band_table},
            dump=lambda band: values_of(band, band_table),
            help="Band that the loop is predicted to stay within while its reference rests.",
        ),
    ] = None,
) -> Setting:
    """Dead zone, gains and band."""
    return Setting.of(tolerance, gains, band)


def gains_stay_table(
    gains_stay: Annotated[bool | None, key(help="Leave the gains as they are; true where updates set none.")] = None,
) -> bool | None:
    """Return True where a table leaves the gains as they are; None: it does not say."""
    return gains_stay


def start_table(
    setting: Setting,
    fallback: Annotated[bool, key(help="This is the fallback set.")] = False,
) -> Parameters:
    """Parameters in force before the first update."""
    return Parameters(setting=setting, fallback=fallback)


def read_start(table: Table, gains: GainsReader) -> Parameters:
    """[start]: the parameters in force before the first update."""
    parameters: Parameters = read(table, start_table, setting=read(table, setting_table, gains=gains(table)))
    return parameters


def read_supervision(table: Table, gains: GainsReader) -> Supervision:
    """Supervision: with a table `fallback` the edge falls back, with `watched = false` on silence only."""
    table.known("fallback")
    fallback = _read_fallback(table.table("fallback"), gains) if "fallback" in table.values else None
    supervision: Supervision = read(table, Supervision, fallback=fallback)
    return supervision


def _read_fallback(table: Table, gains: GainsReader) -> FallbackSet:
    fallback: FallbackSet = read(table, FallbackSet, setting=read(table, setting_table, gains=gains(table)))
    table.done()
    return fallback


def start_values(parameters: Parameters, running: AnyController | None = None) -> Values:
    """Keys and values of [start]."""
    return {**_setting_values(parameters.setting, running), **values_of(parameters, start_table)}


def supervision_values(supervision: Supervision, running: AnyController | None = None) -> Values:
    """Keys and values of [supervision]."""
    fallback = supervision.fallback
    if fallback is None:
        return values_of(supervision)
    stay: Values = {"gains_stay": True} if fallback.setting.gains is None else {}
    return {
        **values_of(supervision),
        "fallback": {**_setting_values(fallback.setting, running), **stay, **values_of(fallback)},
    }


def _setting_values(setting: Setting, running: AnyController | None) -> Values:
    gains = {} if setting.gains is None else written_gains(setting.gains, running)
    return {**values_of(setting, setting_table), **gains}
