"""A Dask scheduler and two worker processes, as an operator would start them."""

import json
import subprocess
import sys
import time


class Cluster:
    """A context: gives the address and the scheduler's process, kills all at its end."""

    def __init__(self, folder):
        self.folder, self.file, self.processes = folder, folder / "scheduler.json", []

    def __enter__(self):
        scheduler = self.start("scheduler", "--port", "0")
        while not (self.file.exists() and self.file.read_text().endswith("}")):
            assert scheduler.poll() is None
            time.sleep(0.05)
        for _ in range(2):
            # Without a nanny, a process more that would restart it.
            self.start("worker", "--nworkers", "1", "--nthreads", "1", "--no-nanny")
        self.wait_for_workers(2)
        return json.loads(self.file.read_text())["address"], scheduler

    def start(self, kind, *options):
        common = ("--scheduler-file", self.file, "--host", "127.0.0.1", "--no-dashboard")
        command = [sys.executable, "-m", "dask", kind, *map(str, (*common, *options))]
        with (self.folder / f"{kind}.log").open("a") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)
        self.processes.append(process)
        return process

    def wait_for_workers(self, number):
        while (self.folder / "worker.log").read_text().count("Registered to:") < number:
            assert all(process.poll() is None for process in self.processes)
            time.sleep(0.05)

    def __exit__(self, *_):
        for process in reversed(self.processes):
            process.kill()
            process.wait(timeout=30)
