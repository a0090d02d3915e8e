"""The journey page: its rows are the files through which a window really passes."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType

import pytest
from few_machines import certified_scenario

from servotwin.cosim import Cosimulation, SimulatedMachine

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^\| ([C ]) \| ([D ]) \| `(servotwin/[\w/]+\.py)` \|", re.MULTILINE)
PAGE = (ROOT / "docs/journey.md").read_text()

ENTRIES = {
    "simulation/simulate.py": ("simulation", "plant", "hybrid"),
    "estimation/whitened/offset.py": ("estimation/whitened", "estimation/core", "estimation/paper"),
    "estimation/learning/wear.py": ("estimation/learning",),
    "redesign/certified/policy.py": ("redesign", "analysis"),
}
"""One hop each: the file that is called, and the folders of what it calls."""
NOT_COUNTED = {
    "types and checks": (
        "messages/checks.py", "messages/setting.py", "estimation/window.py", "estimation/estimate.py",
        "edge/parameters.py", "control/gains.py", "control/retuning.py",
    ),
    "settings": ("config/", "control/controller.py", "control/laws.py", "edge/settings.py"),
    "plumbing": ("runtime/retry.py",),
    "beside the way": (
        "edge/watch.py", "estimation/commanded_angle.py", "estimation/controller.py", "estimation/first_states.py",
        "estimation/late_window.py", "estimation/motors_position.py",
        "twin/responses.py", "twin/lookups.py", "twin/requests.py",
        "twin/asking.py", "twin/in_force.py", "twin/untold_ratio.py",
    ),
}  # fmt: skip
COMPILED = {"control/law.py"}
"""On the page, though it runs compiled in a simulation."""


def test_the_numbers_in_the_text_are_the_rows_of_the_tables():
    """And no file is counted twice."""
    rows = ROW.findall(PAGE)
    assert len({file for *_, file in rows}) == len(rows)
    counts = sum(row[0] == "C" for row in rows), sum(row[1] == "D" for row in rows)
    stated = re.search(r"takes (\d+) hops in the co-simulation and (\d+) hops when deployed", PAGE)
    assert stated is not None
    assert tuple(map(int, stated.groups())) == counts


def files_run(act: Callable[[], None]) -> set[str]:
    """Files of the package of which a function was called meanwhile."""
    seen: set[CodeType] = set()

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call":
            seen.add(frame.f_code)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        act()
    finally:
        sys.setprofile(before)
    package = f"{ROOT}/servotwin/"
    names = {code.co_filename for code in seen if code.co_name not in ("<module>", "<lambda>")}
    return {name.removeprefix(package) for name in names if name.startswith(package)}


def hop_of(file: str) -> str:
    """The row that stands for a file."""
    return next((entry for entry, folders in ENTRIES.items() if file.startswith(tuple(f"{f}/" for f in folders))), file)


@pytest.mark.slow
def test_the_rows_of_the_co_simulation_are_the_files_that_run():
    scenario = certified_scenario(25.0)
    loop = Cosimulation(scenario, SimulatedMachine(scenario))

    def run() -> None:
        while not loop.done:
            loop.advance()

    files = files_run(run)
    assert loop.loop(loop.machine.run()).applied
    ignored = tuple(name for names in NOT_COUNTED.values() for name in names)
    passed = {hop_of(file) for file in files if not file.startswith(ignored)}
    rows = {file.removeprefix("servotwin/") for co_simulated, _, file in ROW.findall(PAGE) if co_simulated == "C"}
    assert passed - rows == set()
    assert rows - passed <= COMPILED
