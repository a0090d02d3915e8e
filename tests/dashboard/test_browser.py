"""The dashboard in Debian's Chromium: each page and action, accessibility, and pictures in build/screenshots."""

import math
import re
import time
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from browser_pages import (
    MARKUP,
    OTHERS,
    PICTURES,
    WAIT_MS,
    has_text,
    looks,
    open_machine,
    reaches,
    resize,
    serious_faults,
)
from dashboard_fleet import SILENT, WEARING
from service_system import ENGINEER, OPERATOR, TOKEN, bearer

from servotwin.messages.live import LiveColumns, encode_live

pytestmark = pytest.mark.slow


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


def fits(page, width):
    """Tell that a page does not scroll sideways once its plots have followed the window's width."""
    end = time.monotonic() + WAIT_MS / 1000.0
    while (needed := page.evaluate("document.documentElement.scrollWidth")) > width and time.monotonic() < end:
        page.wait_for_timeout(50)
    return needed <= width


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
    has_text(page, "[aria-label=Live] p", "The edge is not connected")  # its plots are empty until then
    assert page.locator(".uplot:visible").count() == 9
    page.locator("[aria-label=Window] p.mark", has_text=re.compile("imit cycle|still swings")).wait_for()
    page.click("[aria-label=Residual] button")
    has_text(page, "[aria-label=Residual] p", "autocorrelations lie outside the 95 % band")
    assert page.locator("[aria-label=Residual] .uplot").count() == 2
    has_text(page, "[aria-label=Updates] tbody tr", "applied it")
    assert page.locator("[aria-label=Updates] tbody tr").count() == 4
    has_text(page, "[aria-label='Behind the last update']", "not simulated")
    has_text(page, "[aria-label=Events]", "edge connected: boot boot-1")
    resize(page, 360, 740)
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
    panel.locator("text=simulated exactly on the model").wait_for()
    assert panel.locator(".uplot").count() == 2
    panel.locator(".map-words", has_text="The nearest cell").wait_for()
    assert panel.locator(".map rect").count() == 121
    panel.locator(".map-words", has_text=re.compile(r"settles from \d of 4 starts\. .* starts\.$")).wait_for()
    before, place = panel.locator(".soft").first.inner_text(), panel.locator(".map-words").inner_text()
    panel.locator("label", has_text="k_DZ").locator("input").fill("300")
    panel.locator(".soft", has_text=before).first.wait_for(state="detached")
    panel.locator(".map-words", has_text=place).wait_for(state="detached")
    assert serious_faults(page) == []
    resize(page, 360, 740)
    assert fits(page, 360)
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
    resize(page, 360, 740)
    assert fits(page, 360)
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


def test_the_first_live_data_move_nothing(open_page, twin):
    page = open_page()
    open_machine(page, WEARING)
    has_text(page, "[aria-label=Live] p", "The edge is not connected")  # no test before has streamed
    plots = page.locator("[aria-label=Live] .u-over")
    plots.first.wait_for()
    before = [each.bounding_box() for each in plots.all()]
    stream_live(twin, page)
    page.wait_for_timeout(300)  # drawn in a later frame than the word
    assert [each.bounding_box() for each in plots.all()] == before


def test_pages_are_accessible_and_fit_every_width(open_page, twin):
    PICTURES.mkdir(parents=True, exist_ok=True)
    machine, fleet, login = open_page(), open_page(), open_page(login="")
    login.goto(twin.url)
    login.wait_for_selector("#token")
    open_machine(machine, WEARING)
    fleet.wait_for_selector(".rows .row svg path[d^=M]", state="attached")
    machine.wait_for_selector(".hysteresis svg", state="attached")
    machine.click("[aria-label=Residual] button")
    machine.click("text=Try on the model")
    has_text(machine, ".map-words", "starts.")
    has_text(machine, "[aria-label=Residual] p", "95 % band")
    for view, page in (("fleet", fleet), ("machine", machine), ("login", login)):
        page.bring_to_front()
        heights = {}
        for look, width in looks(page):
            if view == "machine":
                stream_live(twin, page)
            picture = page.screenshot(full_page=view == "machine")
            (PICTURES / f"{view}-{look}.png").write_bytes(picture)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, f"{view} scrolls sideways, {look}"
            # On a machine's page times since its messages may need another line meanwhile.
            height = page.evaluate("document.documentElement.scrollHeight") if view != "machine" else 0
            assert heights.setdefault(width, height) == height, f"{view}: the theme moves something, {look}"
            if width < 3840:
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


def test_what_works_at_the_twin_but_not_as_it_should_is_said_on_every_page(open_page):
    page, said = open_page(), list[str]()
    page.route("**/healthz", lambda route: route.fulfill(json={"degraded": said}))
    with page.expect_response("**/healthz"):
        page.reload()
    page.wait_for_selector("#degraded", state="hidden")
    said += ["updates lag by 40 s", "<b>certificate</b> twin.crt expires"]
    page.reload()
    has_text(page, "#degraded", "The twin says: updates lag by 40 s; <b>certificate</b> twin.crt expires.")
    open_machine(page, WEARING)
    has_text(page, "#degraded", "updates lag by 40 s")
    assert serious_faults(page) == []
