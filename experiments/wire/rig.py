"""What the experiments on the wire share: servers in other processes, taps on the serial line, an exact calibration."""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any
from unittest import mock

from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.drivers import ptu_protocol, serial_line
from cotarget.errors import DeviceError
from cotarget.evaluation import true_calibration
from cotarget.sim.world import SimWorld

END_S = 15.0  # timeout of a process's end [s]
STOPS = 17  # zoom samples of the exact calibration; its spline between them is smoother than any lens
MOUNT = 1.6  # height of the fixed camera in every scene [m]


def exact_calibration(config: RigConfig) -> Calibration:
    """Give the exact calibration of a simulated rig over the whole range of its lens."""
    return true_calibration(SimWorld(config, rendered=()), STOPS if config.sim.effects.optics else 1)


@dataclass
class Tap:
    """Serial port that records its traffic."""

    port: Any  # real port
    clock: Any  # clock of the rig
    # Each piece that was sent, with the time of its first byte [s].
    written: list[tuple[float, bytes]] = field(default_factory=list)
    received: int = 0  # number of bytes received

    def __getattr__(self, name: str) -> Any:
        return getattr(self.port, name)

    def read(self, size: int = 1, /) -> bytes:
        """Read from the port."""
        data: bytes = self.port.read(size)
        self.received += len(data)
        return data

    def write(self, data: bytes, /) -> Any:
        """Write to the port, and record it."""
        self.written.append((self.clock.now(), data))
        return self.port.write(data)


@contextlib.contextmanager
def tapped(clock: Any) -> Iterator[list[Tap]]:
    """Tap each serial port that the head's driver opens inside the block; yield the taps so far."""
    taps: list[Tap] = []

    def tap(name: str, baud: int) -> Any:
        taps.append(Tap(serial_line.open_port(name, baud), clock))
        return taps[-1]

    with mock.patch.object(ptu_protocol, "open_port", tap):
        yield taps


@contextlib.contextmanager
def beside(serve: Callable[..., None], *arguments: Any) -> Iterator[Any]:
    """Run a server in another process inside the block; yield its first message. As `talking`, without the pipe."""
    with talking(serve, *arguments) as (said, _):
        yield said


@contextlib.contextmanager
def talking(serve: Callable[..., None], *arguments: Any) -> Iterator[tuple[Any, Connection]]:
    """Run a server in another process inside the block; yield its first message and the pipe to it.

    The server gets a pipe and the arguments, sends its address, and ends when it receives None.

    Raises:
        DeviceError: the process ended without a message.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_ignoring_interrupts, args=(serve, theirs, arguments), daemon=True)
    process.start()
    theirs.close()
    try:
        try:
            said = ours.recv()
        except EOFError:
            raise DeviceError("an emulated device did not start") from None
        yield said, ours
    finally:
        with contextlib.suppress(OSError):
            ours.send(None)
        process.join(END_S)
        ours.close()


def _ignoring_interrupts(serve: Callable[..., None], pipe: Connection, arguments: tuple[Any, ...]) -> None:
    """Run the server without reaction to Ctrl-C, which reaches every process; its parent ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError):
        serve(pipe, *arguments)


def load() -> float:
    """Give the average number of processes that wait for a core, over the last minute."""
    return os.getloadavg()[0]
