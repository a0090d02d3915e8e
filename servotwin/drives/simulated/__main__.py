"""Run a simulated machine: `python -m servotwin.drives.simulated PLANT.toml`.

It prints one line, "ready ADDRESS", once it listens; an interrupt or SIGTERM stops it.
"""

import os
import signal
import sys
import time

from servotwin.cosim.machine import compile_ahead
from servotwin.drives.simulated.control import ControlServer
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.plants import ControlledPlant, SupervisedPlant, law_of_machine
from servotwin.drives.simulated.server import (
    OnSample,
    Server,
    StopRequest,
    address_in_use,
    ignore_sample,
    listening,
    run,
    start_pace,
)
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.drives.simulated.state_recorder import StateRecorder
from servotwin.drives.simulated.supervise import SuperviseServer
from servotwin.errors import InvalidInput


def main(path: str, stop: StopRequest) -> None:
    """Simulate the machine of a TOML file until its run is over, or `stop` is called.

    Raises
    ------
    InvalidInput
        The file is missing, or does not describe a machine.
    """
    settings = MachineSettings.load(path)
    compile_ahead(
        settings.scenario, law_of_machine(settings)
    )  # before "ready": a compilation takes seconds, and a tick would wait for it
    plant = ControlledPlant(settings) if settings.role == "control" else SupervisedPlant(settings)
    with listening(settings.address) as listener:
        pace = start_pace(settings)
        recorder = None if pace is None else StateRecorder(settings, pace, time.monotonic())
        server = _server(plant, pace, settings.slack, ignore_sample if recorder is None else recorder.update)
        print("ready", address_in_use(listener, settings.address), flush=True)
        try:
            run(server, listener, settings, os.urandom(8), stop)
        finally:
            if recorder is not None:
                recorder.write(plant.index)


def _server(plant: ControlledPlant | SupervisedPlant, pace: Pace | None, slack: float, on_sample: OnSample) -> Server:
    if isinstance(plant, ControlledPlant):
        return ControlServer(plant, pace, slack, on_sample)
    return SuperviseServer(plant, pace, on_sample)


if __name__ == "__main__":
    stop = StopRequest()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    try:
        if len(sys.argv) != 2:
            raise InvalidInput("give one file: python -m servotwin.drives.simulated PLANT.toml")
        main(sys.argv[1], stop)
    except InvalidInput as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    finally:
        stop.close()
