"""The edge runs where numpy, scipy and numba are absent."""

import subprocess
import sys
import textwrap
from pathlib import Path

import servotwin

PROGRAM = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("numpy", "scipy", "numba", "matplotlib"):
            raise ModuleNotFoundError(f"{name} is not installed here")

sys.meta_path.insert(0, Absent())

from servotwin.control import Controller, start, tick
from servotwin.edge.agent import Agent
from servotwin.edge.settings import AgentSettings
from servotwin.link.outbox import MemoryOutbox
from servotwin.link.session import Session
from servotwin.link.simulated import LinkSettings, SimulatedLink, SimulatedSender, VirtualClock
from servotwin.messages import Acknowledge, Setting, Update, decode, encode, unpack_channel

controller = Controller(Kp=1377.7, Ki=18907.6, Kd=-135.1, Tf=0.1, sample_rate=100.0)
clock, outbox, at_twin = VirtualClock(), MemoryOutbox(), []
agent = Agent(AgentSettings("axis-1", "b0", 100.0), outbox)

def to_twin(data):
    at_twin.append(decode(data))
    link.down.send(encode(Acknowledge("axis-1", "b0", 0)))
    link.down.send(encode(Update("axis-1", 1, 0, ("b0", 0), 0.0, 0.1, None, (0.0, None), "OK", Setting(1e-4), 9.0)))

def to_edge(data):
    message = decode(data)
    if isinstance(message, Acknowledge):
        sender.acknowledge((message.boot, message.sequence))
    agent.receive(message)

link = SimulatedLink("axis-1", clock, to_twin, to_edge, LinkSettings(delay_s=0.5), LinkSettings(delay_s=0.5), 0)
sender = SimulatedSender(Session(outbox), clock, link.up)
state, position = start(0.0), 0.0
for _ in range(250):
    clock.run_until(agent.time)
    state = tick(controller.law(agent.parameters.setting.tolerance), state, 1e-3, position)
    position += 1e-5 * state.voltage
    agent.absorb(1e-3, position, position, state.voltage)
    sender.plan(agent.time)
assert len(unpack_channel(at_twin[0].channel("voltage"))) == 100
assert agent.parameters.setting.tolerance == 1e-4 and agent.deadline is None
assert not {"numpy", "scipy", "numba"} & set(sys.modules)
print("controlled, recorded, sent, acknowledged, updated")
"""


def test_the_edge_runs_without_numpy() -> None:
    root = Path(servotwin.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(PROGRAM)],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.stdout.strip() == "controlled, recorded, sent, acknowledged, updated", done.stderr


def test_no_module_of_the_edge_imports_numpy_even_late() -> None:
    package = Path(servotwin.__file__).parent
    parts = ("messages", "control", "link", "edge", "runtime", "edge_process")
    files = [file for part in parts for file in (package / part).rglob("*.py")]
    assert len(files) > 10
    for file in files:
        text = file.read_text(encoding="utf-8")
        for name in ("numpy", "scipy", "numba"):
            assert f"import {name}" not in text
            assert f"from {name}" not in text


def test_the_control_process_does_without_the_connections_of_the_link() -> None:
    """They are the link process's, and would take a tenth of its memory."""
    program = (
        "import sys, servotwin.edge_process.run\n"
        "print({'ssl', 'http.client', 'sqlalchemy', 'numpy', 'servotwin.link.sqlite_outbox'} & set(sys.modules))"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout == "set()\n"
