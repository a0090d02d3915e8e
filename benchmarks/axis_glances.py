"""Glances at windows of the axis presets: how often one is enough where nothing moved, and where the gap did.

Each machine differs from its model, and has one gap for all of its windows, under the preset's own controller. After
the first estimate that counts, each later window is glanced at as if the gap estimated before had been another.

``python -m benchmarks.batch axes-triage --seed 5 --count 10 FILE``; the blocks are the presets.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec import structs
from rich.console import Console
from rich.table import Table

from benchmarks.axis_presets import with_twin
from benchmarks.batch import Batch
from benchmarks.preset_machines import DUTIES, WORN, PresetMachine, preset_machines
from servotwin.errors import InvalidInput
from servotwin.messages import WindowMessage
from servotwin.twin.estimating import decode_window
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TriageSettings
from servotwin.twin.twin import Twin

NAME = "axes-triage"
MOVED = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Shares of the gap, or of a count where that is more."""
_STEPS = 24


def measured(machine: PresetMachine) -> dict[str, Any]:
    """Numbers of a machine: windows, estimates of its twin with triage, and decisions on gaps that moved."""
    try:
        loop = with_twin(machine)
        twin = Twin("axis", TwinModel.of(machine.model, machine.scenario().twin.replace(triage=TriageSettings())))
    except InvalidInput as error:
        return {"refused": str(error)}
    gap = float(machine.gap.value(0.0))
    decided: list[list[float]] = [[] for _ in MOVED]
    spared: list[float] = []
    times: dict[str, list[float]] = {"glance": [], "estimate": []}
    for window in loop.windows:
        message = structs.replace(window, servo="axis")
        for place, share in enumerate(MOVED):
            decided[place] += _seen(twin, message, max(share * gap, machine.count) if share else 0.0)
        begin, known = time.process_time(), len(twin.log.estimates)
        twin.receive(message, message.start + message.samples / message.rate)
        estimated = len(twin.log.estimates) > known
        times["estimate" if estimated else "glance"].append(time.process_time() - begin)
        if not estimated:
            last = next(reversed(twin.log.glances.values()))
            spared.append(abs(last.gap - gap) / max(0.01 * gap, 2.0 * machine.count))
    return {"windows": len(loop.windows), "spared": spared, "decided": decided, "times": times}


def _seen(twin: Twin, message: WindowMessage, moved: float) -> Iterator[float]:
    """1.0 where a window would be estimated, the gap having moved by so much (rad) to either side; none where it would
    be in any case."""
    model, state = twin.model, twin.model.restored(twin.servo, twin.state())
    if model.triage is None or state.triage is None or state.triage.doubt:
        return
    trend, machine = twin.trend, state.wear.known_machine(model.settings.learning, message.middle)
    for side in (1.0, -1.0):
        gap = state.triage.gap + side * moved
        if gap > 0.0:
            half = tuple(one * gap / state.triage.gap for one in state.triage.unknowns[:1])
            before = structs.replace(state.triage, gap=gap, unknowns=(*half, *state.triage.unknowns[1:]))
            seen = model.triage.glance(before, message, decode_window(message), trend, False, machine)[1]
            yield float(seen is None or seen.moved)


def _units(names: Sequence[str], count: int, seed: int) -> Iterator[tuple[str, PresetMachine]]:
    """Machines of all presets by turns, each with a gap of its own, from the healthy one on."""
    random = np.random.default_rng(seed)
    drawn = {name: preset_machines(name, count, seed) for name in names}
    for place in range(count):
        worn = float(random.uniform(1.0, WORN))
        for name, machines in drawn.items():
            yield f"{seed}/{name}/{place}", replace(machines[place], worn=(worn, worn), steps=_STEPS)


def _show(found: Mapping[str, Any], console: Console) -> None:
    """A line for each preset."""
    result = Table(title="axes-triage: one gap per machine", title_justify="left", box=None)
    result.add_column("preset")
    heads = [f"moved\n{100.0 * share:g} %" for share in MOVED]
    for heading in ("machines", "windows", "spared\n%", "worst\nspared", *heads, "glance\nms", "estimate\nms"):
        result.add_column(heading, justify="right")
    for name in DUTIES:
        ran = [numbers for key, numbers in found.items() if key.split("/")[1] == name]
        if notes := sorted({each["refused"] for each in ran if "refused" in each}):
            console.print(f"{name}: {notes[0]}", markup=False, highlight=False)
        elif ran:
            result.add_row(name, str(len(ran)), *_line(ran))
    console.print(result)


def _line(ran: Sequence[Mapping[str, Any]]) -> list[str]:
    windows, spared = sum(each["windows"] for each in ran), [one for each in ran for one in each["spared"]]
    decided = [[one for each in ran for one in each["decided"][place]] for place in range(len(MOVED))]
    times = [[one for each in ran for one in each["times"][kind]] for kind in ("glance", "estimate")]
    return [
        str(windows),
        f"{100.0 * len(spared) / windows:.1f}",
        f"{max(spared, default=0.0):.2g}",
        *(f"{100.0 * float(np.mean(each)):.1f}" if each else "-" for each in decided),
        *(f"{1e3 * float(np.median(each)):.3g}" if each else "-" for each in times),
    ]


BATCH = Batch(_units, measured, _show, tuple(DUTIES))
"""For `benchmarks.batch`."""
