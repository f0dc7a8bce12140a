"""A run in one file: what is in it, and how a browser shows it from disk."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.chromium import Browser, find, until
from cotarget.errors import CotargetError
from cotarget.page import run_file
from cotarget.page.run_file import RunFile
from cotarget.pipeline import State
from cotarget.rig import Frame
from tests.support.commands import call, refused
from tests.support.full_disk import SAID, full_disk
from tests.support.page_client import SPEC, step
from tests.support.recorded_run import CONFIG, calibration_file, record

NASTY = "</script><script>document.title = 'harm'</script><img src=x onerror=\"document.title = 'harm'\">"
STEPS = 60  # of the run
CODED = 6  # error of the film's coding [grey levels]: steps that differ by less are 13 or more steps apart, see `shade`
LATE, LATE_S = 30, 2.0  # a step that comes late
BEFORE_S = 1000.0  # the clock's time when the run begins
TRACK = SimpleNamespace(id=7, center_px=np.array([100.0, 60.0]), whole_px=np.array([40.0, 30.0]), reported=True)


def at_s(n):
    return 0.04 * n + (LATE_S if n >= LATE else 0.0)


def shade(n):
    """Brightness of both cameras' pictures in a step."""
    grey = 10 + 4 * (23 * n % STEPS)
    return grey, 255 - grey


def seen(n):
    """A step whose pictures are as bright as its number; it is followed from step 10 on."""
    fixed, zoom = (Frame(np.full((48, 63, 3), value, np.uint8), BEFORE_S + at_s(n)) for value in shade(n))
    more = {"reason": NASTY}
    if n >= 10:
        covariance = np.diag([9.0, 4.0])
        more |= {
            "state": State.FOLLOWING,
            "target": TRACK,
            "tracks": (TRACK,),
            "expected": SimpleNamespace(covariance=covariance, offset_px=np.array([3.0, 4.0]), size_px=25.0),
            "found": SimpleNamespace(center_px=np.array([31.0 + 6.0, 23.5 + 8.0]), t=zoom.t),
        }
    return replace(step(n, **more), fixed=fixed, zoom=zoom, t=fixed.t + 0.06)


def recording(folder, **more):
    table = {
        "directory": folder / "run", "config": CONFIG, "target": "bird", "spec": SPEC, "when": "2026-05-01T09:30:00",
        "notes": (f"the run was ended by {NASTY}",),
    } | more  # fmt: skip
    return SimpleNamespace(**table)


def written(folder, steps=STEPS, **more):
    path = folder / "run.html"
    with RunFile(path, recording(folder, **more)) as page:
        for n in range(steps):
            page.see(seen(n))
    return path


def run_in(path):
    """The run of a page, as any parser of HTML and JSON finds it."""
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="run">(.*?)</script>', text, re.DOTALL)[1])


# The file


def test_a_page_holds_each_step_and_its_policy_lets_nothing_in(tmp_path):
    path = written(tmp_path)
    run, text = run_in(path), path.read_text(encoding="utf-8")
    assert [each["at"] for each in run["steps"]] == pytest.approx([at_s(n) for n in range(STEPS)])
    assert (run["name"], run["target"], run["wanted_px"]) == ("run", "bird", 30.0)
    head = run["steps"][20]["heads"]["head"]
    assert (head["state"], head["track"], head["reason"]) == ("following", 7, NASTY)
    assert head["found"] == [37.0, 31.5]
    scripts = re.findall(r"<script[^>]*>", text)
    assert scripts == ["<script>", '<script type="application/json" id="run">', '<script type="text/plain" id="film">']
    policy = re.search(r'<head>\s*<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)[1]
    found = dict(part.split(" ", 1) for part in policy.split("; "))
    for tag in ("script", "style"):
        own = re.search(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)[1]
        assert found.pop(f"{tag}-src") == f"'sha256-{base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()}'"
    assert found.pop("media-src") == "blob:"
    assert found == dict.fromkeys(("default-src", "base-uri", "form-action"), "'none'")
    assert [each.name for each in tmp_path.iterdir()] == ["run.html"]


def test_a_page_that_is_too_large_ends_early_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(run_file, "MOST_BYTES", 55_000)
    path = tmp_path / "run.html"
    with RunFile(path, recording(tmp_path)) as page:
        for n in range(STEPS):
            page.see(seen(n))
        warning = page.warning
    run = run_in(path)
    cut_s = at_s(len(run["steps"]))
    assert 0 < len(run["steps"]) < STEPS
    assert warning.startswith(f"{path}: holds the first {cut_s:.1f} s of the run, because a page holds some ")
    assert f"holds the first {cut_s:.1f} s" in run["notes"][-1]


def test_a_run_that_ends_early_leaves_a_whole_page(tmp_path):
    def interrupted():
        with RunFile(tmp_path / "run.html", recording(tmp_path)) as page:
            for n in range(5):
                page.see(seen(n))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(run_in(tmp_path / "run.html")["steps"]) == 5
    assert [each.name for each in tmp_path.iterdir()] == ["run.html"]


def test_a_full_disk_leaves_the_page_before_it(tmp_path):
    path = tmp_path / "run.html"
    path.write_text("before")
    with full_disk(30_000), pytest.raises(CotargetError, match=SAID):  # enough for the film, and not for the page
        written(tmp_path)
    assert path.read_text() == "before"
    assert [each.name for each in tmp_path.iterdir()] == ["run.html"]


def test_a_run_without_a_step_leaves_no_page_and_says_so(tmp_path):
    with RunFile(tmp_path / "run.html", recording(tmp_path)) as page:
        assert page.warning.endswith("is not written, because the run has no step")
    assert list(tmp_path.iterdir()) == []


# The command


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a recording."""
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "run", calibration_file(tmp_path), seconds=1.0)
    return tmp_path


def test_replay_writes_the_page_of_a_run(folder, capsys):
    status, out, err = call(capsys, "replay", "run", "--html", "run.html")
    run = run_in(folder / "run.html")
    assert (status, err) == (0, "") or "differ" in err  # the recorded run had another detector
    assert len(run["steps"]) == json.loads(out)["steps"] == len(list((folder / "run" / "fixed").iterdir()))
    assert run["places"] == {"fixed": [0, 0, 96, 72], "zoom": [96, 0, 96, 72]}
    assert (run["name"], run["notes"]) == ("run", [])
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:]{8}\+00:00", run["when"])


def test_a_crashed_run_without_zoom_pictures_has_a_page_that_says_so(folder, capsys):
    log = folder / "run" / "log.jsonl"
    log.write_bytes(log.read_bytes()[:-40])
    for image in (folder / "run" / "zoom").iterdir():
        image.unlink()
    assert call(capsys, "replay", "run", "--html", "run.html")[0] == 0
    first, second = run_in(folder / "run.html")["notes"]
    assert first.startswith("Is cut short, and replays up to 0.9")
    assert "frames of the zoom camera lack their image" in second


def test_what_has_no_calibration_is_refused_in_one_line(folder, capsys):
    (folder / "run" / "calibration.json").unlink()
    assert "no such file; the recording is not whole" in refused(capsys, "replay", "run", "--html", "run.html")
    assert not (folder / "run.html").exists()


# In the browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser")) as made:
        made.size(1200, 900)
        yield made


@pytest.fixture
def opened(browser, tmp_path):
    """The page, opened from disk."""
    path = written(tmp_path)
    browser.events.clear()
    browser.open(path.as_uri())
    until(lambda: browser.js("document.getElementById('fixed')?.dataset.n") == "0")
    return browser


def shown(browser, n):
    until(lambda: browser.js("document.getElementById('fixed').dataset.n") == str(n))


def assert_is_shown(browser):
    """Both pictures are those of the step that is shown; away from what is drawn on them."""
    read = "[...document.getElementById('{}').getContext('2d').getImageData(5, 40, 1, 1).data]"
    n, *colours = browser.js(f"[shown, {read.format('fixed')}, {read.format('zoom')}]")
    assert [np.mean(each[:3]) for each in colours] == pytest.approx(shade(n), abs=CODED), n


@pytest.mark.browser
@pytest.mark.skipif(find() is None, reason="Chromium is not installed: apt-get install chromium")
class TestInChromium:
    def test_each_frame_is_shown_exactly(self, opened):
        for n in (1, 2, 3, 59, 30, 29, 28, 31, 12, 45, 0):  # forth and back, and beside the gap
            opened.js(f"go({n})")
            shown(opened, n)
            assert_is_shown(opened)
            assert opened.text("when").startswith(f"{at_s(n):.2f} s")

    def test_it_loads_nothing_and_text_is_text(self, opened):
        assert opened.text("why") == NASTY
        assert opened.text("notes") == f"The run was ended by {NASTY}."
        assert opened.js("document.title") == "run: bird"
        assert opened.js("document.querySelectorAll('img').length") == 0
        wrong = [e for e in opened.events if e.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown")]
        assert wrong == []
        asked = [e["params"]["request"]["url"] for e in opened.events if e.get("method") == "Network.requestWillBeSent"]
        assert {address.partition(":")[0] for address in asked} <= {"file", "blob"}
        assert sum(address.startswith("file:") for address in asked) == 1
        assert opened.js("fetch('https://example.org').then(() => 'loaded', () => 'refused')") == "refused"

    def test_keys_step_play_and_pause(self, opened):
        for key, n in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", STEPS - 1), ("Home", 0)):
            opened.key(key)
            shown(opened, n)
        opened.key(" ", text=" ")
        until(lambda: opened.js("shown") > 5)
        assert opened.text("play") == "Pause"
        opened.key(" ", text=" ")
        until(lambda: opened.text("play") == "Play" and not opened.js("film.seeking"))
        assert_is_shown(opened)
        opened.js("go(57)")
        shown(opened, 57)
        opened.key(" ", text=" ")
        shown(opened, STEPS - 1)  # where it ends

    def test_a_press_in_a_plot_shows_that_moment(self, opened):
        opened.click("offsets", (0.5, 0.5))  # in the gap of 2 s after step 29
        shown(opened, LATE - 1)
        left, width = opened.js(
            "['#offsets b', '#offsets'].map((each) => document.querySelector(each).getBoundingClientRect())"
            ".reduce((a, b) => [a.left - b.left, b.width])"
        )
        middle_s = (at_s(LATE - 1) + at_s(LATE)) / 2
        assert left / width == pytest.approx(middle_s / (at_s(STEPS - 1) + 0.04), abs=0.01)

    def test_numbers_of_a_step_are_shown(self, opened):
        assert (opened.text("measured"), opened.text("size")) == ("\u2013", "\u2013")
        opened.js("go(20)")
        shown(opened, 20)
        assert opened.text("word") == "Following: track 7"
        assert (opened.text("measured"), opened.text("expected")) == ("10.0 px", "5.0 px")
        assert opened.text("size") == "25 px; wanted 30"
        assert opened.text("tracks") == "7"
        assert opened.js("[...document.querySelectorAll('#legend > span')].map((e) => e.textContent.trim())") == [
            "standing, 0.4 s",
            "following, 4.0 s",
        ]

    @pytest.mark.parametrize("width", [320, 390, 768, 1600])
    def test_it_fits_and_does_not_jump(self, browser, opened, width):
        browser.size(width, 800, mobile=width < 500)
        try:
            assert browser.js("document.documentElement.scrollWidth") <= width
            before = browser.js("document.documentElement.scrollHeight")
            browser.js("go(40)")
            shown(browser, 40)
            assert browser.js("document.documentElement.scrollHeight") == before
        finally:
            browser.size(1200, 900)

    def test_a_browser_that_cannot_play_the_film_says_so(self, browser, tmp_path):
        path = written(tmp_path)
        text = path.read_text().replace('id="film">AAAA', 'id="film">BBBB')
        path.write_text(text)
        browser.open(path.as_uri())
        until(lambda: "does not play H.264" in browser.text("notes"))
        browser.key("ArrowRight")
        shown(browser, 1)


def test_states_have_colours():
    style = run_file.render("run.html")
    for state in State:
        assert f".state-{state.split()[0]} {{ color" in style, state
