"""Let the pan-tilt head find its limits; it turns through its whole range: `cotarget reset-head`."""

import argparse
from typing import TYPE_CHECKING

from cotarget.cli.common import add_rig, ask
from cotarget.errors import ConfigError

if TYPE_CHECKING:
    from cotarget.config import RigConfig
    from cotarget.drivers.rig import Device


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    parser.add_argument("--yes", action="store_true", help="confirm that camera and cables are clear of it")


def run(options: argparse.Namespace) -> None:
    """Reset the pan-tilt unit after consent."""
    from cotarget.backends import load_config
    from cotarget.drivers.clock import MonotonicClock
    from cotarget.drivers.interlock import addresses_of, rig_lock
    from cotarget.drivers.rig import devices
    from cotarget.safety.signals import end_politely
    from cotarget.safety.stop_file import StopLook, refuse_if_stopped
    from cotarget.schema import missing_key

    config = load_config(options.rig)
    head = devices(config.hardware)["head"]
    if config.backend != "hardware" or missing_key(head.settings):
        raise ConfigError(f'{options.rig}: names no pan-tilt unit; backend = "hardware" and [hardware.head] port do')
    refuse_if_stopped(config.safety.stop_file)
    if not hasattr(head.driver, "reset"):
        _trust_position(options, config, head)
        return
    ask(options.yes, "The head will turn through its whole range. Are camera and cables clear of it?", "not reset")
    look, undo = StopLook(config.safety.stop_file), end_politely()
    try:
        with rig_lock(*addresses_of(head.settings), file=options.rig):
            done = head.driver.reset(head.settings, MonotonicClock(), config.safety, look.reason)
    finally:
        undo()
        look.close()
    print(f"reset: {done}")


def _trust_position(options: argparse.Namespace, config: "RigConfig", head: "Device") -> None:
    """Remove the position-lost marker of a unit without a reset after consent."""
    from cotarget.drivers.interlock import PositionLostMarker

    lost = PositionLostMarker(head.address, config.safety.stop_file)
    if not lost.files():
        raise ConfigError(f"{options.rig}: the driver of {head.where} has no reset; the unit needs none")
    ask(options.yes, "The unit has no reset; switch it off and on. Does it stand where it reports?", "not reset")
    lost.forget()
    print("reset: the reported position counts as true again")
