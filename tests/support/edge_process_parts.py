"""Configuration of an edge process for tests, and the link process's end of its pipe."""

import socket
from array import array

from servotwin.control.controller import Controller
from servotwin.edge.guard import Limits
from servotwin.edge.outlet import CHANNELS
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.recorder import Cut
from servotwin.edge.settings import AgentSettings
from servotwin.edge_process import frames
from servotwin.edge_process.config import UNBOOTED, EdgeConfig
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.runtime.frames import FrameSocket

RATE = 100.0
LAW = Controller(200.0, 0.0, 0.0, 0.1, voltage_limit=10.0, sample_rate=RATE)
SETTINGS = AgentSettings("axis-1", UNBOOTED, RATE, 0.1, limits=Limits(maximum=1e-3), probe=ProbeLimits(1e-3, 0.0, 0.05))
CONFIG = EdgeConfig(SETTINGS, "control", LAW, {"kind": "simulated"})

EDGE = """
servo = "ax-1"
role = "supervise"
sample_rate_hz = 100.0
[drive]
kind = "simulated"
address = "unix:nothing.sock"
[retry]
first_s = 0.05
longest_s = 0.1
[twin]
url = "{url}"
token_file = "token"
wait_s = 0.2
"""
"""An edge's configuration file; `url` is to be filled in."""


def cut(sequence: int = 0, samples: int = 10) -> Cut:
    signals = {name: array("d", [1e-3 * k for k in range(samples)]) for name in CHANNELS}
    return Cut(7, sequence, "reference", 3, 0.0, signals, 0.1, None)


class LinkEnd:
    """The link process's end of an outlet, driven by the test."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self.pipe = FrameSocket(theirs)
        self.near = FrameSocket(ours)

    def received(self) -> list[frames.ToLink]:
        return [frames.to_link(data) for data in self.pipe.receive()]

    def send(self, *sent: frames.ToControl) -> None:
        for frame in sent:
            self.pipe.post(frames.encode(frame))
        while self.pipe.backlog:
            self.pipe.send()

    def close(self) -> None:
        self.pipe.close()
        self.near.close()


def exchange_all(box: PipeOutlet) -> None:
    for _ in range(20):
        box.exchange()
