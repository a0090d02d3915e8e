"""A twin's service for the browser's tests, and what they look for on its pages."""

import os
import signal
import time
from pathlib import Path

import httpx
from service_system import process

PICTURES = Path(__file__).parents[2] / "build" / "screenshots"
AXE = (Path(__file__).parents[1] / "data" / "axe" / "axe.min.js").read_text(encoding="utf-8")
OTHERS = 1000
WAIT_MS = 30_000
MARKUP = '<img src=x onerror="window.hacked=1"><script>window.hacked=1</script>'


class Twin:
    """A twin's service that can be killed and started again on its port."""

    def __init__(self, path: Path) -> None:
        self.path, self._entered = path, None
        self.start("0")

    def start(self, port: str) -> None:
        self._entered = process(self.path, "--port", port)
        self._process, self.url = self._entered.__enter__()

    def kill(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._entered.__exit__(None, None, None)

    def restart(self) -> None:
        self.start(self.url.rpartition(":")[2])


def has_text(page, selector, text):
    page.locator(selector, has_text=text).first.wait_for()


def open_machine(page, name):
    page.evaluate("name => { location.hash = '#/machine/' + name }", name)
    page.wait_for_selector(".facts")


def serious_faults(page):
    page.evaluate(AXE)
    found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    faults = [each for each in found["violations"] if each["impact"] in ("serious", "critical")]
    return [(each["id"], [node["html"][:120] for node in each["nodes"][:3]]) for each in faults]


def watchers(twin):
    text = httpx.get(f"{twin.url}/metrics").text
    return next(int(float(line.split()[1])) for line in text.splitlines() if line.startswith("servotwin_watchers "))


def reaches(look, wanted):
    end = time.monotonic() + WAIT_MS / 1000
    while look() != wanted:
        assert time.monotonic() < end
        time.sleep(0.1)
