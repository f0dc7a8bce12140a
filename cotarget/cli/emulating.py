"""The command that puts a simulated rig behind the devices' protocols."""

import argparse
import os
import sys
import time
from typing import Any

from cotarget.cli.arguments import check_outputs, previous_kept, rig_files
from cotarget.errors import ConfigError

# Mesa's software renderer: one thread, which leaves the client a core. Read when OpenGL starts.
RENDER_THREADS = ("LP_NUM_THREADS", "1")
LOOK = 0.2  # between looks at the time [s]
# How long a thread that works in Python keeps others waiting [s]; with Python's own 5 ms, a line that is paced by a
# thread of its own loses half of its rate beside the world's rendering.
SWITCH_S = 5e-4
WHO_IS_THERE = ("person",)  # to be followed, where no rig.toml says who
NOBODY = 'none; [sim] targets = ["person"] has one to follow'
STOP_FILE = "stop"  # beside the rig.toml that is written, where the simulated rig's names none


def fault_names() -> str:
    """The faults that can be switched on, as --help tells them."""
    from cotarget.emulators.emulation import FAULTS

    return "faults: " + ", ".join(f"{device}.{name}" for device, names in FAULTS.items() for name in names)


def emulate(options: argparse.Namespace) -> None:
    """Cotarget emulate."""
    os.environ.setdefault(*RENDER_THREADS)
    sys.setswitchinterval(SWITCH_S)
    from cotarget.calibration.atomic import write_atomically
    from cotarget.config import RigConfig, load_config, read_tables
    from cotarget.emulators.emulation import Emulation, Ports, copied_tables, parse_fault
    from cotarget.emulators.world import paced
    from cotarget.simconfig import SimConfig

    config = RigConfig(sim=SimConfig(targets=WHO_IS_THERE)) if options.rig is None else load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is emulated is a simulated rig")
    beside: dict[str, Any] = {}
    if options.rig is not None:
        beside = copied_tables(read_tables(options.rig), options.rig.parent)
    beside["safety"] = {"stop_file": STOP_FILE} | beside.get("safety", {})
    check_outputs([options.write], rig_files(options.rig, config))
    for fault in options.fault:
        parse_fault(fault)
    ports = Ports(options.host, options.head, options.fixed, options.zoom, options.board, options.control)
    password = os.environ.get("COTARGET_PASSWORD", "") if options.user else ""
    if options.user and not password:
        raise ConfigError("--user needs a password: put it into the environment variable COTARGET_PASSWORD")
    with Emulation(paced(config), ports, user=options.user, password=password) as emulation:
        for fault in options.fault:
            emulation.switch(fault)
        with previous_kept(options.write):
            write_atomically(options.write, emulation.rig_toml(tcp=options.tcp, beside=beside).encode())
        print(
            f"head     {emulation.tty.port} and {emulation.tcp.url}\n"
            f"fixed    {emulation.fixed.url}/mjpg/video.mjpg\n"
            f"zoom     ptpip:{options.host}:{emulation.zoom.port}:{emulation.zoom.port}\n"
            f"board    socket://{options.host}:{emulation.board.port}\n"
            f"control  socket://{options.host}:{emulation.control.port}\n"
            f"targets  {', '.join(config.sim.targets) or NOBODY}\n"
            f"{options.write} connects to them; Ctrl-C ends them",
            flush=True,
        )
        end = None if options.seconds is None else time.monotonic() + options.seconds
        try:
            while end is None or time.monotonic() < end:
                time.sleep(LOOK)
                emulation.world.check()
        except KeyboardInterrupt:
            print("", file=sys.stderr)
