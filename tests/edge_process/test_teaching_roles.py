"""A deployed edge, in both roles, makes moves of different lengths, and its window shows them."""

from array import array
from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import pytest
from edge_process_parts import CONFIG, RATE, LinkEnd, exchange_all

from servotwin.edge.drive import Block, DriveSample
from servotwin.edge_process import frames
from servotwin.edge_process.control import ControlRole
from servotwin.edge_process.edge import EdgeRuntime
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.supervise import SupervisingRole
from servotwin.messages import Probe, Request, encode

RESTS, HOLD = 1e-3, 4
PLACES = (0.4, 0.0, 1.0, 0.6, 1.0, 0.0)
ASKED = Probe(5e-4, HOLD / RATE, 1, PLACES)


class FollowingDrive:
    """A machine at rest, whose reference is moved by what the edge writes."""

    machine, lag, can_move, patient, rate = "m", 0.0, True, False, RATE

    def __init__(self, blocks: bool) -> None:
        self.blocks, self.next, self.offset = blocks, 0, 0.0

    def connect(self) -> None:
        """Nothing to connect."""

    def close(self) -> None:
        """Nothing is open."""

    def read(self, most: int = 0) -> DriveSample | Block:
        first, size = self.next, most if self.blocks else 1
        self.next += size
        if not self.blocks:
            return DriveSample(first, RESTS, 0.0, 0.0)
        zeros = array("d", [0.0] * size)
        return Block(first, 0, array("d", [RESTS + self.offset] * size), zeros, zeros, zeros)

    def write(self, value: object) -> None:
        """Neither voltage nor parameters change anything."""

    def move(self, offset: float) -> None:
        self.offset = offset


class NoChild:
    def check(self, now: float) -> None:
        """No link process."""


@pytest.fixture
def far() -> Iterator[LinkEnd]:
    made = LinkEnd()
    yield made
    made.close()


@pytest.mark.parametrize("supervises", [False, True])
def test_the_window_of_a_teaching_move_holds_every_place(far: LinkEnd, supervises: bool) -> None:
    box, drive = PipeOutlet(True), FollowingDrive(supervises)
    box.connect(far.near)
    agent = replace(CONFIG.agent, reference=RESTS, longest_window_s=0.5)
    config, seconds = replace(CONFIG, agent=agent, role="supervise" if supervises else "control"), count()
    edge = EdgeRuntime(config, "b0", box, NoChild(), None, lambda: 1e-4 * next(seconds), lambda _: None)
    role = SupervisingRole(edge, drive) if supervises else ControlRole(edge, drive)
    while drive.next < 20:
        role.step()
    far.send(frames.MessageFrame(1, encode(Request("axis-1", "b0", 1, ASKED, 1e6))))
    while drive.next < 80:
        role.step()
    exchange_all(box)
    (cut,) = [frame.cut for frame in far.received() if isinstance(frame, frames.WindowFrame)]
    assert cut.reason == "teaching"
    places = [RESTS + share * ASKED.size for share in PLACES for _ in range(HOLD)]
    assert list(cut.signals["reference"]) == pytest.approx(places)
