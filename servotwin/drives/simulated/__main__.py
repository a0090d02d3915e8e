"""Run a simulated machine: `python -m servotwin.drives.simulated PLANT.toml`.

When it listens it says so in one line, "ready ADDRESS"; an interrupt or SIGTERM ends it.
"""

import os
import signal
import sys
import time

from servotwin.cosim.machine import compile_ahead
from servotwin.drives.simulated.control import ControlServer
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.plants import ControlledPlant, SupervisedPlant
from servotwin.drives.simulated.server import Ending, Server, Tend, address_in_use, listening, run, start_pace, untended
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.drives.simulated.state_recorder import StateRecorder
from servotwin.drives.simulated.supervise import SuperviseServer
from servotwin.errors import InvalidInput


def main(path: str, ending: Ending) -> None:
    """Simulate the machine of a TOML file until its run is over, or `ending` is called.

    Raises
    ------
    InvalidInput
        The file is not one.
    """
    settings = MachineSettings.load(path)
    compile_ahead(settings.scenario)
    plant = ControlledPlant(settings) if settings.role == "control" else SupervisedPlant(settings)
    with listening(settings.address) as listener:
        pace = start_pace(settings)
        recorder = None if pace is None else StateRecorder(settings, pace, time.monotonic())
        server = _server(plant, pace, settings.slack, untended if recorder is None else recorder.update)
        print("ready", address_in_use(listener, settings.address), flush=True)
        try:
            run(server, listener, settings, os.urandom(8), ending)
        finally:
            if recorder is not None:
                recorder.write(plant.index)


def _server(plant: ControlledPlant | SupervisedPlant, pace: Pace | None, slack: float, tend: Tend) -> Server:
    if isinstance(plant, ControlledPlant):
        return ControlServer(plant, pace, slack, tend)
    return SuperviseServer(plant, pace, tend)


if __name__ == "__main__":
    asked = Ending()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, asked)
    try:
        if len(sys.argv) != 2:
            raise InvalidInput("give one file: python -m servotwin.drives.simulated PLANT.toml")
        main(sys.argv[1], asked)
    except InvalidInput as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    finally:
        asked.close()
