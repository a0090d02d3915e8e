"""A twin's service for the browser's tests, and what they look for on its pages."""

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
from service_system import process

PICTURES = Path(__file__).parents[2] / "build" / "screenshots"
AXE = (Path(__file__).parents[1] / "data" / "axe" / "axe.min.js").read_text(encoding="utf-8")
OTHERS = 1000
WAIT_MS = 30_000
LARGEST_SHIFT = 0.01
"""Cumulative layout shift that nobody notices; 0.1 counts as good on the web."""
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

    @contextlib.contextmanager
    def away(self) -> Iterator[None]:
        """Killed within the block, and there again after it, also where the block fails."""
        self.kill()
        try:
            yield
        finally:
            self.start(self.url.rpartition(":")[2])


WATCH_SHIFTS = """new PerformanceObserver((list) => {
    const part = (node) => `${node?.nodeName}.${node?.getAttribute?.("class") ?? ""}`;
    const place = (rect) => [rect.x, rect.y, rect.width, rect.height].map(Math.round);
    for (const entry of list.getEntries()) if (!entry.hadRecentInput && !window.resized) noteShift([
        performance.timeOrigin, entry.startTime, entry.value,
        entry.sources.map((each) => [part(each.node), place(each.previousRect), place(each.currentRect)])]);
}).observe({ type: "layout-shift", buffered: true })"""
"""Tells each shift without an input or a resize: load of the page (ms), time since then (ms), size, what moved."""


def layout_shift(shifts):
    """Largest cumulative layout shift of a page: that of the bursts with pauses under 1 s and of 5 s at most."""
    largest, burst = 0.0, []
    for origin, time_, size, _ in sorted(shifts, key=lambda each: each[:2]):
        alone = not burst or origin != burst[0][0] or time_ - burst[-1][1] > 1000.0 or time_ - burst[0][1] > 5000.0
        burst = [*([] if alone else burst), (origin, time_, size)]
        largest = max(largest, sum(each[2] for each in burst))
    return largest


def has_text(page, selector, text):
    page.locator(selector, has_text=text).first.wait_for()


def open_machine(page, name):
    page.evaluate("name => { location.hash = '#/machine/' + name }", name)
    page.wait_for_selector(".facts")


SETTLED = """new Promise((settled) => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(
    () => setTimeout(settled))), 250))"""
"""Fulfilled when plots have followed a new width and what they moved has been told, also on a busy machine."""


@contextlib.contextmanager
def resizing(page):
    """What moves within the block moves with the window, also where the browser is slow to follow: no layout shift."""
    page.evaluate("window.resized = true")
    yield
    page.evaluate(SETTLED)
    page.evaluate("window.resized = false")


def resize(page, width, height):
    with resizing(page):
        page.set_viewport_size({"width": width, "height": height})


def looks(page):
    """Show a page at three widths in both themes; say which, and its width. In the end it is what it was."""
    before = page.viewport_size
    with resizing(page):
        for name, width, height in (("desk", 1280, 900), ("phone", 360, 740), ("wall", 3840, 2160)):
            page.set_viewport_size({"width": width, "height": height})
            page.evaluate("scrollTo(0, 0)")
            page.evaluate(SETTLED)
            for theme in ("dark", "light"):
                page.emulate_media(color_scheme=theme)
                yield f"{theme}-{name}", width
        page.set_viewport_size(before)


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
