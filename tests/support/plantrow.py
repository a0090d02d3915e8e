"""Many simulated machines in one process: `python plantrow.py LOG PLANT.toml ...`; says "ready ADDRESS ..." once.

Of each machine that an edge controls it logs every connection: which samples were exchanged, and how many in between
the edge missed.
"""

import json
import os
import signal
import socket
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

from servotwin.cosim.machine import compile_ahead
from servotwin.drives.simulated.control import ControlServer
from servotwin.drives.simulated.plants import ControlledPlant, SupervisedPlant
from servotwin.drives.simulated.server import Server, address_in_use, listening, run, start_pace
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.drives.simulated.supervise import SuperviseServer

WATCHED: list["Watched"] = []


class Watched(ControlServer):
    """Logs connections."""

    def __init__(self, settings: MachineSettings, log: Path) -> None:
        self.plant = ControlledPlant(settings)
        super().__init__(self.plant, start_pace(settings), settings.slack)
        self._servo, self._log, self._first, self._missed = settings.scenario.name, log, -1, 0
        WATCHED.append(self)

    def serve(self, connection: socket.socket) -> None:
        self._first, self._missed = self.plant.index, 0
        try:
            super().serve(connection)
        finally:
            self.note()

    def note(self) -> None:
        """Log the connection, if there is one."""
        first, self._first = self._first, -1
        if first >= 0:
            line = {"servo": self._servo, "first": first, "last": self.plant.index, "missed": self._missed}
            with self._log.open("a") as file:
                file.write(json.dumps(line) + "\n")

    def _miss(self, connection: socket.socket) -> bytes:
        before = self.plant.index
        try:
            return super()._miss(connection)
        finally:
            self._missed += self.plant.index - before


def server_of(settings: MachineSettings, log: Path) -> Server:
    if settings.role == "control":
        return Watched(settings, log)
    return SuperviseServer(SupervisedPlant(settings), start_pace(settings))


def main(log: Path, paths: list[str]) -> None:
    rows = [MachineSettings.load(path) for path in paths]
    compile_ahead(rows[0].scenario)
    with ExitStack() as stack:
        listeners = [stack.enter_context(listening(each.address)) for each in rows]
        addresses = [address_in_use(*each) for each in zip(listeners, (row.address for row in rows), strict=True)]
        for listener, settings in zip(listeners, rows, strict=True):
            of_machine = (server_of(settings, log), listener, settings, os.urandom(8))
            threading.Thread(target=run, args=of_machine, daemon=True).start()
        print("ready", *addresses, flush=True)
        signal.pause()


def ended(*_: object) -> None:
    for each in WATCHED:
        each.note()
    os._exit(0)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, ended)
    main(Path(sys.argv[1]), sys.argv[2:])
