"""The emulated rig in a child process, for tests and experiments."""

import json
import os
import socket
import subprocess
import sys
import threading
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from cotarget.config import RigConfig, config_of, read_text
from cotarget.emulators.serve import Closes
from cotarget.errors import DeviceError

READY = "connects to them"  # in the last line of output
LONGEST_S = 3600  # lifetime of an emulator whose parent was killed [s]
START_S = 120.0  # time limit to start, on a machine that is busy with other things [s]
END_S = 15.0  # time limit to end [s]
ANSWER_S = 60.0  # time limit for an answer of the control socket [s]


class EmulatedRig(Closes):
    """`cotarget emulate` in a child process, until it is closed; a context manager.

    Args:
        folder: for its files; made if needed.
        tables: of the simulated rig's rig.toml.
        options: further ones of the command.
        environment: further variables, such as COTARGET_PASSWORD.

    Raises:
        DeviceError: the process does not start.
    """

    def __init__(
        self, folder: Path, tables: Mapping[str, Any], *options: str, environment: Mapping[str, str] | None = None
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        # The rig.toml of the simulated rig, and the one that connects to the emulation.
        self.folder, self.sim_toml, self.hardware_toml = folder, folder / "sim.toml", folder / "hardware.toml"
        self.sim_toml.write_text(tomli_w.dumps(dict(tables)), encoding="utf-8")
        self.sim: RigConfig = config_of(read_text(self.sim_toml), self.sim_toml)
        self._errors, self._lock = folder / "emulate.log", threading.Lock()
        command = [sys.executable, "-m", "cotarget.cli", "emulate", "--rig", str(self.sim_toml)]
        command += ["--write", str(self.hardware_toml), "--seconds", str(LONGEST_S), *options]
        path = os.pathsep.join(filter(None, sys.path))  # the child imports what this process does
        variables = {**os.environ, "PYTHONPATH": path, **(environment or {})}
        with self._errors.open("w", encoding="utf-8") as errors:
            self.process = subprocess.Popen(
                command,
                env=variables,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        late = threading.Timer(START_S, self.process.kill)  # its output ends then
        late.start()
        try:
            self.addresses = self._read_addresses()  # by the first word of the line
            host, _, port = self.addresses["control"].removeprefix("socket://").rpartition(":")
            self._connection = socket.create_connection((host, int(port)), ANSWER_S)
            self._stream = self._connection.makefile("rw", encoding="utf-8")
        except BaseException:
            end(self.process)
            raise
        finally:
            late.cancel()
            late.join()

    def rig_toml(self) -> Path:
        """Update and return the rig.toml that connects to it; a head that was unplugged returns under another name."""
        tables = tomllib.loads(read_text(self.hardware_toml))
        if "head" in tables["hardware"]:
            tables["hardware"]["head"]["port"] = self.truth()["port"]
        self.hardware_toml.write_text(tomli_w.dumps(tables), encoding="utf-8")
        return self.hardware_toml

    def config(self) -> RigConfig:
        """Read the configuration that connects to it."""
        path = self.rig_toml()
        return config_of(read_text(path), path)

    def truth(self) -> dict[str, Any]:
        """Return the ground truth now."""
        return self._ask({"truth": True})

    def switch(self, fault: str, on: bool = True) -> None:
        """Switch a fault, named as device.fault."""
        self._ask({"fault": fault, "on": on})

    def errors(self) -> str:
        """Return what the process has written to stderr."""
        return self._errors.read_text(encoding="utf-8")

    def close(self) -> None:
        """End the process; may be called again."""
        self._stream.close()
        self._connection.close()
        end(self.process)

    def _read_addresses(self) -> dict[str, str]:
        assert self.process.stdout is not None
        addresses: dict[str, str] = {}
        for line in self.process.stdout:
            if READY in line:
                return addresses
            name, _, address = line.strip().partition(" ")
            addresses[name] = address.strip()
        raise self._failure("did not start")

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        with self._lock:
            self._stream.write(json.dumps(request) + "\n")
            self._stream.flush()
            line = self._stream.readline()
        if not line:
            raise self._failure("has ended")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise DeviceError(f"the emulated rig says: {answer['error']}")
        return answer

    def _failure(self, what: str) -> DeviceError:
        lines = self.errors().strip().splitlines() or ["without a message"]
        return DeviceError(f"the emulated rig {what}: {lines[-1]}")


def end(process: "subprocess.Popen[str]") -> None:
    """Terminate a process, then kill it if needed; not by SIGINT, which background processes ignore."""
    process.terminate()
    try:
        process.communicate(timeout=END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
