"""An edge process without a process: its drive has scripted samples, and its time passes when somebody waits."""

from edge_process_parts import CONFIG, RATE

from servotwin.edge.drive import Block, DriveRefused, DriveSample
from servotwin.edge.parameters import Parameters
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.edge import EdgeRuntime
from servotwin.edge_process.outlet import PipeOutlet


class ScriptedDrive:
    """A drive of both roles, with scripted samples; it records what is written to it."""

    machine, lag, can_move, patient, rate = "m", 0.0, True, False, RATE

    def __init__(self, given: list[DriveSample | Block | Exception | None]) -> None:
        self.given, self.voltages, self.log = given, [], []
        self.connects = 0
        self.refuse = False

    def connect(self) -> None:
        self.connects += 1

    def close(self) -> None:
        """Nothing is open."""

    def read(self, most: int = 0) -> DriveSample | Block | None:
        self.log.append(most)
        found = self.given.pop(0)
        if isinstance(found, Exception):
            raise found
        return found

    def write(self, value: float | Parameters) -> None:
        if self.refuse and isinstance(value, Parameters):
            raise DriveRefused("no")
        self.voltages.append(value)

    def move(self, offset: float) -> None:
        self.log.append(f"move {offset}")


class Clock:
    """Time that only passes when somebody waits."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1e-4
        return self.now

    def pause(self, seconds: float) -> None:
        self.now += seconds


class NoChild:
    def check(self, now: float) -> None:
        """No link process."""


def edge_of(box: PipeOutlet, config: EdgeConfig = CONFIG) -> EdgeRuntime:
    clock = Clock()
    return EdgeRuntime(config, "b0", box, NoChild(), None, clock, clock.pause)


def samples(first: int, count: int, reference: float = 1e-3) -> list[DriveSample]:
    return [DriveSample(k, reference, 0.0, 0.0) for k in range(first, first + count)]
