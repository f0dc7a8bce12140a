"""`cotarget config`, whose lines are taken as a rig.toml."""

import re
import tomllib
from dataclasses import replace

from cotarget.cli.main import main
from cotarget.config import HardwareConfig, parse_config
from cotarget.drivers.rig import devices


def test_every_key_that_is_taken_in_has_its_default(capsys):
    assert main(["config"]) == 0
    lines, keys = [], 0
    for line in capsys.readouterr().out.splitlines():
        if re.match(r"#\w+ = ", line):
            try:
                tomllib.loads(line[1:])
            except tomllib.TOMLDecodeError:  # the form of a key without a default
                continue
            line, keys = line[1:], keys + 1
        lines.append(line)
    found, usual = parse_config(tomllib.loads("\n".join(lines))), parse_config({})
    assert keys > 100
    assert repr(replace(found, hardware=HardwareConfig())) == repr(usual)  # poses are printed to eight digits
    assert {name: device.settings for name, device in devices(found.hardware).items()} == {
        name: device.settings for name, device in devices(usual.hardware).items()
    }
