"""The dashboard in Debian's Chromium: each page and state, accessibility, and pictures in build/screenshots."""

import itertools
import json
import math
import os
import re
import signal
import time
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from dashboard_fleet import SILENT, WEARING, wearing_fleet
from servers import needed
from service_system import ENGINEER, OPERATOR, OTHER, TOKEN, bearer, place, process, window

from servotwin.link.seal import verifier_of
from servotwin.messages import encode
from servotwin.messages.live import LiveColumns, encode_live
from servotwin.twin_service.auth import Verifiers, write_tokens

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is in the extra dev")
pytestmark = pytest.mark.slow

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


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    running = Twin(wearing_fleet(tmp_path_factory.mktemp("twin"), time.time(), OTHERS))
    yield running
    running.kill()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as engine:
        # Root, as in containers, has no sandbox.
        opened = engine.chromium.launch(executable_path=needed("chromium"), args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def open_page(browser, twin):
    """Opens pages; in the end no script may have failed, and nothing may have been executed that came as a name."""
    contexts, faults = [], []

    def opened(login=OPERATOR, width=1280, height=900, theme="light", expected=()):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=theme)
        context.set_default_timeout(WAIT_MS)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))

        def note(message):
            if message.type in ("error", "warning") and not any(each in message.text for each in expected):
                faults.append(message.text)

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


def has_text(page, selector, text):
    page.locator(selector, has_text=text).first.wait_for()


def open_machine(page, name):
    page.evaluate("name => { location.hash = '#/machine/' + name }", name)
    page.wait_for_selector(".facts")


def test_a_token_is_given_once_and_kept_where_no_script_reads_it(open_page, twin):
    page = open_page(login="", expected=("status of 401", "status of 403"))
    page.goto(twin.url)
    for wrong in ("guess", TOKEN):
        page.fill("#token", wrong)
        page.click("#login-form button")
        has_text(page, "#login-error", "not an operator's token")
    page.fill("#token", OPERATOR)
    page.press("#token", "Enter")
    page.wait_for_selector(".rows .row")
    (cookie,) = page.context.cookies()
    assert cookie["httpOnly"]
    assert cookie["sameSite"] == "Strict"
    assert OPERATOR not in cookie["value"]
    assert page.evaluate("document.cookie") == ""
    page.reload()
    page.wait_for_selector(".rows .row")
    page.click("#logout")
    page.wait_for_selector("#token")
    assert page.context.cookies() == []


def test_a_thousand_machines_are_sorted_filtered_searched_and_opened_with_the_keyboard(open_page):
    page = open_page()
    has_text(page, ".chips button", f"{OTHERS + 2} all")
    assert page.locator(".rows .row").count() < 60
    page.click(".heads [data-column=gap] button")
    page.wait_for_selector(".heads [data-column=gap][aria-sort=descending]")
    has_text(page, ".rows .row[aria-rowindex='2']", "m-0016")
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    has_text(page, ".rows .row", SILENT)  # what is unknown comes last
    page.keyboard.press("/")
    page.keyboard.type("AX-")
    has_text(page, ".rows .row", WEARING)
    assert page.locator(".rows .row").count() == 2
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Enter")
    has_text(page, "h1", WEARING)


def test_a_machine_that_wears_is_shown_with_its_updates(open_page, twin):
    page = open_page(expected=("status of 400",))
    open_machine(page, WEARING)
    has_text(page, ".fact", "± 0.039")  # of the estimate that the co-simulation gives
    has_text(page, ".fact", "limit 20.0 deg")
    page.wait_for_selector(".hysteresis svg")
    assert page.locator(".uplot").count() == 6
    page.locator("[aria-label=Window] p.mark", has_text=re.compile("imit cycle|still swings")).wait_for()
    page.click("[aria-label=Residual] button")
    has_text(page, "[aria-label=Residual] p", "autocorrelations lie outside the 95 % band")
    assert page.locator("[aria-label=Residual] .uplot").count() == 2
    has_text(page, "[aria-label=Live] p", "The edge is not connected")
    has_text(page, "[aria-label=Updates] tbody tr", "applied it")
    assert page.locator("[aria-label=Updates] tbody tr").count() == 4
    has_text(page, "[aria-label='Behind the last update']", "not simulated")
    has_text(page, "[aria-label=Events]", "edge connected: boot boot-1")
    page.set_viewport_size({"width": 360, "height": 740})
    page.select_option("[aria-label=Window] select", index=1)
    has_text(page, "[aria-label=Window] p", "The least and greatest sample")
    page.click("text=Every sample")
    has_text(page, "[aria-label=Window] p", "Every sample is shown")
    with page.expect_download() as download:
        page.click("[aria-label='Gap over time'] a")
    assert download.value.path().read_text().startswith("received,sample_time,boot")
    for panel, name in (("Gap over time", f"{WEARING}-gaps.parquet"), ("Window", f"{WEARING}-boot-1-2.parquet")):
        with page.expect_download() as download:
            page.click(f"[aria-label='{panel}'] button.plain")
        assert download.value.suggested_filename == name
        assert download.value.path().read_bytes()[:4] == b"PAR1"
    page.route("**/gaps.parquet*", lambda route: route.fulfill(status=400, json={"detail": "it needs pyarrow"}))
    page.click("[aria-label='Gap over time'] button.plain")
    has_text(page, ".error", "No Parquet file: it needs pyarrow")


def test_a_step_is_tried_on_the_model(open_page):
    page = open_page(expected=("status of 400",))
    open_machine(page, WEARING)
    panel = page.locator("[aria-label='What if']")
    panel.locator("text=Try on the model").click()
    panel.locator("text=exactly simulated on the model").wait_for()
    assert panel.locator(".uplot").count() == 2
    panel.locator(".map-words", has_text="The nearest cell").wait_for()
    assert panel.locator(".map rect").count() == 121
    panel.locator(".map-words", has_text=re.compile(r"settles from \d of 4 starts\. .* starts\.$")).wait_for()
    before, place = panel.locator(".soft").first.inner_text(), panel.locator(".map-words").inner_text()
    panel.locator("label", has_text="k_DZ").locator("input").fill("300")
    panel.locator(".soft", has_text=before).first.wait_for(state="detached")
    panel.locator(".map-words", has_text=place).wait_for(state="detached")
    assert serious_faults(page) == []
    page.set_viewport_size({"width": 360, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    PICTURES.mkdir(parents=True, exist_ok=True)
    (PICTURES / "what-if.png").write_bytes(panel.screenshot())
    page.locator("label", has_text="Kp").locator("input").fill("400")
    has_text(page, "[aria-label='What if'] .error", "unstable on this servo even without a gap")
    panel.locator("text=As in force").click()
    panel.locator(".soft", has_text=before).first.wait_for()


def test_an_engineer_holds_a_machine_with_a_reason_and_an_operator_sees_who(open_page):
    page = open_page(login=ENGINEER)
    open_machine(page, WEARING)
    panel = page.locator("[aria-label='Oversight']")
    panel.locator("text=Nobody has acted on this machine").wait_for()
    panel.locator("button", has_text="Hold").click()
    has_text(page, "[aria-label='Oversight'] .error", "Give a reason")
    panel.locator("input").fill(f"noise {MARKUP}")
    panel.locator("button", has_text="Hold").click()
    has_text(page, "[aria-label='Oversight'] [role=status]", "Held by eva since")
    assert serious_faults(page) == []
    PICTURES.mkdir(parents=True, exist_ok=True)
    (PICTURES / "oversight.png").write_bytes(panel.screenshot())
    page.set_viewport_size({"width": 360, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    (PICTURES / "oversight-phone.png").write_bytes(panel.screenshot())
    reader = open_page()
    open_machine(reader, WEARING)
    has_text(reader, "[aria-label='Oversight'] [role=status]", "Held by eva since")
    assert not reader.locator("[aria-label='Oversight'] button").first.is_visible()
    panel.locator("input").fill("the noise was a loose cover")
    panel.locator("button", has_text="Release").click()
    has_text(reader, "[aria-label='Oversight'] [role=status]", "Updates are sent as soon as they are verified")
    assert reader.locator("[aria-label='Oversight'] tbody tr").count() == 2


def test_an_engineer_tests_the_webhook_and_an_operator_is_not_offered_it(open_page):
    page = open_page(login=ENGINEER, expected=("status of 404",))
    assert not page.is_visible("text=Test the alarm webhook")  # this twin posts no alarms
    page.route("**/v1/webhook", lambda route: route.fulfill(json={"host": "hook.example", "may_test": True}))
    page.reload()
    page.click("text=Test the alarm webhook")
    has_text(page, ".head [role=status]", "has no [service.webhook]")
    taken = {"host": "hook.example", "status": 204}
    page.route("**/v1/webhook/test", lambda route: route.fulfill(json=taken))
    page.click("text=Test the alarm webhook")
    has_text(page, ".head [role=status]", "hook.example took the test (status 204)")


def test_states_without_data_are_said_in_words(open_page):
    page = open_page(expected=("status of 404",))
    open_machine(page, SILENT)
    has_text(page, ".empty", "No window of this machine has come yet")
    open_machine(page, "nobody")
    has_text(page, ".empty", "The twin knows no machine of this name")
    open_machine(page, "m-0001")  # its window holds no samples that can be read
    has_text(page, "[aria-label=Window] p", "no longer stored")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_pages_are_accessible_and_fit_every_width(open_page, twin, theme):
    PICTURES.mkdir(parents=True, exist_ok=True)
    machine, fleet, login = open_page(theme=theme), open_page(theme=theme), open_page(login="", theme=theme)
    login.goto(twin.url)
    login.wait_for_selector("#token")
    open_machine(machine, WEARING)
    fleet.wait_for_selector(".rows .row svg path[d^=M]", state="attached")
    machine.wait_for_selector(".hysteresis svg", state="attached")
    machine.click("[aria-label=Residual] button")
    machine.click("text=Try on the model")
    has_text(machine, ".map-words", "starts.")
    has_text(machine, "[aria-label=Residual] p", "95 % band")
    for name, width, height in (("desk", 1280, 900), ("phone", 360, 740), ("wall", 3840, 2160)):
        for view, page in (("fleet", fleet), ("machine", machine), ("login", login)):
            page.bring_to_front()
            page.set_viewport_size({"width": width, "height": height})
            if view == "machine":
                stream_live(twin, page)
            page.evaluate("scrollTo(0, 0)")
            page.wait_for_timeout(250)  # plots follow the width
            picture = page.screenshot(full_page=view == "machine")
            (PICTURES / f"{view}-{theme}-{name}.png").write_bytes(picture)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, f"{view} scrolls sideways at {width}"
            if name != "wall":
                assert serious_faults(page) == []


def stream_live(twin, page):
    """Send what an edge sends that is watched, ten seconds at once, until the page shows it."""

    def shown():
        send_live(twin)
        page.wait_for_timeout(700)
        return page.locator("[aria-label=Live] strong").inner_text()

    reaches(shown, "Live")


def send_live(twin):
    begun = int(10 * time.monotonic()) - 100
    swing = [1e-3 * math.sin(0.02 * (begun + k)) for k in range(100)]
    columns = tuple((x, x + 1e-4, -x, 1e-4 - x, 0.4 * x / 1e-3, 0.5 * x / 1e-3 + 0.1) for x in swing)
    sent = encode_live(LiveColumns(WEARING, 1, begun, 0.1, columns))
    assert httpx.post(f"{twin.url}/v1/servos/{WEARING}/live", content=sent, headers=bearer(TOKEN)).status_code == 200


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


def test_a_page_that_nobody_sees_leaves_its_stream_to_others(open_page, twin):
    reaches(lambda: watchers(twin), 0)
    page = open_page()
    reaches(lambda: watchers(twin), 1)
    see = "hidden => { Object.defineProperty(document, 'hidden', { get: () => hidden, configurable: true });"
    see += " document.dispatchEvent(new Event('visibilitychange')); }"
    page.evaluate(see, True)
    reaches(lambda: watchers(twin), 0)
    page.evaluate(see, False)
    reaches(lambda: watchers(twin), 1)


def test_numbers_are_readable_and_long_windows_complete(open_page):
    page = open_page()
    text = "([gap, low, high]) => import('/static/format.js').then((f) => f.gapText(gap, [low, high], 1))"
    assert page.evaluate(text, [4.5, 4.4, 4.6]) == "4.500 ± 0.100"
    assert page.evaluate(text, [4.5e-8, 4.4e-8, 4.6e-8]) == "(4.50 ± 0.10) × 10^−8"
    # An interval far narrower than the gap is no reason for a power of ten.
    assert page.evaluate(text, [10.0, 10.0 - 2e-6, 10.0 + 2e-6]) == "10.0000000 ± 0.0000020"
    samples, rate = 200_000, 1000.0

    def answer(route):
        asked = {key: float(value[0]) for key, value in parse_qs(urlsplit(route.request.url).query).items()}
        part = range(int(asked["from"] * rate), min(samples, int(asked["to"] * rate) + 2))
        assert len(part) <= 4 * asked["points"]
        channel = {"name": "position", "time": [k / rate for k in part], "values": list(part)}
        route.fulfill(json={"channels": [channel]})

    page.route("**/channels?*", answer)
    whole = """window => import('/static/machine.js').then(({ MachinePage }) => MachinePage.prototype.everySample.call(
        { name: "m", windowNote: document.createElement("p") }, window, "b", 1))"""
    shown = {"samples": samples, "rate": rate, "channels": [{"name": "position", "time": [], "values": []}]}
    assert page.evaluate(whole, shown)["channels"][0]["values"] == list(range(samples))


def test_a_new_window_appears_by_itself(open_page, twin):
    page = open_page()
    page.fill(".search", SILENT)
    has_text(page, ".rows .row", "none yet")
    sent = window(5, SILENT)
    answer = httpx.put(twin.url + place(sent), content=encode(sent), headers=bearer(OTHER))
    assert answer.status_code == 201
    has_text(page, ".rows .row [data-column=window]", "s ago")


def test_text_from_outside_is_never_executed(open_page, twin):
    page = open_page(expected=("status of 400", "status of 404"))
    rows = httpx.get(f"{twin.url}/v1/fleet?limit=1", headers=bearer(OPERATOR)).json()
    hostile = {**rows["rows"][0], "servo": MARKUP, "status": MARKUP, "receipt": MARKUP}
    rows["rows"] = [{**hostile, "alarms": [{"time": 0.0, "sentence": MARKUP}]}]
    page.route("**/v1/fleet?*", lambda route: route.fulfill(body=json.dumps(rows), content_type="application/json"))
    page.reload()
    has_text(page, ".rows .row a", "<img src=x")
    page.locator(".rows .row a").first.click()
    has_text(page, "h1", "<script>")
    has_text(page, ".alarms li", "onerror")


def test_seven_tabs_of_a_browser_share_one_stream(open_page, twin):
    reaches(lambda: watchers(twin), 0)
    page = open_page()
    tabs = [page.context.new_page() for _ in range(6)]
    for tab in tabs:
        tab.goto(twin.url)
        tab.wait_for_selector(".rows .row")
        tab.wait_for_selector("[data-live=live]", state="attached")
    assert watchers(twin) == 1
    sent = window(7, SILENT)
    assert httpx.put(twin.url + place(sent), content=encode(sent), headers=bearer(OTHER)).status_code == 201
    for tab in (page, *tabs):
        tab.fill(".search", SILENT)
        tab.locator(".rows .row", has_text=SILENT).locator("[data-column=window]", has_text="s ago").wait_for()
    for tab in tabs:
        tab.close()
    assert watchers(twin) == 1
    page.close()
    reaches(lambda: watchers(twin), 0)


def test_a_malformed_event_keeps_the_last_good_data(open_page):
    page = open_page()
    page.add_init_script("delete globalThis.SharedWorker")  # where there is none, each page has a stream of its own
    broken = "id: 1-1\nevent: rows\ndata: {broken\n\n"
    page.route("**/v1/fleet/events*", lambda route: route.fulfill(body=broken, content_type="text/event-stream"))
    page.reload()
    has_text(page, "#state", "What is shown is of")
    assert page.locator(".rows .row").count() > 10
    assert page.locator(".table.stale").count() == 1
    page.unroute("**/v1/fleet/events*")
    page.wait_for_selector("[data-live=live]", state="attached")


def test_a_twin_that_goes_and_comes_back_needs_no_reload(open_page, twin):
    page = open_page(expected=("ERR_", "Failed to load"))
    page.evaluate("window.kept = 1")
    twin.kill()
    has_text(page, "#state", "cannot be reached")
    has_text(page, "#state", "What is shown is of")
    assert page.locator(".rows .row").count() > 10
    twin.restart()
    page.wait_for_selector("[data-live=live]", state="attached")
    assert page.evaluate("window.kept") == 1
    page.locator(".table:not(.stale)").wait_for()


def test_an_answer_of_the_live_view_that_cannot_be_read_is_said_and_forgotten(open_page):
    page = open_page()
    answers = itertools.cycle(("{broken", "[1]", '{"state": "live"}'))
    page.route("**/live?*", lambda route: route.fulfill(body=next(answers), content_type="application/json"))
    open_machine(page, WEARING)
    has_text(page, "[aria-label=Live] p", "The twin's answer cannot be read")
    page.unroute("**/live?*")
    has_text(page, "[aria-label=Live] p", "The edge is not connected")


def test_a_browser_whose_clock_is_two_hours_slow_shows_the_twin_s_ages(open_page):
    page = open_page()
    page.add_init_script("const now = Date.now; Date.now = () => now() - 7.2e6;")
    page.reload()
    page.fill(".search", WEARING)
    row = page.locator(".rows .row", has_text=WEARING)
    row.locator("[data-column=window]", has_text=re.compile(r"^[\d.]+ (s|min) ago")).wait_for()


def test_a_session_that_has_ended_asks_for_the_token_and_keeps_what_is_shown(open_page):
    page = open_page(expected=("status of 401",))
    open_machine(page, WEARING)
    page.wait_for_selector(".hysteresis svg")
    page.context.clear_cookies()
    page.select_option("[aria-label=Window] select", index=1)
    page.wait_for_selector("#token")
    has_text(page, "#state", "session has ended")
    assert page.locator("[aria-label=Window] .uplot").count() == 3
    has_text(page, "[aria-label=Window] p", "What is shown is the window before")
    assert page.is_visible(".hysteresis svg")
    page.fill("#token", OPERATOR)
    page.press("#token", "Enter")
    page.wait_for_selector("[data-live=live]", state="attached")
    page.locator("#login").wait_for(state="hidden")


def test_a_revoked_token_ends_the_session(open_page, twin):
    page = open_page(expected=("status of 401", "status of 403"))
    known = {"ax-1": verifier_of(TOKEN), "ax-2": verifier_of(OTHER)}
    write_tokens(twin.path.parent / "tokens.toml", Verifiers(known, {"me": verifier_of("another")}))
    try:
        page.wait_for_timeout(1500)  # the twin looks at the file once a second
        open_machine(page, WEARING)
        page.wait_for_selector("#token")
        has_text(page, "#state", "session has ended")
        assert page.is_visible("h1 >> text=ax-1")
        page.fill("#token", "another")
        page.press("#token", "Enter")
        page.wait_for_selector(".hysteresis svg")
    finally:
        write_tokens(twin.path.parent / "tokens.toml", Verifiers(known, {"me": verifier_of(OPERATOR)}))
