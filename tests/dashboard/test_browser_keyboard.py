"""The dashboard with the keyboard alone: every control is reached, seen while it has the focus, and works."""

import pytest
from browser_pages import has_text, open_machine
from dashboard_fleet import WEARING
from service_system import ENGINEER

pytestmark = pytest.mark.slow

CONTROLS = """() => [...document.querySelectorAll("a[href], button, input, select, [tabindex='0']")]
    .filter((each) => each.checkVisibility({ visibilityProperty: true }) && !each.disabled && each.tabIndex >= 0)
    .map((each, k) => (each.dataset.stop = String(k)))"""
FOCUSED = """() => {
    const each = document.activeElement, row = each.closest(".rows .row") ?? each, style = getComputedStyle(row);
    const box = each.getBoundingClientRect(), bar = document.querySelector(".bar").getBoundingClientRect();
    const inBar = each.closest(".bar, .skip, #login");
    return {
        stop: each.dataset.stop ?? null, name: each.outerHTML.slice(0, 100),
        marked: style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2,
        seen: box.bottom > (inBar ? 0 : bar.bottom) && box.top < innerHeight && box.width > 0,
    };
}"""


def walk(page):
    """Press Tab through a page from its top; tell each control that is not reached, marked or seen."""
    page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    wanted, reached, faults = set(page.evaluate(CONTROLS)), [], []
    page.locator(".skip").focus()
    for _ in range(2 * len(wanted)):
        found = page.evaluate(FOCUSED)
        if found["stop"] is None or found["stop"] in reached:
            break
        reached.append(found["stop"])
        if not (found["marked"] and found["seen"]):
            faults.append(found)
        page.keyboard.press("Tab")
    names = "stops => stops.map((k) => document.querySelector(`[data-stop='${k}']`).outerHTML.slice(0, 100))"
    return page.evaluate(names, sorted(wanted - set(reached))), faults


def test_login_and_every_control_of_the_fleet_with_the_keyboard(open_page, twin):
    page = open_page(login="", expected=("status of 401", "status of 404"))
    page.goto(twin.url)
    page.wait_for_selector("#token")
    assert walk(page) == ([], [])
    page.locator(".skip").focus()
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "token"
    page.keyboard.type(ENGINEER)
    page.keyboard.press("Enter")
    page.wait_for_selector(".rows .row")
    assert walk(page) == ([], [])
    page.locator(".heads [data-column=gap] button").focus()
    page.keyboard.press("Enter")
    page.wait_for_selector(".heads [data-column=gap][aria-sort=descending]")
    page.locator(".chips button", has_text="without a gap").focus()
    page.keyboard.press("Space")
    page.wait_for_selector(".chips button[aria-pressed=true] >> text=without a gap")
    page.locator(".chips button", has_text="all").focus()
    page.keyboard.press("Space")
    page.wait_for_selector(".chips button[aria-pressed=true] >> text=all")
    page.locator(".rows a[tabindex='0']").focus()
    for key in ("End", "PageUp", "Home", "PageDown"):
        page.keyboard.press(key)
        page.wait_for_selector(".rows a[tabindex='0']:focus")
    assert page.locator(".rows a[tabindex='0']").count() == 1
    name = page.evaluate("document.activeElement.textContent")
    page.keyboard.press("Enter")
    has_text(page, "h1", name)
    page.go_back()
    page.wait_for_selector(".rows .row")


def test_every_control_of_a_machine_with_the_keyboard(open_page):
    page = open_page(login=ENGINEER)
    open_machine(page, WEARING)
    page.wait_for_selector(".hysteresis svg")
    press(page, "text=Try on the model")
    page.locator("[aria-label='What if'] .map-words", has_text="starts.").wait_for()
    press(page, "text=Check the window shown")
    has_text(page, "[aria-label=Residual] p", "95 % band")
    assert walk(page) == ([], [])
    page.locator(".skip").focus()
    page.keyboard.press("Enter")  # to the content of this page, not to another
    has_text(page, "h1", WEARING)
    assert page.evaluate("document.activeElement.id") == "view"
    before = page.locator("[aria-label='What if'] output").first.inner_text()
    page.locator("[aria-label='What if'] input[type=range]").first.focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    page.locator("[aria-label='What if'] output", has_text=before).first.wait_for(state="detached")
    plot = page.locator("[aria-label=Window] .chart").first
    plot.focus()
    whole = page.evaluate(RANGES)
    for key in ("+", "ArrowRight", "-", "0"):
        page.keyboard.press(key)
        shown = page.evaluate(RANGES)
        assert len({str(each) for each in shown}) == 1, "the plots of a window show the same time"
        if key == "+":
            assert shown[0][1] - shown[0][0] == pytest.approx(0.5 * (whole[0][1] - whole[0][0]), rel=1e-6)
    assert page.evaluate(RANGES) == whole
    page.locator("[aria-label=Oversight] input").focus()
    page.keyboard.type("with the keyboard")
    for act in ("Hold", "Release"):
        press(page, f"[aria-label=Oversight] button >> text='{act}'")
        page.locator("[aria-label=Oversight] button", has_text="Release" if act == "Hold" else "Hold").wait_for()
        page.locator("[aria-label=Oversight] input").fill("and again")
    press(page, "text=All machines")
    page.wait_for_selector(".rows .row")


def press(page, control):
    page.locator(control).first.focus()
    page.keyboard.press("Enter")


RANGES = """() => uPlot.sync("window").plots.map((plot) => [plot.scales.x.min, plot.scales.x.max])"""
