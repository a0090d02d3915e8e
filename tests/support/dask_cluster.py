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
            self.start("worker", "--nworkers", "1", "--nthreads", "1")
        address = json.loads(self.file.read_text())["address"]
        self.wait_for_workers(address)
        return address, scheduler

    def start(self, kind, *options):
        common = ("--scheduler-file", self.file, "--host", "127.0.0.1", "--no-dashboard")
        command = [sys.executable, "-m", "dask", kind, *map(str, (*common, *options))]
        with (self.folder / f"{kind}.log").open("a") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)
        self.processes.append(process)
        return process

    def wait_for_workers(self, address):
        program = f"import distributed as d; d.Client({address!r}, timeout=30).wait_for_workers(2, timeout=60)"
        subprocess.run([sys.executable, "-c", program], check=True, timeout=120, stderr=subprocess.DEVNULL)

    def __exit__(self, *_):
        for process in reversed(self.processes):
            process.kill()
            process.wait(timeout=30)
