"""The page in headless Chromium: pictures, mouse, touch, keys, and what it says without a connection."""

import colorsys
import re
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.chromium import Browser, find, until
from cotarget.errors import DeviceError
from cotarget.page.html import render
from cotarget.page.server import Page, listen
from cotarget.pipeline import State
from tests.support import page_client
from tests.support.page_client import SPEC, NotingSession, served, step

pytestmark = [
    pytest.mark.browser,
    pytest.mark.wire,
    pytest.mark.skipif(find() is None, reason="Chromium is not installed: apt-get install chromium"),
]
STOP = ("stop", "stopped from the page")
TRACK = SimpleNamespace(id=7, center_px=np.array([100.0, 60.0]), whole_px=np.array([40.0, 30.0]), reported=True)
SHIFT = 8  # modifier of a key
PLACE_PX = 2.0  # of a click, by the rounding of the layout
TEXT, LARGE = 4.5, 3.0  # contrast of WCAG AA: of text, of large text and of what surrounds controls


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser")) as made:
        made.size(1200, 900)
        yield made


@pytest.fixture
def at(browser):
    """A page with a run that shows a track, open in the browser, which has control."""
    with served() as made:
        leave = threading.Event()

        def show():
            for n in range(1_000_000):
                if leave.wait(0.04):
                    return
                made.page.show(step(n, tracks=(TRACK,), reason="<b>why</b>"), SPEC)

        thread = threading.Thread(target=show)
        thread.start()
        browser.events.clear()
        browser.open(made.page.link)
        until(lambda: browser.js("document.getElementById('fixed')?.dataset.n > 3"))
        until(lambda: browser.text("control") == "You have control.")
        yield made
        leave.set()
        thread.join()
        browser.open("about:blank")


def noted(at, what):
    return [each for each in at.session.noted if each[0] == what]


def test_the_page_opens_and_moves_nothing(browser, at):
    assert browser.js("location.href") == at.page.link.partition("#")[0]  # the token is out of the address
    assert browser.js("sessionStorage.getItem('token')") == at.page.token
    assert at.session.noted == []
    assert browser.text("word") == "Standing"
    assert browser.text("why") == "<b>why</b>"  # text, and no markup
    wrong = [e for e in browser.events if e.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown")]
    assert [e for e in wrong if "favicon" not in str(e)] == []
    asked = {e["params"]["request"]["url"] for e in browser.events if e.get("method") == "Network.requestWillBeSent"}
    assert {address.partition("#")[0] for address in asked if address.startswith("http")} == {
        browser.js("location.href")
    }
    loaded = browser.js("fetch('https://example.org').then(() => 'loaded', () => 'refused')")
    assert loaded == "refused"


def test_the_picture_and_its_track_are_drawn(browser, at):
    dark = browser.js("[...document.getElementById('fixed').getContext('2d').getImageData(300, 300, 1, 1).data]")
    assert max(dark[:3]) < 250
    # The box is 3 lines outside of the target: 40 x 30 px at (100, 60).
    left = browser.js("[...document.getElementById('fixed').getContext('2d').getImageData(77, 60, 1, 1).data]")
    assert left[1] > left[0] + 50  # cyan


def test_space_stops_whatever_has_the_focus_and_enter_presses(browser, at):
    for name in ("home", "follow", "take"):
        browser.js(f"document.getElementById('{name}').focus()")
        before = len(at.session.noted)
        browser.key(" ", text=" ")
        until(lambda: noted(at, "stop"))
        time.sleep(0.2)
        assert at.session.noted[before:] == [STOP]
        at.session.noted.clear()
    at.session.stopped = None
    until(lambda: not browser.js("document.getElementById('home').disabled"))
    browser.js("document.getElementById('home').focus()")
    browser.key("Enter", text="\r")
    until(lambda: noted(at, "home"))


def test_every_control_is_reached_by_tab(browser, at):
    until(
        lambda: browser.js("document.querySelector('[data-track]') && !document.querySelector('[data-track]').disabled")
    )
    browser.js("document.activeElement.blur()")
    seen = set()
    for _ in range(25):
        browser.key("Tab")
        seen.add(browser.js("document.activeElement.id || document.activeElement.textContent"))
    assert {"stop", "follow", "stand", "home", "Follow 7"} <= seen


def test_what_gets_the_focus_is_not_behind_the_header(browser, at):
    until(lambda: not browser.js("document.getElementById('home').disabled"))
    browser.size(800, 420)
    try:
        browser.js("scrollTo(0, 99999); document.querySelector('summary').focus()")
        for _ in range(10):
            browser.key("Tab", modifiers=SHIFT)
            edges = browser.js(
                "['header', ':focus'].map((each) => document.querySelector(each).getBoundingClientRect()).map("
                "(box, i) => (i ? box.top : box.bottom))"
            )
            assert browser.js("document.activeElement.id") == "stop" or edges[1] >= edges[0]
    finally:
        browser.size(1200, 900)


def test_arrow_keys_turn_while_they_are_held(browser, at):
    browser.key("ArrowRight", "keyDown")
    until(lambda: len(noted(at, "manual")) >= 4)
    browser.key("ArrowRight", "keyUp")
    until(lambda: noted(at, "stand"))
    assert {rates for _, _, rates in noted(at, "manual")} == {(1.0, 0.0)}
    count = len(noted(at, "manual"))
    time.sleep(0.5)
    assert len(noted(at, "manual")) == count


@pytest.mark.parametrize(
    "left",
    [
        "dispatchEvent(new Event('blur'))",
        "Object.defineProperty(document, 'hidden', { value: true, configurable: true });"
        "document.dispatchEvent(new Event('visibilitychange'))",
        "dispatchEvent(new Event('pagehide'))",
    ],
    ids=["focus", "hidden", "left"],
)
def test_what_is_held_ends_when_the_page_is_left(browser, at, left):
    browser.key("ArrowUp", "keyDown")
    until(lambda: noted(at, "manual"))
    browser.js(left)
    until(lambda: noted(at, "stand"))
    count = len(noted(at, "manual"))
    time.sleep(0.5)
    assert len(noted(at, "manual")) == count
    browser.key("ArrowUp", "keyUp")


def test_what_is_held_during_a_stop_does_not_turn_after_clear(browser, at):
    browser.js("document.querySelector('[data-rates]').focus()")
    browser.key("Enter", "keyDown", text="\r")
    until(lambda: noted(at, "manual"))
    at.session.stopped = "from another page"
    until(lambda: browser.text("word") == "Stopped")
    count = len(noted(at, "manual"))
    at.session.stopped = None
    until(lambda: browser.text("word") != "Stopped")
    time.sleep(0.5)
    assert len(noted(at, "manual")) <= count + 1  # that was on its way
    browser.key("Enter", "keyUp")


def test_a_hold_that_has_ended_begins_with_a_new_press(browser, at):
    browser.key("ArrowUp", "keyDown")
    until(lambda: noted(at, "manual"))
    browser.js("dispatchEvent(new Event('blur'))")
    until(lambda: noted(at, "stand"))
    count = len(noted(at, "manual"))
    for _ in range(5):  # the key is still down, so that it repeats
        browser.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowUp", code="ArrowUp", autoRepeat=True)
    time.sleep(0.3)
    assert len(noted(at, "manual")) == count
    browser.key("ArrowUp", "keyUp")


def test_a_drag_that_has_ended_begins_with_a_new_press(browser, at):
    x, y = browser.center("zoom")
    browser.mouse("mousePressed", (x, y), button="left", clickCount=1)
    browser.mouse("mouseMoved", (x + 100, y), button="left", buttons=1)
    until(lambda: noted(at, "manual"))
    browser.js("dispatchEvent(new Event('blur'))")
    until(lambda: noted(at, "stand"))
    count = len(noted(at, "manual"))
    browser.mouse("mouseMoved", (x + 150, y), button="left", buttons=1)
    time.sleep(0.3)
    assert len(noted(at, "manual")) == count
    browser.mouse("mouseReleased", (x + 150, y), button="left", clickCount=1)


def test_pictures_that_stop_are_said_to_be_old(browser):
    with served() as made:
        browser.open(made.page.link)
        until(lambda: browser.text("control") == "You have control.")
        made.page.show(step(0, tracks=(TRACK,), reason=""), SPEC)
        until(lambda: "No new picture" in browser.text("word"))
        browser.open("about:blank")


def test_a_click_follows_the_track_or_the_place(browser, at):
    browser.click("fixed", (100 / 640, 60 / 480))
    until(lambda: noted(at, "follow"))
    browser.click("fixed", (400 / 640, 300 / 480))
    until(lambda: len(noted(at, "follow")) == 2)
    (_, _, track), (_, _, place) = noted(at, "follow")
    assert track == 7
    assert place == pytest.approx((399.5, 299.5), abs=PLACE_PX)


def test_record_begins_and_completes_a_recording(browser, at):
    browser.click("record")
    until(lambda: noted(at, "record") == [("record", True)])
    at.session.recording = "recording"
    until(lambda: browser.text("recording") == "recording")
    browser.click("record")
    until(lambda: noted(at, "record")[1:] == [("record", False)])


def test_a_drag_in_the_close_up_turns_and_the_wheel_zooms(browser, at):
    x, y = browser.center("zoom")
    browser.mouse("mousePressed", (x, y), button="left", clickCount=1)
    for way in range(10, 60, 10):
        browser.mouse("mouseMoved", (x - way, y), button="left", buttons=1)
    until(lambda: len(noted(at, "manual")) >= 2)
    browser.mouse("mouseReleased", (x - 50, y), button="left", clickCount=1)
    until(lambda: noted(at, "stand"))
    assert all(pan < 0 == tilt for _, _, (pan, tilt) in noted(at, "manual"))
    browser.mouse("mouseWheel", (x, y), deltaX=0, deltaY=-100)
    until(lambda: noted(at, "zoom"))
    assert noted(at, "zoom")[0][2] > 1


def test_a_finger_holds_and_a_cancelled_touch_ends(browser, at):
    browser.js("document.querySelector('[data-rates=\"0,1\"]').id = 'up'")
    x, y = browser.center("up")
    browser.touch("touchStart", (x, y))
    until(lambda: len(noted(at, "manual")) >= 3)
    browser.touch("touchCancel")
    until(lambda: noted(at, "stand"))
    assert {rates for _, _, rates in noted(at, "manual")} == {(0.0, 1.0)}


def test_others_are_seen_to_take_control(browser, at):
    at.session.control = "another"
    until(lambda: browser.text("control") == "Another page has control.")
    assert browser.js("document.getElementById('home').disabled")
    assert not browser.js("document.getElementById('stop').disabled")
    assert "taken control" in browser.text("say")
    browser.click("stop")
    until(lambda: noted(at, "stop") == [STOP])


def test_a_page_that_is_opened_takes_control_from_nobody(browser):
    with served() as made, page_client.browser(made) as first:
        page_client.say(first, do="take")
        page_client.status(first, lambda message: message["control"] == "you")
        browser.open(made.page.link)
        until(lambda: browser.text("control") == "Another page has control.")
        assert browser.js("document.getElementById('home').disabled")
        assert page_client.status(first, lambda message: message["pages"] == 2)["control"] == "you"
        browser.click("take")
        page_client.status(first, lambda message: message["control"] == "another")
        until(lambda: browser.text("control") == "You have control.")
        browser.open("about:blank")


def test_a_page_without_an_answer_says_that_it_may_not_stop(browser, at):
    browser.js("socket.onmessage = null")
    until(lambda: "may not be able to stop" in browser.text("offline-text"))
    assert browser.js("document.getElementById('stop').disabled")


def test_a_browser_without_websocket_says_so(browser, at):
    script = browser.call("Page.addScriptToEvaluateOnNewDocument", source="delete window.WebSocket")["identifier"]
    browser.js("location.reload()")
    until(lambda: "no WebSocket" in browser.text("offline-text"))
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)


def test_without_a_connection_it_says_in_large_letters_that_it_cannot_stop(browser):
    with served() as made:
        browser.open(made.page.link)
        until(lambda: browser.text("control") == "You have control.")
        browser.js("socket.close()")
        until(lambda: browser.text("offline-text") == "No connection: this page cannot stop the head.")
        until(lambda: browser.text("offline-text") == "")  # it has connected again
    until(lambda: browser.text("offline-text") == "The run has ended: this page cannot stop the head.")
    assert browser.js("parseFloat(getComputedStyle(document.getElementById('offline')).fontSize)") >= 28
    assert browser.js("getComputedStyle(document.getElementById('offline')).display") == "block"


def test_it_connects_at_an_address_of_ipv6(browser):
    try:
        listener = listen("::1", 0)
    except DeviceError:
        pytest.skip("this machine has no IPv6")
    with Page(NotingSession(), listener, "::1") as page:
        browser.open(page.link)
        until(lambda: browser.text("control") == "You have control.")
        browser.open("about:blank")


def test_an_old_link_and_none_say_so(browser, at):
    browser.js("sessionStorage.setItem('token', 'old'); location.reload()")
    until(lambda: browser.text("offline-text") == "This link is old.")
    browser.js(f"location.hash = '{at.page.token}'")  # a new link in the old tab
    until(lambda: browser.text("control") == "You have control.")
    browser.js("sessionStorage.removeItem('token'); location.reload()")
    until(lambda: "no token" in browser.text("offline-text"))


@pytest.mark.parametrize("width", [320, 390, 768, 1600])
def test_it_fits_and_does_not_jump(browser, at, width, tmp_path):
    browser.size(width, 800, mobile=width < 500)
    try:
        assert browser.js("document.documentElement.scrollWidth <= innerWidth")
        before = browser.js("document.documentElement.scrollHeight")
        browser.js(
            "newest.heads.head.reason = 'zoom: unsure; '.repeat(40); newest.heads.head.pan_deg = -158.88;"
            "newest.skipped = 123456; "
            "newest.heads.head.predicted = {error_px: 1234.5, at: [0, 0], axes: [1, 1], turn: 0};"
            "tell(newest); text('say', 'Something was said.')"
        )
        assert browser.js("document.documentElement.scrollHeight") == before
        at.session.stopped = STOP[1]
        until(lambda: browser.text("latched"))
        assert browser.js("document.documentElement.scrollHeight") == before
        top = browser.js("document.getElementById('stop').getBoundingClientRect().top")
        browser.js("scrollTo(0, 500)")
        assert 0 <= browser.js("document.getElementById('stop').getBoundingClientRect().top") <= top  # it stays in view
    finally:
        browser.size(1200, 900)


# Colours, by the style alone


def colours(dark):
    """The style's colours by name."""
    style = render("page.html").partition("<style>")[2].partition("</style>")[0]
    light, _, rest = style.partition("@media (prefers-color-scheme: dark)")
    found = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", light))
    return found | (dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", rest)) if dark else {})


def contrast(a, b):
    """The contrast of two colours by WCAG."""

    def luminance(colour):
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(a), luminance(b)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_colours_have_enough_contrast(dark):
    c = colours(dark)
    for ink, paper in (("ink", "paper"), ("quiet", "paper"), ("ink", "raised"), ("quiet", "raised")):
        assert contrast(c[ink], c[paper]) >= TEXT, (ink, paper)
    assert contrast(c["on-act"], c["act"]) >= TEXT
    assert contrast(c["on-stop"], c["stop"]) >= TEXT
    for edge in ("line", "act", "stop"):
        assert contrast(c[edge], c["paper"]) >= LARGE, edge


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_stop_alone_is_red_and_no_control_is_yellow_or_green(dark):
    """IEC 60204-1: hold-to-run controls are none of these, and Stop is no emergency stop, which is red on yellow."""
    c = colours(dark)
    hues = {name: hue_deg(c[name]) for name in ("stop", "on-stop", "act", "on-act", "raised", "ink")}
    assert hues.pop("stop") > 330
    assert {name: hue for name, hue in hues.items() if hue is not None and not 180 < hue < 270} == {}
    assert "emergency" not in render("page.html").lower()


def hue_deg(colour):
    """The hue of a colour [degrees]: red is 0, yellow 60, green 120, blue 240; None of black and white."""
    hue, saturation, _ = colorsys.rgb_to_hsv(*(int(colour[i : i + 2], 16) for i in (1, 3, 5)))
    return 360 * hue if saturation else None


def test_nothing_moves_on_the_page_by_itself():
    """Reduced motion needs no case of its own."""
    assert not re.search(r"animation|transition|@keyframes|scroll-behavior", render("page.html") + render("run.html"))


def test_states_have_words():
    page = render("page.html")
    words = page.partition("const WORDS = {")[2].partition("};")[0]
    for state in State:
        assert re.search(rf'(\b{state}|"{state}"): "', words), state
