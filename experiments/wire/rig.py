"""An emulated rig in a process of its own, who switches its faults and knows its truth, and its exact calibration."""

import contextlib
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest import mock

import tomli_w

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, load_config
from cotarget.drivers import ptu_protocol, serial_line
from cotarget.errors import DeviceError
from cotarget.evaluation import true_calibration
from cotarget.sim.world import SimWorld

READY, CONTROL = "connects to them", "control "  # what the command says when it is up, and where its faults are
LONGEST_S = 3600  # an emulator whose parent was killed outright ends by itself then [s]
END_S = 15.0  # for a process to end when it is asked to [s]
ANSWER_S = 10.0  # for an answer of the control socket [s]
STOPS = 17  # focal lengths of the exact calibration; in between its spline is smoother than any lens
MOUNT = 1.6  # height of the fixed camera in every scene [m]


class EmulatedRig:
    """`cotarget emulate` of a simulated rig, until it is closed; a context manager.

    Args:
        folder: for its files.
        tables: of the simulated rig's rig.toml.

    Raises:
        DeviceError: it does not start.
    """

    def __init__(self, folder: Path, tables: Mapping[str, Any]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._sim, self._written = folder / "sim.toml", folder / "hardware.toml"
        self._sim.write_text(tomli_w.dumps(dict(tables)), encoding="utf-8")
        self.sim: RigConfig = load_config(self._sim)
        command = [sys.executable, "-m", "cotarget.cli", "emulate", "--rig", str(self._sim)]
        command += ["--write", str(self._written), "--seconds", str(LONGEST_S)]
        self._errors = (folder / "emulate.log").open("w+", encoding="utf-8")
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self._errors, text=True)
        try:
            self._said = self._socket_of_control()
        except BaseException:
            self.close()
            raise

    def rig_toml(self) -> Path:
        """The rig.toml that connects to it now: a head that was unplugged comes back under another name."""
        tables = tomllib.loads(self._written.read_text(encoding="utf-8"))
        tables["hardware"]["head"]["port"] = self.truth()["port"]
        self._written.write_text(tomli_w.dumps(tables), encoding="utf-8")
        return self._written

    def config(self) -> RigConfig:
        """The same, read."""
        return load_config(self.rig_toml())

    def truth(self) -> dict[str, Any]:
        """What is really so now."""
        return self._ask({"truth": True})

    def switch(self, fault: str, on: bool = True) -> None:
        """Switch a fault, named as device.fault."""
        self._ask({"fault": fault, "on": on})

    def close(self) -> None:
        """End it; more than once does no harm."""
        if hasattr(self, "_connection"):
            self._connection.close()
        end(self._process)
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()

    def __enter__(self) -> "EmulatedRig":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _socket_of_control(self) -> Any:
        assert self._process.stdout is not None
        address = ""
        for said in self._process.stdout:
            if said.startswith(CONTROL):
                address = said.split()[-1].removeprefix("socket://")
            if READY in said:
                host, _, port = address.rpartition(":")
                self._connection = socket.create_connection((host, int(port)), ANSWER_S)
                return self._connection.makefile("rw", encoding="utf-8")
        raise self._failure("did not start")

    def _ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        self._said.write(json.dumps(question) + "\n")
        self._said.flush()
        answer = self._said.readline()
        if not answer:
            raise self._failure("has ended")
        told: dict[str, Any] = json.loads(answer)
        if "error" in told:
            raise DeviceError(f"the emulated rig says: {told['error']}")
        return told

    def _failure(self, what: str) -> DeviceError:
        self._errors.seek(0)
        words = self._errors.read().strip().splitlines() or ["without a word"]
        return DeviceError(f"the emulated rig {what}: {words[-1]}")


def end(process: "subprocess.Popen[str]") -> None:
    """Ask it to end, and if that does not help, more. Not by Ctrl-C, which who runs in the background does not hear."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def exact_calibration(config: RigConfig) -> Calibration:
    """The exact calibration of a simulated rig, over the whole range of its lens."""
    return true_calibration(SimWorld(config, rendered=()), STOPS if config.sim.effects.optics else 1)


@dataclass
class Tap:
    """A serial port that notes what goes through it.

    Attributes:
        port: the real one.
        clock: the rig's.
        written: each piece that was sent, and when its first byte was [s].
        received: how many bytes came.
    """

    port: Any
    clock: Any
    written: list[tuple[float, bytes]] = field(default_factory=list)
    received: int = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.port, name)

    def read(self, size: int = 1, /) -> bytes:
        """What the port has."""
        data: bytes = self.port.read(size)
        self.received += len(data)
        return data

    def write(self, data: bytes, /) -> Any:
        """Send, and note it."""
        self.written.append((self.clock.now(), data))
        return self.port.write(data)


@contextlib.contextmanager
def tapped(clock: Any) -> Iterator[list[Tap]]:
    """While it lasts, each serial port that the driver of the head opens is tapped; the taps so far."""
    taps: list[Tap] = []

    def tap(name: str, baud: int) -> Any:
        taps.append(Tap(serial_line.open_port(name, baud), clock))
        return taps[-1]

    with mock.patch.object(ptu_protocol, "open_port", tap):
        yield taps


@contextlib.contextmanager
def beside(serve: Callable[..., None], *arguments: Any) -> Iterator[Any]:
    """Run a server in a process of its own, while it lasts; what it says first.

    Args:
        serve: gets a pipe and the arguments, says where it is, and ends when it is told something.
        arguments: must be fit for another process.

    Raises:
        DeviceError: it ended without a word.
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
        yield said
    finally:
        with contextlib.suppress(OSError):
            ours.send(None)
        process.join(END_S)
        ours.close()


def _ignoring_interrupts(serve: Callable[..., None], pipe: Connection, arguments: tuple[Any, ...]) -> None:
    """Ctrl-C reaches every process; this one ends when the one that started it says so, or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError):
        serve(pipe, *arguments)


def load() -> float:
    """How many processes wait for the machine's cores, over the last minute."""
    return os.getloadavg()[0]
