"""An engineer's acts in the browser: a version that waits is approved, and a machine is rolled back."""

import re
import time

import httpx
import pytest
from browser_pages import PICTURES, Twin, has_text, open_machine, serious_faults
from dashboard_fleet import SECONDS, WEARING, recorded_windows, wearing_fleet
from service_system import ENGINEER, MSGPACK, bearer, place

from servotwin.messages import encode

PANEL = "[aria-label=Oversight]"


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    folder = tmp_path_factory.mktemp("acts")
    running = Twin(wearing_fleet(folder, time.time()))
    yield running
    running.kill()


def act(page, button, why):
    page.locator(f"{PANEL} input").fill(why)
    page.locator(f"{PANEL} button", has_text=button).click()


def send(twin, window):
    answer = httpx.put(twin.url + place(window), content=encode(window), headers=MSGPACK | bearer())
    assert answer.status_code == 201


@pytest.mark.slow
def test_a_version_waits_is_approved_and_the_machine_is_rolled_back(open_page, twin, tmp_path):
    windows = [window for window in recorded_windows(tmp_path, SECONDS + 20.0) if window.start >= SECONDS - 1.0]
    page = open_page(login=ENGINEER)
    open_machine(page, WEARING)
    updates = page.locator("[aria-label=Updates] tbody tr")
    updates.nth(3).wait_for()  # the page has the machine's four versions
    act(page, "Ask first", "its first week")
    has_text(page, f"{PANEL} [role=status]", "Each new version waits for an engineer's approval")
    assert page.locator(f"{PANEL} button", has_text="Approve").is_disabled()
    send(twin, windows[0])
    has_text(page, f"{PANEL} .waiting", "A new version waits for approval")
    assert updates.count() == 4
    assert serious_faults(page) == []
    act(page, "Approve", "the gap is plausible")
    has_text(page, f"{PANEL} tbody", f"approved the proposal of window {windows[0].sequence}")
    updates.nth(4).wait_for()
    page.locator(f"{PANEL} select").select_option("fallback")
    act(page, "Roll back to", "it hums")
    has_text(page, f"{PANEL} tbody tr", "refused: the policy has no fallback set: name a version")
    page.locator(f"{PANEL} select").select_option("3")
    act(page, "Roll back to", "it hums")
    has_text(page, f"{PANEL} [role=status]", "Held by eva")
    send(twin, windows[1])
    row = page.locator(f"{PANEL} tbody tr", has_text="rolled back to version 3")
    row.locator("td", has_text=re.compile("^sent")).wait_for()
    PICTURES.mkdir(parents=True, exist_ok=True)
    (PICTURES / "acts.png").write_bytes(page.locator(PANEL).screenshot())
