"""Emulated rig in another process, with its faults, its ground truth and its exact calibration."""

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

from cotarget.backends import load_config
from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.drivers import ptu_protocol, serial_line
from cotarget.errors import DeviceError
from cotarget.evaluation import true_calibration
from cotarget.sim.world import SimWorld

READY, CONTROL = "connects to them", "control "  # output when it is ready, and prefix of the control socket
LONGEST_S = 3600  # lifetime of an emulator whose parent was killed [s]
END_S = 15.0  # timeout of a process's end [s]
ANSWER_S = 10.0  # timeout of the control socket's answer [s]
STOPS = 17  # zoom samples of the exact calibration; its spline between them is smoother than any lens
MOUNT = 1.6  # height of the fixed camera in every scene [m]


class EmulatedRig:
    """Process of `cotarget emulate` with a simulated rig, until it is closed; a context manager.

    Args:
        folder: folder for its files.
        tables: tables of the simulated rig's rig.toml.

    Raises:
        DeviceError: the process does not start.
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
        """Path of the rig.toml that connects to it now; a head that was unplugged returns under another name."""
        tables = tomllib.loads(self._written.read_text(encoding="utf-8"))
        tables["hardware"]["head"]["port"] = self.truth()["port"]
        self._written.write_text(tomli_w.dumps(tables), encoding="utf-8")
        return self._written

    def config(self) -> RigConfig:
        """Configuration from that rig.toml."""
        return load_config(self.rig_toml())

    def truth(self) -> dict[str, Any]:
        """Give the current ground truth."""
        return self._ask({"truth": True})

    def switch(self, fault: str, on: bool = True) -> None:
        """Switch a fault, named as device.fault."""
        self._ask({"fault": fault, "on": on})

    def close(self) -> None:
        """End the process; safe to call more than once."""
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
    """Terminate a process, then kill it if needed; not by SIGINT, which background processes ignore."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def exact_calibration(config: RigConfig) -> Calibration:
    """Give the exact calibration of a simulated rig over the whole range of its lens."""
    return true_calibration(SimWorld(config, rendered=()), STOPS if config.sim.effects.optics else 1)


@dataclass
class Tap:
    """Serial port that records its traffic.

    Attributes:
        port: real port.
        clock: clock of the rig.
        written: each piece that was sent, with the time of its first byte [s].
        received: number of bytes received.
    """

    port: Any
    clock: Any
    written: list[tuple[float, bytes]] = field(default_factory=list)
    received: int = 0

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
    """Run a server in another process inside the block; yield its first message.

    Args:
        serve: function that gets a pipe and the arguments, sends its address, and ends when it receives something.
        arguments: arguments that can be pickled.

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
        yield said
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
