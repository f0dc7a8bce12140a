"""Whether the page of a run keeps up: pictures in a browser, its orders on the wire, and what browsers cost the run.

Headless Chromium is the browser. Its pictures are timed from when a step is done until they are drawn: with nothing
else at work; beside a run that follows in films of 640x480, which another process sends in real time as an emulated
Axis server does, with the head emulated there too; and beside a run on the emulated rig, which renders. A click and a
Stop are timed from the browser's own event until the first byte of the order on the head's line, in whatever the run
does then. On the emulated rig an arrow key turns the head until Stop; the emulator's true angles tell when it stands.
The turns of the run, from a frame's arrival to the end of its step, are compared with no browser and with
ten, of which one reads nothing and one is Chromium. All of it stands on one machine: its load is printed.

`--set page.soak_s=600` follows in the films for so long with the page open, and gives the frames on the wire that are
neither worked on nor counted as skipped, and the memory of the last minute over that of the first.
"""

import asyncio
import contextlib
import itertools
import json
import logging
import math
import multiprocessing
import os
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from benchmarks.chromium import Browser, find, until
from benchmarks.frame_sizes import RATE_HZ, film
from benchmarks.pipeline_speed import calibration_of
from benchmarks.real_time import serve
from cotarget import backends
from cotarget.calibration import Calibration
from cotarget.config import DEFAULT_TARGETS, FollowConfig, RigConfig, SafetyConfig, TargetProfile
from cotarget.drivers.axis import AxisCamera, AxisSettings
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.ptu_d46 import D46Head, D46Settings
from cotarget.operate.session import Session
from cotarget.page.html import render
from cotarget.page.server import LOOPBACK, Page, listen
from cotarget.pipeline import Run, State, Step
from cotarget.rig import Board, Camera, Clock, Frame, HeadSpec, PanTiltState, Rig, ZoomState
from cotarget.safety import watchdog
from cotarget.safety.safe_rig import guard
from experiments.engine import Count, Row, Settings
from experiments.wire.process import EmulatedRig
from experiments.wire.rig import Tap, beside, exact_calibration, load, tapped

SIZE = (640, 480)
OTHERS = 9  # browsers beside Chromium, of which the first reads nothing
BLOCKS = 6  # of turns, without browsers and with them in turns
LONGEST_S = 4500.0  # of the films [s]
SETTLE_S = 0.3  # until what an order has moved stands
SETTLED_S = 2.0  # until the browser has compiled the page's code
HELD_S, SPEED_S, STANDS_S = 1.2, 0.2, 1.0  # a key is held; the end of it that gives the speed; until the head stands
EVERY_S = 0.004  # between two looks at the emulator's angles
MINUTE = 60  # samples of memory
GOES = re.compile(rb"(?:^| )[PT]P-?\d")  # a position that a D46 is sent to
HALTS = re.compile(rb"(?:^| )H ")
# When a picture was drawn, by its number; the page draws it in the same callback.
NOTE_DRAWN = """
window.drawn = [];
const toldBefore = tell;
tell = (table) => { toldBefore(table); window.drawn.push(Date.now() - 1000 * table.made); };
"""
# `drawnAt` is since the navigation began.
NOTE_FIRST = """
const first = setInterval(() => {
  try { if (drawnAt) { window.firstDrawn = drawnAt; clearInterval(first); } } catch { /* not there yet */ }
}, 1);
"""
STOP = "(() => { const t = Date.now(); document.getElementById('stop').click(); return t; })()"
CLICK = """(() => {
  const place = document.getElementById('fixed'), box = place.getBoundingClientRect(), [, u, v] = newest.tracks[0];
  const [width, height] = newest.cameras.fixed.size, t = Date.now();
  place.dispatchEvent(new MouseEvent('click', {
    clientX: box.left + (u + 0.5) / width * box.width, clientY: box.top + (v + 0.5) / height * box.height,
  }));
  return t;
})()"""
# Goals: a picture's way [ms] by what runs beside it, an order's way [ms], the turn's ratio, and the page.
DRAWN_MS = {"nothing": 40.0, "films": 60.0, "rendered": 250.0}
CLICK_MS, STOP_MS = 1e3 / RATE_HZ + 60, 60.0
REST_MS = 50.0  # beyond the head's own delay and braking
RATIO, BYTES, FIRST_MS, GROWTH = 1.3, 60_000, 500.0, 1.05


@dataclass(frozen=True)
class PageSettings(Settings):
    """Settings: seconds of pictures, of a block of turns and of the soak; times to open the page; orders of a kind."""

    seeds: Count = 1
    seconds: float = 20.0
    block_s: float = 6.0
    opened: Count = 5
    orders: Count = 40
    rendered: bool = True
    soak_s: float = 0.0


def needs(settings: PageSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    return "" if find() else "needs Chromium: apt-get install chromium"


def one(settings: PageSettings, seed: int) -> list[Row]:
    """Time pictures beside each, then orders and turns; give a row for each."""
    rows: list[Row] = [{"figure": "bytes", "value": len(render("page.html").encode())}]
    with tempfile.TemporaryDirectory() as folder, Browser(Path(folder)) as browser, _stops_unreported():
        browser.size(1200, 900)
        browser.call("Network.disable")  # each picture would be reported here too
        rows += _beside_nothing(settings, browser)
        rows += _beside_films(settings, browser)
        if settings.rendered:
            rows += _beside_rendering(settings, browser, Path(folder) / "emulated", seed)
    return [row | {"seed": seed, "load": load()} for row in rows]


@contextlib.contextmanager
def _stops_unreported() -> Iterator[None]:
    """Keep the warning of each Stop off stderr, where they are given on purpose; errors stay."""
    log = logging.getLogger(watchdog.__name__)
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


# Pictures


def _beside_nothing(settings: PageSettings, browser: Browser) -> list[Row]:
    """Open the page, and time pictures of a film that no run works on."""
    spec = backends.describe(RigConfig())
    frames = [frame for frame, _ in film(SIZE, 50, 0)]
    leave = threading.Event()

    def show(page: Page) -> None:
        for n in itertools.count():
            if leave.wait(1 / RATE_HZ):
                return
            page.show(_idle_step(n, frames[n % len(frames)]), spec)

    with Page(cast(Session, _Idle()), listen(LOOPBACK, 0)) as page, ThreadPoolExecutor(1) as other:
        showing = other.submit(show, page)
        try:
            rows = [{"figure": "first", "value": _first_ms(browser, page)} for _ in range(settings.opened)]
            return [*rows, *_drawn(browser, "nothing", settings.seconds)]
        finally:
            leave.set()
            showing.result()


class _Idle:
    """A session without a run."""

    control: str | None = None
    stopped, recording, notice = None, "", ""

    def take(self, who: str) -> None:
        self.control = who

    def leave(self, who: str) -> None:
        """Let nothing move."""

    def left_alone(self) -> None:
        """Let nothing move."""


def _idle_step(n: int, frame: Frame) -> Step:
    return Step(
        index=n, t=frame.t, state=State.STANDING, reason="", fixed=frame, zoom=frame, mask=None, detections=(),
        tracks=(), target=None, aim=None, commanded=(0.0, 0.0, 700.0), head=PanTiltState(0.0, 0.0, False, 0.0),
        lens=ZoomState(700.0, False, 0.0),
    )  # fmt: skip


def _first_ms(browser: Browser, page: Page) -> float:
    """Open the link; return the time until the first picture is drawn [ms]."""
    browser.open("about:blank")
    script = browser.call("Page.addScriptToEvaluateOnNewDocument", source=NOTE_FIRST)["identifier"]
    browser.open(page.link)
    first = float(until(lambda: browser.js("window.firstDrawn ?? 0")))
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
    return first


def _drawn(browser: Browser, what: str, seconds: float) -> list[Row]:
    """Time the pictures of the open page; give a row for each, and one for their rate."""
    until(lambda: browser.js("document.getElementById('fixed')?.dataset.n >= 0"))
    time.sleep(SETTLED_S)
    browser.js(NOTE_DRAWN)
    time.sleep(seconds)
    ways = browser.js("window.drawn")
    rows: list[Row] = [{"figure": "drawn", "beside": what, "value": way} for way in ways]
    return [*rows, {"figure": "rate", "beside": what, "value": len(ways) / seconds}]


# A run with a page


class _Timed:
    """A fixed camera that notes when its newest frame has arrived."""

    def __init__(self, camera: Camera) -> None:
        self._camera, self.read_t = camera, 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Read a frame."""
        frame = self._camera.read(newer_than, timeout)
        self.read_t = time.perf_counter()
        return frame


@dataclass
class Operated:
    """A run with a page.

    Attributes:
        page: the page.
        turns: times of the run's steps from the frame's arrival to the end [s].
        newest: time of the newest step's frame [s], and how many were worked on or counted as skipped until then.
    """

    page: Page
    turns: list[float] = field(default_factory=list)
    newest: tuple[float, int] = (0.0, 0)


def _operate(
    rig: Rig, calibration: Calibration, target: TargetProfile, act: Callable[[Operated], list[Row]], folder: Path
) -> list[Row]:
    """Run on a rig with a page until another thread has acted on it; return what that gives."""
    timed, stop_file = _Timed(rig.fixed), folder / "rig.stop"
    safety = SafetyConfig(stop_file=stop_file, watchdog_s=2.0)
    with guard(replace(rig, fixed=cast(Camera, timed)), safety) as safe:
        session = Session(safe, Run(safe, calibration, target), stop_file, FollowConfig(), time.monotonic)
        with Page(session, listen(LOOPBACK, 0)) as page, ThreadPoolExecutor(1) as other:
            operated = Operated(page)
            acting = other.submit(act, operated)
            for step in session.steps(float("inf")):
                page.show(step, safe.spec)
                operated.turns.append(time.perf_counter() - timed.read_t)
                operated.newest = step.fixed.t, operated.newest[1] + 1 + step.skipped
                if acting.done():
                    return acting.result()
    raise AssertionError("a run without an end has ended")


def _beside_films(settings: PageSettings, browser: Browser) -> list[Row]:
    """Follow in films that come in real time: pictures, orders, and turns."""
    target = replace(DEFAULT_TARGETS["bird"], detector="auto")
    with tempfile.TemporaryDirectory() as folder, tapped(_WallClock()) as taps, _film_rig() as (rig, carried):

        def act(operated: Operated) -> list[Row]:
            link = operated.page.link
            rows = _follow_and_draw(browser, link, "films", settings.seconds)
            rows += _orders(browser, taps, settings.orders)
            browser.open("about:blank")
            rows += _turns(browser, operated, settings.block_s)
            return rows + (_soak(browser, operated, taps, carried, settings.soak_s) if settings.soak_s else [])

        return _operate(rig, calibration_of(SIZE), target, act, Path(folder))


def _beside_rendering(settings: PageSettings, browser: Browser, folder: Path, seed: int) -> list[Row]:
    """Follow on the emulated rig, which another process renders."""
    tables = {"sim": {"scene": "outdoor", "targets": ["bird"], "seed": seed}}
    with EmulatedRig(folder, tables) as emulated:
        config = emulated.config()
        with backends.open_rig(config, guarded=False, file=emulated.hardware_toml) as rig:

            def act(operated: Operated) -> list[Row]:
                rows = _follow_and_draw(browser, operated.page.link, "rendered", settings.seconds)
                return rows + _rests(browser, emulated, rig.spec.head, settings.orders)

            return _operate(rig, exact_calibration(emulated.sim), config.target("bird"), act, folder)


def _follow_and_draw(browser: Browser, link: str, what: str, seconds: float) -> list[Row]:
    _open_and_follow(browser, link)
    return _drawn(browser, what, seconds)


def _open_and_follow(browser: Browser, link: str) -> None:
    browser.open("about:blank")
    browser.open(link)
    until(lambda: browser.text("control") == "You have control.")
    browser.click("follow")


class _WallClock:
    """The time of day, which a browser on the same machine has too."""

    def now(self) -> float:
        return time.time()


class _FilmZoom:
    """A camera with a lens that is at once where it is sent."""

    def __init__(self, camera: AxisCamera, focal_range: tuple[float, float], clock: Clock) -> None:
        self._camera, self._clock = camera, clock
        self.focal_range, self._focal_px = focal_range, focal_range[0]
        self.size = self.still_size = camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        return self._camera.read(newer_than, timeout)

    def capture(self) -> Frame:
        return self.read()

    def zoom(self, focal_px: float) -> float:
        self._focal_px = float(np.clip(focal_px, *self.focal_range))
        return self._focal_px

    def state(self) -> ZoomState:
        return ZoomState(self._focal_px, False, self._clock.now())


@contextlib.contextmanager
def _film_rig() -> Iterator[tuple[Rig, Any]]:
    """Open a rig of drivers whose cameras show a film, with an emulated head; yield when frames were sent, too."""
    frames = int(LONGEST_S * RATE_HZ)
    sent, carried = (
        multiprocessing.get_context("spawn").Array("d", [0.0, *[np.inf] * frames], lock=False) for _ in range(2)
    )
    clock = MonotonicClock()
    with beside(serve, frames, sent, SIZE, carried) as (url, port), contextlib.ExitStack() as opened:
        settings = AxisSettings(url=url, size=SIZE, resolution="", latency_s=0.0)
        fixed, zoom = (
            opened.enter_context(contextlib.closing(AxisCamera(replace(settings, camera=number), clock)))
            for number in (1, 2)
        )
        head = opened.enter_context(contextlib.closing(D46Head(D46Settings(port=port), clock)))
        fixed.read()
        sent[0] = clock.now()
        described = backends.describe(RigConfig())
        spec = replace(described, fixed=settings.spec, head=replace(described.head, limits=head.limits), real_time=True)
        lens = _FilmZoom(zoom, described.zoom.focal_range, clock)
        yield Rig(fixed, lens, head, clock, cast(Board, SimpleNamespace()), spec, lambda: None), carried


# Orders on the wire


def _orders(browser: Browser, taps: Sequence[Tap], count: int) -> list[Row]:
    """Give orders by the page again and again; give a row for each with its time to the head's line [ms]."""
    rng = np.random.default_rng(0)
    rows: list[Row] = []
    for _ in range(count):
        _press(browser, "home")
        until(lambda: browser.text("word") == "Standing" and browser.js("newest.tracks.length > 0"))
        time.sleep(SETTLE_S + rng.uniform(0, 1 / RATE_HZ))
        rows.append({"figure": "click", "value": _on_the_wire(browser.js(CLICK), GOES, taps)})
        until(lambda: browser.text("word").startswith("Following"))
        time.sleep(SETTLE_S + rng.uniform(0, 1 / RATE_HZ))
        rows.append({"figure": "stop", "value": _on_the_wire(browser.js(STOP), HALTS, taps)})
        until(lambda: browser.text("word") == "Stopped")
        _press(browser, "clear")
        until(lambda: browser.text("word") != "Stopped")
    return rows


def _press(browser: Browser, name: str) -> None:
    until(lambda: not browser.js(f"document.getElementById('{name}').disabled"))
    browser.click(name)


def _on_the_wire(begun_ms: float, order: "re.Pattern[bytes]", taps: Sequence[Tap]) -> float:
    """Return the time from the browser's event [ms since 1970] to the order on the head's line [ms]."""

    def sent() -> float | None:
        times = (t for tap in taps for t, data in list(tap.written) if 1e3 * t >= begun_ms and order.search(data))
        return min(times, default=None)

    return 1e3 * until(sent) - begun_ms  # type: ignore[operator]  # it waits until there is one


def _rests(browser: Browser, emulated: EmulatedRig, head: HeadSpec, count: int) -> list[Row]:
    """Turn by a held key until Stop, again and again; give a row for each with the time until the head stands.

    That is from the browser's event, less the head's own delay and its braking from the speed that it had [ms].
    """
    assert head.limits.pan.acceleration is not None
    rows: list[Row] = []
    for number in range(count):
        _press(browser, "home")
        until(lambda: browser.text("word") == "Standing")
        arrow = ("ArrowLeft", "ArrowRight")[number % 2]
        browser.key(arrow, "keyDown")
        before = _pans(emulated, HELD_S)
        begun = time.monotonic() + browser.js(STOP) / 1e3 - time.time()
        after = _pans(emulated, STANDS_S)
        browser.key(arrow, "keyUp")
        t, pan = np.transpose(before)
        late = t > t[-1] - SPEED_S
        speed = abs(float(np.polyfit(t[late], pan[late], 1)[0]))
        stood = next((at for at, pan in reversed(after) if pan != after[-1][1]), begun)
        own = head.delay_s + math.radians(speed) / head.limits.pan.acceleration
        rows.append({"figure": "rest", "value": 1e3 * (stood - begun - own), "speed": speed})
        until(lambda: browser.text("word") == "Stopped")
        _press(browser, "clear")
        until(lambda: browser.text("word") != "Stopped")
    return rows


def _pans(emulated: EmulatedRig, seconds: float) -> list[tuple[float, float]]:
    """Look at the head for so long; give times of the monotonic clock [s] and true pan angles [degrees]."""
    poses = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        truth = emulated.truth()
        poses.append((truth["t"], truth["pan_deg"]))
        time.sleep(EVERY_S)
    return poses


# Turns


def _turns(browser: Browser, operated: Operated, block_s: float) -> list[Row]:
    """Time turns without browsers and with ten in turns; give a row for each."""
    rows: list[Row] = []
    for block in range(BLOCKS):
        link = operated.page.link
        if with_browsers := block % 2 == 1:
            browser.open(link)
            until(lambda: browser.js("document.getElementById('fixed')?.dataset.n >= 0"))
        with beside(browse, link) if with_browsers else contextlib.nullcontext():
            time.sleep(1.0)
            first = len(operated.turns)
            time.sleep(block_s)
            turns = operated.turns[first:]
        if with_browsers:
            browser.open("about:blank")
        count = OTHERS + 1 if with_browsers else 0
        rows += [{"figure": "turn", "browsers": count, "value": 1e3 * turn} for turn in turns]
    return rows


def browse(pipe: Connection, link: str) -> None:
    """Be `OTHERS` browsers that draw at once what comes, but for the first, which reads nothing."""
    asyncio.run(_browse(pipe, link))


async def _browse(pipe: Connection, link: str) -> None:
    from websockets.asyncio.client import connect

    address, _, token = link.partition("/#")
    at = address.removeprefix("http://")
    async with contextlib.AsyncExitStack() as opened:
        readers = []
        for number in range(OTHERS):
            how = {"origin": address, "compression": None, "max_size": None, "max_queue": 1}
            socket = await opened.enter_async_context(connect(f"ws://{at}/socket", **cast(Any, how)))
            await socket.send(json.dumps({"do": "hello", "token": token, "who": f"browser {number}"}))
            if number:
                readers.append(asyncio.create_task(_read(socket)))
        pipe.send(len(readers))
        await asyncio.to_thread(pipe.recv)
        for reader in readers:
            reader.cancel()


async def _read(socket: Any) -> None:
    async for data in socket:
        if isinstance(data, bytes):
            await socket.send(json.dumps({"do": "drawn", "n": 0}))


# A long run


def _soak(
    browser: Browser, operated: Operated, taps: Sequence[Tap], carried: Sequence[float], seconds: float
) -> list[Row]:
    """Follow for long with the page open; give the frames that are not accounted for, and the growth of memory.

    The newest frame may have been sent and not worked on yet when it is looked at, which the least of many looks is
    free of.
    """
    _open_and_follow(browser, operated.page.link)
    time.sleep(SETTLED_S)
    resident, on_the_wire, missing = [], [], []
    for _ in range(round(seconds)):
        time.sleep(1.0)
        operated.turns.clear()  # what is noted here is no growth of the program
        for tap in taps:
            tap.written.clear()
        t, accounted = operated.newest
        on_the_wire.append(int(np.count_nonzero(np.asarray(carried) <= t)))
        missing.append(on_the_wire[-1] - accounted)
        resident.append(int(Path("/proc/self/statm").read_text().split()[1]))
        assert browser.js("performance.now() - drawnAt < 2000"), "the page shows no new pictures"
    growth = np.median(resident[-MINUTE:]) / np.median(resident[:MINUTE])
    return [
        {"figure": "soak", "what": "sent", "value": float(on_the_wire[-1] - on_the_wire[0])},
        {"figure": "soak", "what": "not_accounted", "value": float(min(missing[-MINUTE:]) - min(missing[:MINUTE]))},
        {"figure": "soak", "what": "memory_ratio", "value": float(growth)},
    ]


# Figures


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give median and 95 % of each time [ms], rates [Hz], the turns' ratio, the page's bytes and the load."""

    def values(figure: str, **which: Any) -> list[float]:
        return [row["value"] for row in rows if row["figure"] == figure and which.items() <= row.items()]

    def percentiles(times: Sequence[float]) -> dict[str, float]:
        p50, p95 = np.percentile(times, (50, 95)).tolist()
        return {"p50_ms": p50, "p95_ms": p95, "number": len(times)}

    found: dict[str, dict[str, float]] = {
        "page": {"bytes": values("bytes")[0], "first_ms": float(np.max(values("first")))}
    }
    for what in DRAWN_MS:
        if ways := values("drawn", beside=what):
            rate_hz = float(np.median(values("rate", beside=what)))
            found[f"drawn beside {what}"] = percentiles(ways) | {"rate_hz": rate_hz}
    found |= {figure: percentiles(values(figure)) for figure in ("click", "stop")}
    if rests := values("rest"):
        speeds = [row["speed"] for row in rows if row["figure"] == "rest"]
        found["rest"] = percentiles(rests) | {"speed_deg_s": float(np.median(speeds))}
    alone, many = (percentiles(values("turn", browsers=count)) for count in (0, OTHERS + 1))
    found["turn"] = {
        "alone_p95_ms": alone["p95_ms"],
        "ten_browsers_p95_ms": many["p95_ms"],
        "ratio": many["p95_ms"] / alone["p95_ms"],
    }
    if soak := [row for row in rows if row["figure"] == "soak"]:
        found["soak"] = {row["what"]: row["value"] for row in soak}
    return found | {"machine": {"load": float(np.max([row["load"] for row in rows])), "cores": os.cpu_count() or 0}}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the goals that are not reached."""
    reached = {
        "page": summary["page"]["bytes"] <= BYTES and summary["page"]["first_ms"] <= FIRST_MS,
        "click": summary["click"]["p95_ms"] <= CLICK_MS,
        "stop": summary["stop"]["p95_ms"] <= STOP_MS,
        "turn": summary["turn"]["ratio"] <= RATIO,
    } | {
        f"drawn beside {what}": found["p95_ms"] <= most
        for what, most in DRAWN_MS.items()
        if (found := summary.get(f"drawn beside {what}"))
    }
    if rest := summary.get("rest"):
        reached["rest"] = rest["p95_ms"] <= REST_MS
    if soak := summary.get("soak"):
        reached["soak"] = abs(soak["not_accounted"]) < 1 and soak["memory_ratio"] <= GROWTH
    return [name for name, well in reached.items() if not well]


SETTINGS = PageSettings()
QUICK = replace(SETTINGS, seconds=2.0, block_s=0.5, opened=1, orders=2, rendered=False)
ALONE = True
COST_S = 240.0
