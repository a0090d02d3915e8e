"""The dashboard in Debian's Chromium: streams and tabs, bad input, a twin or a session that ends."""

import itertools
import json
import re
import time

import httpx
import pytest
from browser_pages import MARKUP, PICTURES, has_text, looks, open_machine, reaches, serious_faults, watchers
from dashboard_fleet import SILENT, WEARING, say_hello
from service_system import ENGINEER, OPERATOR, OTHER, TOKEN, bearer, place, window

from servotwin.link.seal import verifier_of
from servotwin.messages import Reason, encode
from servotwin.store.store import open_store
from servotwin.twin_service.auth import Verifiers, write_tokens

pytestmark = pytest.mark.slow


def test_states_without_data_are_said_in_words(open_page):
    page = open_page(expected=("status of 404",))
    open_machine(page, SILENT)
    has_text(page, ".empty", "No window of this machine has come yet")
    open_machine(page, "nobody")
    has_text(page, ".empty", "The twin knows no machine of this name")
    open_machine(page, "m-0001")  # its window holds no samples that can be read
    has_text(page, "[aria-label=Window] p", "no longer stored")


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


def test_a_new_window_appears_by_itself(open_page, twin):
    page = open_page()
    page.fill(".search", SILENT)
    has_text(page, ".rows .row", "none yet")
    sent = window(5, SILENT)
    answer = httpx.put(twin.url + place(sent), content=encode(sent), headers=bearer(OTHER))
    assert answer.status_code == 201
    has_text(page, ".rows .row [data-column=window]", "s ago")


@pytest.mark.parametrize("width", [390, 1024, 1100, 1160, 1440])
def test_the_fleet_fits_the_screen_with_its_last_column(open_page, width):
    page = open_page(width=width)
    assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    alarms = page.locator(".rows .row [data-column=alarms]").first.bounding_box()
    assert alarms["x"] + alarms["width"] <= width


def test_a_list_takes_no_more_room_than_it_fills(open_page):
    page = open_page(expected=("status of 404",))
    open_machine(page, "m-0001")  # one window, no update, no act
    has_text(page, "[role=region][aria-label=Acts]", "Nobody has acted on this machine")
    for name in ("Updates", "Acts", "Verification"):
        assert page.locator(f"[role=region][aria-label={name}]").bounding_box()["height"] < 60.0
    assert page.locator("section[aria-label=Oversight]").bounding_box()["height"] < 200.0


def test_every_gain_of_an_update_has_its_unit(open_page):
    page = open_page()
    open_machine(page, WEARING)
    setting = page.locator("[aria-label=Updates] tbody tr").first.locator("td").nth(4).text_content()
    assert re.search(r"dead zone [\d.]+ mm; Kp \S+ V/m, Ki \S+ V/\(m s\), Kd \S+ V s/m", setting)


def test_gains_of_every_law_are_shown_with_their_units(open_page):
    page = open_page()
    text = """([law]) => import("/static/updates.js").then((updates) => updates.settingText(
        { tolerance: 0, law }, { factor: 1, name: "deg" }, { command_unit: "N m", travel_unit: "rad" }))"""
    linear = {"type": "linear", "gain": 0.6, "integral_share": 0.0, "feedforward": 0.02}
    assert page.evaluate(text, [linear]) == "no dead zone; gain 0.600, integral share 0; feedforward 0.0200 N m"
    cascade = {"type": "cascade", "position_gain": 20.0, "velocity_gain": 3.0, "integral_time": 0.0, "feedforward": 0.0}
    assert page.evaluate(text, [cascade]) == "no dead zone; position gain 20.0 1/s, velocity gain 3.00 N m s/rad"


def test_a_version_in_force_that_a_fallback_took_has_the_setting_of_the_fallback(open_page):
    page = open_page()
    found = """([applied, fallback]) => import("/static/updates.js").then((updates) => {
        const body = { applied, parameter_version: 4 }, status = applied ? "applied" : updates.FELL_BACK;
        const update = { version: 4, body: { setting: { tolerance: 1 } } };
        const traces = [{ steps: [{ update, answers: [{ kind: "receipt", status, body }] }] }];
        const fell = { kind: "fallback", version: 3, body: { parameter_version: 4, setting: { tolerance: 2 } } };
        const events = fallback ? [fell] : [];
        return updates.settingInForce(traces, events, 4);
    })"""
    assert page.evaluate(found, [True, False]) == {"tolerance": 1}
    assert page.evaluate(found, [False, True]) == {"tolerance": 2}
    assert page.evaluate(found, [False, False]) is None


def test_the_words_for_a_fallback_are_those_of_the_receipt(open_page):
    page = open_page()
    assert page.evaluate("import('/static/updates.js').then((updates) => updates.FELL_BACK)") == Reason.FELL_BACK.value


def test_before_a_machine_is_known_its_units_are_not(open_page):
    page = open_page()
    units = """(machine) => import("/static/format.js").then((format) => [
        format.positionUnit(machine).name, format.commandUnit(machine)])"""
    assert page.evaluate(units, {"travel_unit": "", "command_unit": ""}) == ["m or rad", "SI unit"]
    assert page.evaluate(units, None) == ["m or rad", "SI unit"]
    assert page.evaluate(units, {"travel_unit": "rad", "command_unit": "N m"}) == ["deg", "N m"]
    assert page.evaluate(units, {"travel_unit": "m", "command_unit": "V"}) == ["mm", "V"]


def test_a_chart_of_one_window_spans_minutes(open_page):
    """About a single time uPlot shows a thousand days."""
    page = open_page()
    span = """(times) => import("/static/charts.js").then(({ TimePlot }) => {
        const place = document.body.appendChild(document.createElement("div"));
        place.style.width = "400px";
        const series = [{ label: "", color: "blue", points: true }];
        const plot = new TimePlot(place, { time: true, xLabel: "", yLabel: "", series });
        plot.show([times, times.map(() => 1)], "");
        return new Promise((done) => setTimeout(() => {
            const { min, max } = plot.plot.scales.x;
            plot.close();
            done([min, max]);
        }, 200));
    })"""
    assert page.evaluate(span, [1.8e9]) == [1.8e9 - 60, 1.8e9 + 60]
    assert page.evaluate(span, [1.8e9, 1.8e9 + 7]) == [1.8e9, 1.8e9 + 7]


def test_a_list_on_the_screen_keeps_its_height_while_rows_come(open_page):
    page = open_page()
    rows = """async (count) => {
        const { element, fill } = await import("/static/dom.js");
        const list = window.tried ??= document.body.appendChild(element("div", { class: "list" }));
        fill(list, element("div", {}, Array.from({ length: count }, (_, i) => element("p", {}, `row ${i}`))));
        return [list.offsetHeight, list.scrollHeight];
    }"""
    first, _ = page.evaluate(rows, 2)
    page.evaluate("window.tried.scrollIntoView()")
    shown, inside = page.evaluate(rows, 4)
    assert shown == first < inside
    page.evaluate("window.tried.style.position = 'absolute'; window.tried.style.top = '9000px'")
    assert page.evaluate(rows, 4)[0] == inside


def test_numbers_have_no_more_digits_than_their_interval_deserves(open_page):
    page = open_page()
    text = "([rate, half]) => import('/static/format.js').then((f) =>"
    text += " f.rateText(rate, [rate - half, rate + half], { factor: 1 }))"
    assert page.evaluate(text, [0.0, 171810.0]) == "0 ± 170000"
    assert page.evaluate(text, [12345.6, 234.5]) == "12350 ± 230"
    assert page.evaluate(text, [6.53, 0.256]) == "6.53 ± 0.26"
    ticks = "(step) => import('/static/charts.js').then((f) =>"
    ticks += " [1, 2].map((k) => f.tickText(1 + k * step, [1 + step, 1 + 2 * step])))"
    assert page.evaluate(ticks, 2.5e-7) == ["1.00000025", "1.00000050"]
    assert page.evaluate(ticks, 0.5) == ["1.5", "2.0"]


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
    page.locator(".table.stale").wait_for()  # drawn in a frame after the words
    page.unroute("**/v1/fleet/events*")
    page.wait_for_selector("[data-live=live]", state="attached")


SILENT_STREAM = """delete globalThis.SharedWorker;
globalThis.EventSource = class extends EventTarget {
    constructor() { super(); globalThis.stream = this; }
    close() {}
}"""
"""A stream of events that says only what a test lets it say."""


def test_trouble_is_said_when_the_twin_reports_it(open_page):
    page = open_page()
    page.add_init_script(SILENT_STREAM)
    page.reload()
    page.wait_for_selector(".rows .row")
    for name, data, words in (
        ("trouble", '"The store is read-only."', "The store is read-only. What is shown is of"),
        ("rows", "{broken", "A message of the twin cannot be read. What is shown is of"),
    ):
        page.evaluate("([name, data]) => stream.dispatchEvent(new MessageEvent(name, { data }))", [name, data])
        has_text(page, "#state", words)
        page.locator(".table.stale").wait_for()
        page.evaluate("stream.dispatchEvent(new Event('open'))")
        page.locator(".table:not(.stale)").wait_for()
        assert page.locator(".rows .row").count() > 10


def test_a_twin_that_goes_and_comes_back_needs_no_reload(open_page, twin):
    page = open_page(expected=("ERR_", "Failed to load"))
    page.evaluate("window.kept = 1")
    with twin.away():
        has_text(page, "#state", "cannot be reached")
        has_text(page, "#state", "What is shown is of")
        assert page.locator(".rows .row").count() > 10
    page.wait_for_selector("[data-live=live]", state="attached")
    assert page.evaluate("window.kept") == 1
    page.locator(".table:not(.stale)").wait_for()


@pytest.mark.parametrize("loaded", ["/nothing.js", "/static/uPlot.iife.min.js"])
def test_a_shared_stream_that_is_not_loaded_or_says_nothing_is_noticed(open_page, loaded):
    page = open_page(expected=("status of 404",))
    page.add_init_script(
        f"const W = SharedWorker; globalThis.SharedWorker = function () {{ return new W('{loaded}'); }};"
    )
    page.reload()
    has_text(page, "#state", "The twin cannot be reached. What is shown is of")
    assert page.locator(".rows .row").count() > 10


def test_an_answer_of_the_live_view_that_cannot_be_read_is_said_and_forgotten(open_page):
    page = open_page()
    answers = itertools.cycle(("{broken", "[1]", '{"state": "live"}'))
    page.route("**/live?*", lambda route: route.fulfill(body=next(answers), content_type="application/json"))
    open_machine(page, WEARING)
    has_text(page, "[aria-label=Live] p", "The twin's answer cannot be read")
    page.unroute("**/live?*")
    has_text(page, "[aria-label=Live] p", "The edge is not connected")
    assert page.locator("[aria-label=Live] p", has_text="cannot be read").count() == 0


def test_a_browser_whose_clock_is_two_hours_slow_shows_the_twin_s_ages(open_page):
    page = open_page()
    right = age_of_the_last_window(page)
    page.add_init_script("const now = Date.now; Date.now = () => now() - 7.2e6;")
    page.reload()
    assert right <= age_of_the_last_window(page) < right + 90.0


def age_of_the_last_window(page):
    """As the fleet shows it, s."""
    page.fill(".search", WEARING)
    shown = page.locator(".rows .row", has_text=WEARING).locator("[data-column=window]")
    shown.filter(has_text=re.compile("ago")).wait_for()
    value, unit = re.match(r"([\d.]+) (s|min) ago", shown.inner_text()).groups()
    return float(value) * {"s": 1.0, "min": 60.0}[unit]


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


def test_nothing_moves_while_alarms_and_updates_come_and_the_twin_goes(open_page, twin):
    page = open_page(login=ENGINEER, expected=("ERR_", "Failed to load", "status of 503"))
    open_machine(page, WEARING)
    page.wait_for_selector(".hysteresis svg")
    store = open_store(f"sqlite:///{twin.path.parent}/twin.db")
    try:
        for place in (".alarms", "[aria-label=Updates]", "[aria-label=Oversight]", "[aria-label=Events]"):
            page.locator(place).first.evaluate("place => place.scrollIntoView({ block: 'start' })")
            store.add_alarm(f"the alarm at {place} {MARKUP}", time.time(), WEARING)
            has_text(page, ".alarms li", f"the alarm at {place}")
            has_text(page, "[aria-label=Events] td", f"the alarm at {place}")
    finally:
        store.close()
    with twin.away():
        has_text(page, "#state", "What is shown is of")
    page.wait_for_selector("[data-live=live]", state="attached")


def test_states_are_photographed_and_accessible(open_page, twin):
    page = open_page(expected=("status of", "ERR_", "Failed to load"))
    page.add_init_script("delete globalThis.SharedWorker")
    page.reload()
    store = open_store(f"sqlite:///{twin.path.parent}/twin.db")
    say_hello(store, "ax-3", time.time())
    store.close()
    open_machine(page, "ax-3")
    has_text(page, ".empty", "No window of this machine has come yet")
    photographed(page, "without-data")
    open_machine(page, "nobody")
    has_text(page, ".empty", "The twin knows no machine of this name")
    photographed(page, "unknown")
    open_machine(page, WEARING)
    page.wait_for_selector(".hysteresis svg")
    with twin.away():
        has_text(page, "#state", "What is shown is of")
        photographed(page, "twin-away")
    page.wait_for_selector("[data-live=live]", state="attached")
    page.context.clear_cookies()
    page.select_option("[aria-label=Window] select", index=1)
    page.wait_for_selector("#token")
    photographed(page, "session-ended")


def test_bad_input_is_photographed_and_accessible(open_page, twin):
    page = open_page(expected=("status of",))
    page.add_init_script("delete globalThis.SharedWorker; const now = Date.now; Date.now = () => now() - 7.2e6;")
    rows = httpx.get(f"{twin.url}/v1/fleet?limit=1000", headers=bearer(OPERATOR)).json()
    hostile = {"servo": MARKUP, "status": MARKUP, "alarms": [{"time": 0.0, "sentence": MARKUP}]}
    rows["rows"] = [{**rows["rows"][0], **hostile}, *rows["rows"][1:]]
    del rows["rows"][1000:]
    page.route("**/v1/fleet?*limit=1000&after=", lambda route: route.fulfill(json=rows))
    page.route("**/v1/fleet?*after=m-*", lambda route: route.fulfill(json={**rows, "rows": []}))
    page.reload()
    has_text(page, ".rows .row a", "<img src=x")
    photographed(page, "markup-and-skew")
    broken = "id: 1-1\nevent: rows\ndata: {broken\n\n"
    page.route("**/v1/fleet/events*", lambda route: route.fulfill(body=broken, content_type="text/event-stream"))
    page.reload()
    has_text(page, "#state", "What is shown is of")
    photographed(page, "malformed-frame")


def photographed(page, name):
    """Take pictures of a state; it fits, and at a desk it is accessible."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for look, width in looks(page):
        (PICTURES / f"{name}-{look}.png").write_bytes(page.screenshot())
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        if width == 1280:
            assert serious_faults(page) == []


# Last: the file of tokens that it leaves names another fleet, so that this twin could not be started again.
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
        photographed(page, "token-revoked")
        page.fill("#token", "another")
        page.press("#token", "Enter")
        page.wait_for_selector(".hysteresis svg")
    finally:
        write_tokens(
            twin.path.parent / "tokens.toml",
            Verifiers(known, {"me": verifier_of(OPERATOR)}, {"eva": verifier_of(ENGINEER)}),
        )
