"""Put a simulated rig behind the real devices' protocols, in real time: `cotarget emulate --write rig.toml`."""

import argparse
import os
import sys
import time
from typing import Any

from cotarget.cli.common import add_file, check_outputs, duration, port, previous_kept, rig_files
from cotarget.errors import ConfigError, naming

# One thread for Mesa's software renderer leaves a core to the client. Mesa reads the variable when OpenGL starts.
RENDER_THREADS = ("LP_NUM_THREADS", "1")
POLL_S = 0.2
# Python's switch interval [s]. With the default of 5 ms, a line that is paced by its own thread loses half of its rate
# beside the rendering.
SWITCH_S = 5e-4
TARGETS = ("person",)  # targets of the scene without a rig.toml
NO_TARGET = 'none; [sim] targets = ["person"] has one to follow'


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--rig", "rig.toml of the simulated rig (the default rig)")
    add_file(parser, "--write", "rig.toml to write, which connects to it", required=True)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (127.0.0.1: this machine alone)")
    for name in ("head", "fixed", "zoom", "board", "control"):
        parser.add_argument(f"--{name}", type=port, default=0, metavar="PORT", help="port to listen at (any free one)")
    about = "emulate head and zoom camera as one dome that is moved by this protocol (a PTU-D46 and a PowerShot)"
    parser.add_argument("--ptz", choices=("visca",), help=about)
    about = "units of the dome (ptzoptics)"
    parser.add_argument("--units", choices=("ptzoptics", "evi_d70", "evi_d80"), default="ptzoptics", help=about)
    about = "connect the head by TCP instead of a serial port, or the dome instead of by UDP"
    parser.add_argument("--tcp", action="store_true", help=about)
    parser.add_argument("--user", default="", metavar="NAME", help="user name that the fixed camera asks for (none)")
    about = "fault to be on from the start, one of those below; the control socket switches faults later"
    parser.add_argument("--fault", action="append", default=[], metavar="DEVICE.FAULT", help=about)
    parser.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")


def epilog() -> str:
    """List the faults that can be switched on, for --help."""
    from cotarget.emulators.emulation import FAULTS

    return "faults: " + ", ".join(f"{device}.{name}" for device, names in FAULTS.items() for name in names)


def run(options: argparse.Namespace) -> None:
    """Serve a simulated rig by the devices' wire protocols, and write a rig.toml for it."""
    os.environ.setdefault(*RENDER_THREADS)
    sys.setswitchinterval(SWITCH_S)
    from cotarget.backends import load_config
    from cotarget.config import RigConfig, SimConfig, read_tables
    from cotarget.emulators.emulation import Emulation, Ports, copied_tables, parse_fault
    from cotarget.emulators.world import paced
    from cotarget.files import write_atomically

    config = RigConfig(sim=SimConfig(targets=TARGETS)) if options.rig is None else load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is emulated is a simulated rig")
    beside: dict[str, Any] = {}
    if options.rig is not None:
        beside = copied_tables(read_tables(options.rig), options.rig.parent)
    check_outputs([options.write], rig_files(options.rig, config))
    for fault in options.fault:
        with naming("--fault"):
            parse_fault(fault)
    ports = Ports(options.host, options.head, options.fixed, options.zoom, options.board, options.control)
    password = os.environ.get("COTARGET_PASSWORD", "") if options.user else ""
    if options.user and not password:
        raise ConfigError("--user needs a password: put it into the environment variable COTARGET_PASSWORD")
    dome = {"dome": options.ptz, "units": options.units} if options.ptz else {}
    with Emulation(paced(config), ports, user=options.user, password=password, **dome) as emulation:
        for fault in options.fault:
            emulation.switch(fault)
        with previous_kept(options.write):
            write_atomically(options.write, emulation.rig_toml(tcp=options.tcp, beside=beside).encode())
        for name, address in emulation.addresses.items():
            print(f"{name:<8} {address}")
        print(
            f"targets  {', '.join(config.sim.targets) or NO_TARGET}\n"
            f"{options.write} connects to them; Ctrl-C ends them",
            flush=True,
        )
        end = None if options.seconds is None else time.monotonic() + options.seconds
        try:
            while end is None or time.monotonic() < end:
                time.sleep(POLL_S)
                emulation.world.check()
        except KeyboardInterrupt:
            print("", file=sys.stderr)
