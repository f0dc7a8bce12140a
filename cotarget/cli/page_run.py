"""Steer a run from a page: the options, the demo that needs no files, and the session with its page."""

import argparse
import contextlib
import dataclasses
import ipaddress
import itertools
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, cast

from cotarget.cli.common import RIG, port
from cotarget.errors import ConfigError, CotargetError
from cotarget.safety.stop_file import refuse_if_stopped, session_stop_file

if TYPE_CHECKING:
    import socket

    from cotarget.config import RigConfig, SafetyConfig
    from cotarget.control.orders import Order
    from cotarget.pipeline import Run, Step
    from cotarget.recording.recorder import RecordedRig, Recorder
    from cotarget.rig import Rig, RigSpec

DEMO = "bird"  # target of the demo
HARDWARE = "hardware"


def add_page(parser: argparse.ArgumentParser) -> None:
    """Add the options of the page."""
    about = f"serve a page to steer the run from; without {RIG} in the folder, it shows a simulated {DEMO}"
    parser.add_argument("--page", action="store_true", help=about)
    parser.add_argument("--page-port", type=port, metavar="P", help="port of the page; 0: any free one (8080)")
    about = "name or address of this machine to serve at; without it only this machine reaches the page"
    parser.add_argument("--page-host", metavar="HOST", help=about)


def check_page(options: argparse.Namespace) -> None:
    """Refuse options that only a page has, without one."""
    for name in ("port", "host"):
        if not options.page and getattr(options, f"page_{name}") is not None:
            raise ConfigError(f"--page-{name}: needs --page")


def is_demo(options: argparse.Namespace) -> bool:
    """Whether the page is asked for in a folder without a rig.toml, and no other is named."""
    return options.page and options.rig == RIG and not RIG.exists()


def demo_config(options: argparse.Namespace) -> "RigConfig":
    """Make the configuration of the demo's rig."""
    from cotarget.demo import SCENES, sim_config

    if options.calibration is not None:
        raise ConfigError(f"--calibration: there is no {RIG} here, and the demo's rig has its true calibration")
    name = options.target or DEMO
    if name not in SCENES:
        raise ConfigError(f"--target: there is no {RIG} here; the demo has one of: {', '.join(sorted(SCENES))}")
    print(f"cotarget follow: there is no {RIG} here; this is the simulated {name} of the demo", file=sys.stderr)
    return sim_config(SCENES[name], (name,), 0)


class PageRun:
    """The page of one run: its socket, its stop file, and the session.

    Args:
        options: the command's options.
        config: configuration of the rig.
        spec: the rig, as its configuration describes it.

    Attributes:
        safety: what the safety layer keeps; a simulation's stop file is the session's alone.
    """

    def __init__(self, options: argparse.Namespace, config: "RigConfig", spec: "RigSpec") -> None:
        from cotarget.page.server import LOOPBACK, PORT, listen

        self._options, self._config = options, config
        self._stop_file: Path | None = config.safety.stop_file
        if self._stop_file is None and config.backend != HARDWARE:
            self._stop_file = session_stop_file(options.rig)
        refuse_if_stopped(self._stop_file)
        self.safety: SafetyConfig = config.safety
        if not spec.real_time and config.backend != HARDWARE:
            self.safety = dataclasses.replace(config.safety, stop_file=None)
        self._host = options.page_host or LOOPBACK
        self._listener: socket.socket = listen(self._host, PORT if options.page_port is None else options.page_port)

    def close(self) -> None:
        """Close the socket."""
        self._listener.close()

    def operated(
        self, recordings: "Recordings", make_run: "Callable[[Rig], Run]", seconds: float
    ) -> "Callable[[Rig, Run], Iterator[Step]]":
        """Make the function that yields the steps of a run under the page's operators."""
        from cotarget.operate.session import Session
        from cotarget.page.server import Page

        def steps(rig: "Rig", run: "Run") -> "Iterator[Step]":
            follow = self._config.follow
            recordings.make_run = lambda: make_run(rig)
            session = Session(rig, run, self._stop_file, follow, time.monotonic, recordings)
            with Page(session, self._listener, self._host) as page:
                self._announce(page.link, follow.unattended)
                try:
                    for step in paced(session.steps(seconds), rig.spec.real_time, time.monotonic, time.sleep):
                        page.show(step, rig.spec)
                        yield step
                except KeyboardInterrupt as error:
                    recordings.interrupt = error
                    raise

        return steps

    def _announce(self, link: str, unattended: str) -> None:
        """Print the link, and what it means."""
        address, number = self._listener.getsockname()[:2]
        for line in announcement(link, unattended, self._host, address, number):
            print(f"cotarget follow: {line}", file=sys.stderr, flush=True)


def announcement(link: str, unattended: str, host: str, address: str, number: int) -> list[str]:
    """List what is said of a page at its start: its link, and what it means.

    Args:
        link: its link.
        unattended: what happens when the last page closes, of [follow] in rig.toml.
        host: name at which it is served.
        address: address of that name; beyond loopback others can read what is sent.
        number: number of the port.
    """
    goes_on = "following goes on" if unattended == "follow" else "the head stands"
    lines = [
        f"open {link}",
        f"the head stands until the page says otherwise; when the last page closes, {goes_on}: "
        f'[follow] unattended = "{unattended}"',
    ]
    if not ipaddress.ip_address(address).is_loopback:
        lines.append(
            "there is no encryption: who can read this network can read pictures and token, and steer; safer is, "
            f"without --page-host: ssh -L {number}:127.0.0.1:{number} {host}, and the link on your machine"
        )
    return lines


class Recordings(contextlib.AbstractContextManager["Recordings", None]):
    """The recordings of a session, one after another; the last ends with the session.

    Args:
        first: folder of the recording that begins with the session; None for none.
        make: makes the recorder of a folder.

    Attributes:
        folder: folder of the recording; empty while nothing is recorded.
        make_run: makes a new run on the open rig.
        interrupt: the Ctrl-C that cut the last step short; a replay does not miss commands after it then.
    """

    def __init__(self, first: Path | None, make: "Callable[[Path], Recorder]") -> None:
        self.folder, self.make_run = "", cast("Callable[[], Run]", None)
        self.interrupt: KeyboardInterrupt | None = None
        self._base, self._make = first or Path("recording"), make
        self._recorder: Recorder | None = None
        self._rig: RecordedRig | None = None
        self._completing: list[threading.Thread] = []
        if first is not None:
            self._take(first)

    def wrap(self, rig: "Rig") -> "Rig":
        """Return the rig with devices that can be recorded; closing it closes the rig."""
        from cotarget.recording.recorder import RecordedRig

        self._rig = RecordedRig(rig)
        if self._recorder is not None:
            self._recorder.begin(self._rig)
        return self._rig.devices

    def with_refusals(self, rig: "Rig") -> "Rig":
        """Return the guarded rig whose refused moves are recorded too."""
        assert self._rig is not None, "it is wrapped before it is guarded"
        return self._rig.with_refusals(rig)

    def add(self, order: "Order") -> None:
        """Record an order, if anything is recorded."""
        if self._recorder is not None:
            self._recorder.add(order)

    def begin(self) -> "Run":
        """Record to the next free folder, from a new run on.

        Raises:
            ConfigError: the folder cannot be written.
        """
        assert self._rig is not None, "the rig is open"
        names = (self._base.with_name(f"{self._base.name}-{n}") for n in itertools.count(2))
        self._take(next(name for name in itertools.chain([self._base], names) if not name.exists()))
        assert self._recorder is not None, "it was made"
        self._recorder.begin(self._rig)
        return self.make_run()

    def end(self) -> None:
        """Complete the recording, while the run goes on."""
        if self._rig is not None and self._recorder is not None:
            self._rig.end()
            thread = threading.Thread(target=_complete, args=(self._recorder,), name="cotarget-end-of-recording")
            self._completing.append(thread)
            self._recorder, self.folder = None, ""
            thread.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete all recordings, after the rig was closed."""
        for thread in self._completing:
            thread.join()
        if kind is None and self.interrupt is not None:
            kind, error = KeyboardInterrupt, self.interrupt
        if self._recorder is not None:
            self._recorder.__exit__(kind, error, trace)

    def _take(self, folder: Path) -> None:
        self._recorder, self.folder = self._make(folder), str(folder)


def _complete(recorder: "Recorder") -> None:
    """Write the rest of a recording, whatever becomes of it."""
    try:
        recorder.__exit__(None, None, None)
    except CotargetError as error:
        print(f"cotarget follow: {error}", file=sys.stderr)


def paced(
    steps: "Iterator[Step]", real_time: bool, now: Callable[[], float], sleep: Callable[[float], None]
) -> "Iterator[Step]":
    """Yield steps no faster than in real time; a slow machine does not catch up afterwards."""
    ahead = math.inf  # lead of the rig's clock over the wall clock
    for step in steps:
        yield step
        if real_time:
            continue
        ahead = min(ahead, step.t - now())
        if (wait := step.t - ahead - now()) > 0:
            sleep(wait)
