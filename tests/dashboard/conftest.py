"""A twin with a thousand machines, Debian's Chromium, and pages in it."""

import time

import pytest
from browser_pages import LARGEST_SHIFT, OTHERS, WAIT_MS, WATCH_SHIFTS, Twin, layout_shift
from dashboard_fleet import wearing_fleet
from servers import needed
from service_system import OPERATOR


@pytest.fixture(scope="package")
def twin(tmp_path_factory):
    running = Twin(wearing_fleet(tmp_path_factory.mktemp("twin"), time.time(), OTHERS))
    yield running
    running.kill()


# Not longer than a file: playwright keeps an event loop running in this thread, and other tests run their own.
@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is in the extra dev")
    with sync_api.sync_playwright() as engine:
        # Root, as in containers, has no sandbox.
        opened = engine.chromium.launch(executable_path=needed("chromium"), args=["--no-sandbox", "--disable-gpu"])
        yield opened
        opened.close()


@pytest.fixture
def open_page(browser, twin):
    """Opens pages; in the end no script failed, nothing moved, and nothing was executed that came as a name."""
    contexts, faults, shifts = [], [], []

    def opened(login=OPERATOR, width=1280, height=900, expected=()):
        context = browser.new_context(viewport={"width": width, "height": height})
        context.set_default_timeout(WAIT_MS)
        contexts.append(context)
        moved = []
        shifts.append(moved)
        context.expose_function("noteShift", lambda shift: moved.append(shift))
        context.add_init_script(WATCH_SHIFTS)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))

        def note(message):
            if message.type in ("error", "warning") and not any(each in message.text for each in expected):
                faults.append(f"{message.text} ({message.location.get('url', '')})")

        page.on("console", note)
        if login:
            answer = context.request.post(f"{twin.url}/v1/session", data={"token": login})
            assert answer.status == 204
            page.goto(twin.url)
            page.wait_for_selector(".rows .row")
        return page

    yield opened
    for context in contexts:
        for page in context.pages:
            assert page.evaluate("window.hacked") is None
        context.close()
    assert faults == []
    for moved in shifts:
        assert layout_shift(moved) < LARGEST_SHIFT, moved
