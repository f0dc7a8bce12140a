"""Put a simulated rig behind the real devices' protocols, in real time: `cotarget emulate --write rig.toml`."""

import argparse
import os
import sys
import time
from collections.abc import Iterable, Mapping
from typing import Any

from cotarget.cli.common import add_file, check_outputs, duration, port, previous_kept, rig_files
from cotarget.errors import ConfigError, naming

# One thread for Mesa's software renderer leaves a core to the client. Mesa reads the variable when OpenGL starts.
RENDER_THREADS = ("LP_NUM_THREADS", "1")
POLL_S = 0.2
# Python's switch interval [s]. With the default of 5 ms, a line that is paced by its own thread loses half of its rate
# beside the rendering.
SWITCH_S = 5e-4
UNITS = "ptzoptics"  # of a VISCA dome
TARGETS = ("person",)  # targets of the scene without a rig.toml
NO_TARGET = 'none; [sim] targets = ["person"] has one to follow'


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--rig", "rig.toml of the simulated rig (the default rig)")
    add_file(parser, "--write", "rig.toml to write, which connects to it", required=True)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (127.0.0.1: this machine alone)")
    parser.add_argument("--head", type=port, default=0, metavar="PORT", help="port to listen at (any free one)")
    about = "axis or rtsp, and the port to listen at; or the port alone (axis, at any free port)"
    parser.add_argument("--fixed", type=protocol_and_port, default=0, metavar="PROTOCOL[:PORT]", help=about)
    for name in ("zoom", "board", "control"):
        parser.add_argument(f"--{name}", type=port, default=0, metavar="PORT", help="port to listen at (any free one)")
    about = "emulate head and zoom camera as one dome that is moved by this protocol (a PTU-D46 and a PowerShot)"
    parser.add_argument("--ptz", choices=("onvif", "visca"), help=about)
    about = "how the dome deviates from its standard: faults of ptz, listed below, without ptz"
    parser.add_argument("--profile", type=lambda text: text.split(","), default=[], metavar="NAME[,NAME]", help=about)
    about = f"units of a VISCA dome ({UNITS})"
    parser.add_argument("--units", choices=("ptzoptics", "evi_d70", "evi_d80"), default=UNITS, help=about)
    about = "connect the head by TCP instead of a serial port, or a VISCA dome instead of by UDP"
    parser.add_argument("--tcp", action="store_true", help=about)
    parser.add_argument("--user", default="", metavar="NAME", help="user name that cameras and dome ask for (none)")
    about = "fault to be on from the start, one of those below; the control socket switches faults later"
    parser.add_argument("--fault", action="append", default=[], metavar="DEVICE.FAULT", help=about)
    parser.add_argument("--seconds", type=duration, metavar="S", help="duration [s] (until Ctrl-C)")


def protocol_and_port(text: str) -> tuple[str, int]:
    """Parse the fixed camera's protocol, its port, or both."""
    name, _, number = ("axis", "", text) if text.isdigit() else text.partition(":")
    if name not in ("axis", "rtsp"):
        raise argparse.ArgumentTypeError(f"'{text}' is neither a port nor axis or rtsp, such as rtsp:8554")
    return name, port(number or "0")


def epilog() -> str:
    """List the faults that can be switched on, for --help."""
    from cotarget.emulators.emulation import DOMES, FAULTS, FIXED

    def listed(faults: Mapping[str, Iterable[str]]) -> str:
        return ", ".join(f"{device}.{name}" for device, names in faults.items() for name in names)

    lines = [f"faults: {listed(FAULTS)}", f"faults with --fixed rtsp: {listed({'fixed': FIXED['rtsp']})}"]
    lines += [f"faults with --ptz {name}: {listed({'ptz': faults})}" for name, faults in DOMES.items()]
    return "\n".join([*lines, f"faults of the picture of a dome: {listed({'picture': FIXED['rtsp']})}"])


def check_dome(options: argparse.Namespace) -> None:
    """Refuse what the dome of --ptz does not have."""
    if options.profile and not options.ptz:
        raise ConfigError("--profile: is of a dome; give --ptz onvif")
    if options.units != UNITS and options.ptz != "visca":
        raise ConfigError("--units: is of a VISCA dome; give --ptz visca")
    if options.tcp and options.ptz == "onvif":
        raise ConfigError("--tcp: is of a PTU-D46 or a VISCA dome; ONVIF is over TCP without it")


def run(options: argparse.Namespace) -> None:
    """Serve a simulated rig by the devices' wire protocols, and write a rig.toml for it."""
    os.environ.setdefault(*RENDER_THREADS)
    sys.setswitchinterval(SWITCH_S)
    from cotarget.backends import load_config
    from cotarget.config import RigConfig, SimConfig, read_tables
    from cotarget.emulators.emulation import Emulation, Ports, copied_tables, faults_of, parse_fault
    from cotarget.emulators.world import paced
    from cotarget.files import write_atomically

    config = RigConfig(sim=SimConfig(targets=TARGETS)) if options.rig is None else load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is emulated is a simulated rig")
    beside: dict[str, Any] = {}
    if options.rig is not None:
        beside = copied_tables(read_tables(options.rig), options.rig.parent)
    check_outputs([options.write], rig_files(options.rig, config))
    protocol, fixed_port = options.fixed or ("axis", 0)
    check_dome(options)
    faults = {
        fault: option
        for option, names in (("--fault", options.fault), ("--profile", [f"ptz.{name}" for name in options.profile]))
        for fault in names
    }
    for fault, option in faults.items():
        with naming(option):
            parse_fault(fault, faults_of(protocol, options.ptz or ""))
    ports = Ports(options.host, options.head, fixed_port, options.zoom, options.board, options.control)
    password = os.environ.get("COTARGET_PASSWORD", "") if options.user else ""
    if options.user and not password:
        raise ConfigError("--user needs a password: put it into the environment variable COTARGET_PASSWORD")
    how = {"fixed": protocol, "dome": options.ptz or "", "units": options.units}
    with Emulation(paced(config), ports, user=options.user, password=password, **how) as emulation:
        for fault in faults:
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
