"""`servotwin bench certificates`: certified settings on machines that no verification has seen, in all presets.

Shares that settle and peaks of the sensitivity, on machines and plants that are drawn anew from the same ranges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.decisions import KNOWN_BIAS, LEARNT, NARROW, UNKNOWN_BIAS, WHOLE, WIDE
from servotwin.control.controller import Controller
from servotwin.control.retuning import law_for_margins, without_integral
from servotwin.plant.loop_set import PlantSet
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.certificate import NotVerified
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.margins import widened
from servotwin.redesign.certified.settling_test import share_at_least
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Range, Uncertainty

NAME, SCHEMA = "certificates", "servotwin-bench-certificates/1"
PRESETS, RATE = ("paper", "table1", "paper-gain2"), 1000.0
MACHINES, QUICK, SEED = 2048, 32, 20261123
_PLANTS_SHARE = 4  # machines to one plant of the sensitivity peaks
FRICTION: Range = (0.4, 1.0)
"""Share of the torque that 0.05 V stalls."""
_FRICTION_V = 0.05


class CertificateRow(NamedTuple):
    """One certified setting on fresh machines.

    Attributes
    ----------
    preset, question : str
    rate : float or None
        Hz; None: in continuous time.
    refused : str
        Reason for which nothing was verified; empty, where a setting was.
    machines, settled : int
        Fresh machines, and those that settled.
    least : float
        Lower bound of the share that settles, 95 % confidence.
    tail : float
        m, largest error in the end.
    plants : int
        Fresh plants of the stated ranges and beyond, each with every delay of them.
    Ms, Ms_certified : float
        Largest peak on these, and that of the certificate.
    """

    preset: str
    question: str
    rate: float | None
    refused: str
    machines: int = 0
    settled: int = 0
    least: float = math.nan
    tail: float = math.nan
    plants: int = 0
    Ms: float = math.nan
    Ms_certified: float = math.nan


def certificates(
    date: str = "",
    output: Path | None = None,
    count: int = MACHINES,
    console: Console | None = None,
    presets: Sequence[str] = PRESETS,
    seed: int = SEED,
) -> tuple[CertificateRow, ...]:
    """Certify settings and simulate each on fresh machines; print, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    count : int
        Fresh machines of each setting; of its plants a quarter as many.
    console : Console, optional
    presets : sequence of str
    seed : int

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    rows: list[CertificateRow] = []
    for preset in presets:
        for rate in (None, RATE):
            servo = Servo.preset(preset)
            servo = servo.replace(controller=servo.controller.replace(sample_rate=rate))
            several = [
                _row(preset, servo, name, known, count, seed + place)
                for place, (name, known) in enumerate(questions(servo).items())
            ]
            console.print(shown(several))
            rows += several
    report.write(output, report.text(SCHEMA, date, rows=[row._asdict() for row in rows]), console)
    return tuple(rows)


def questions(servo: Servo) -> Mapping[str, Uncertainty]:
    """Ranges of a servo for which a setting is asked."""
    narrow = _known(NARROW, KNOWN_BIAS)
    torque = _FRICTION_V * servo.k_T / servo.R
    return {
        "fallback set": _known(WHOLE, UNKNOWN_BIAS),
        "gap of 10 deg": narrow,
        "gap of 40 deg": _known(WIDE, KNOWN_BIAS),
        "bias not known": _known(NARROW, UNKNOWN_BIAS),
        "friction": narrow.replace(friction=(FRICTION[0] * torque, FRICTION[1] * torque)),
        "learnt machine": narrow.replace(learnt=LEARNT),
    }


def _known(gap_deg: Range, bias: Range) -> Uncertainty:
    return Uncertainty(gap=(math.radians(gap_deg[0]), math.radians(gap_deg[1])), input_bias=bias)


def _row(preset: str, servo: Servo, name: str, known: Uncertainty, count: int, seed: int) -> CertificateRow:
    rate, demands = servo.controller.sample_rate, Demands()
    found = certify(servo, known, demands)
    if isinstance(found, NotVerified):
        return CertificateRow(preset, name, rate, found.reason)
    members = draw_independently(servo, known, count, seed)
    (measures,) = assess([found.setting], members, trial_for(servo, known, demands))
    settled, plants = int(measures.settled.sum()), max(1, count // _PLANTS_SHARE)
    assert found.loop is not None
    return CertificateRow(
        preset,
        name,
        rate,
        "",
        count,
        settled,
        share_at_least(settled, count, demands.confidence),
        float(measures.tail.max()),
        plants,
        worst_peak(servo, widened(known, demands), found.setting.pid, plants, seed),
        found.loop.Ms_worst,
    )


def worst_peak(servo: Servo, known: Uncertainty, law: Controller, count: int, seed: int) -> float:
    """Largest Ms of a law, its integral acting and stopped, on fresh plants with every delay; inf: unstable."""
    laws = [law_for_margins(law)]
    if law.integral_only:
        laws.append(without_integral(laws[0]))
    fresh = draw_independently(servo, known, count, seed)
    plants = PlantSet.of([plant.plant() for plant in fresh.plants], law.sample_rate)
    delays = range(1 if law.sample_rate is None else known.delay + 1)
    return max(float(plants.margins(each, delay).Ms.max()) for each in laws for delay in delays)


def shown(rows: Sequence[CertificateRow]) -> Table:
    """A line for each question."""
    law = "in continuous time" if rows[0].rate is None else f"at {rows[0].rate:g} Hz"
    table = Table(title=f"{rows[0].preset}, {law}", title_justify="left", box=None, pad_edge=False)
    table.add_column("ranges")
    for heading in ("settled", "of", "at least\n%", "tail max\num", "Ms\nfresh", "Ms\ncertified"):
        table.add_column(heading, justify="right")
    for row in rows:
        numbers = (row.settled, row.machines, f"{100.0 * row.least:.2f}", f"{1e6 * row.tail:.1f}")
        peaks = (f"{row.Ms:.3f}", f"{row.Ms_certified:.3f}")
        table.add_row(row.question, *(map(str, (*numbers, *peaks)) if not row.refused else (row.refused,)))
    return table
