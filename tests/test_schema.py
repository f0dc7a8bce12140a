"""Tables of TOML and JSON against dataclasses: what is taken, what is refused, and when pydantic is imported."""

import datetime
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
from annotated_types import Interval

from cotarget.errors import ConfigError
from cotarget.schema import Check, FilePath, Limits, OneOf, Pose, Positive, as_table, model, validate


def odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError(f"{value} is even")
    return value


@model
class Lens:
    focal_mm: Limits = (6.0, 72.0)
    steps: Annotated[int, Check(odd)] = 129

    def __post_init__(self):
        if self.steps > 1000 and self.focal_mm[0] < 1:
            raise ValueError(f"steps: {self.steps} are too many for so short a lens")


@model
class Camera:
    name: str
    rate_hz: Positive = 25.0
    quality: Annotated[int, Interval(ge=1, le=100)] = 90
    sign: Annotated[int, OneOf(-1, 1)] = 1
    on: bool = True
    lens: Lens = field(default_factory=Lens)
    mount: Pose | None = None
    file: FilePath | None = None
    points: tuple[Annotated[tuple[int, float], "[u, v]"], ...] = ()


def test_what_a_file_has_becomes_a_frozen_dataclass():
    table = {
        "name": "a",
        "rate_hz": 12,
        "lens": {"focal_mm": [1, 2.5]},
        "mount": {"translation": [1, 0, 0], "rotvec_deg": [0, 90, 0]},
        "file": "x/y.png",
        "points": [[1, 2]],
    }
    camera = validate(Camera, table, "camera")
    assert (camera.rate_hz, type(camera.rate_hz), camera.lens) == (12.0, float, Lens((1.0, 2.5)))
    assert (camera.file, camera.points) == (Path("x/y.png"), ((1, 2.0),))
    assert camera.mount.rotation.apply([0, 0, 1]) == pytest.approx([1, 0, 0])
    again = validate(Camera, as_table(camera), "camera")
    assert (again.lens, again.file, again.points) == (camera.lens, camera.file, camera.points)
    with pytest.raises(AttributeError):
        camera.rate_hz = 3.0


def test_a_base_gives_what_the_table_does_not_say():
    base = Camera("a", rate_hz=5.0)
    assert validate(Camera, {"quality": 3}, "camera", base=base) == Camera("a", rate_hz=5.0, quality=3)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({}, "camera: missing key 'name'; needed here: name"),
        ({"name": 3}, "camera.name: 3 is not a text"),
        ({"name": "a", "rate_hz": "12"}, "camera.rate_hz: '12' is not a finite number"),
        ({"name": "a", "rate_hz": True}, "camera.rate_hz: True is not a finite number"),
        ({"name": "a", "rate_hz": float("nan")}, "camera.rate_hz: nan is not a finite number"),
        ({"name": "a", "rate_hz": 0}, "camera.rate_hz: 0 is not greater than zero"),
        ({"name": "a", "quality": 90.0}, "camera.quality: 90.0 is not a whole number"),
        ({"name": "a", "quality": True}, "camera.quality: True is not a whole number"),
        ({"name": "a", "quality": 101}, "camera.quality: 101 is not within 1 to 100"),
        ({"name": "a", "sign": True}, "camera.sign: True is not one of: -1, 1"),
        ({"name": "a", "on": 1}, "camera.on: 1 is not true or false"),
        ({"name": "a", "lens": 3}, "camera.lens: 3 is not a table"),
        ({"name": "a", "lens": {"foc": 1}}, "unknown key 'camera.lens.foc'; valid here: focal_mm, steps"),
        ({"name": "a", "lens": {"focal_mm": [2, 1]}}, "camera.lens.focal_mm: [2.0, 1.0] is not [lowest, highest]"),
        ({"name": "a", "lens": {"focal_mm": [1]}}, "camera.lens.focal_mm: has 1 values where 2 are wanted, [lowest, "),
        ({"name": "a", "lens": {"steps": 4}}, "camera.lens.steps: 4 is even"),
        (
            {"name": "a", "lens": {"steps": 1001, "focal_mm": [0.5, 1]}},
            "camera.lens.steps: 1001 are too many for so short a lens",
        ),
        ({"name": "a", "mount": {"translation": [0, 0, 0]}}, "camera.mount: missing key 'rotvec_deg'; needed here: ro"),
        ({"name": "a", "file": ""}, "camera.file: is empty; give a path, or leave it out"),
        ({"name": "a", "points": [3]}, "camera.points[0]: 3 is not a list of 2 numbers, [u, v]"),
        (
            {"nam": "a"},
            "unknown key 'camera.nam'; valid here: file, lens, mount, name, on, points, quality, rate_hz, s",
        ),
        ({"name": datetime.date(2026, 1, 2)}, "camera.name: {'date': '2026-01-02'} is not a text"),
        ({"name": "\ud800"}, "camera: Invalid JSON: "),
        ([], "camera: [] is not a table"),
    ],
)
def test_each_refusal_is_one_line_that_names_the_key(table, said):
    with pytest.raises(ConfigError) as caught:
        validate(Camera, table, "camera")
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)


def test_a_plain_dataclass_is_read_as_strictly():
    @dataclass(frozen=True)
    class Plain:
        rate_hz: float = 1.0

    assert validate(Plain, {"rate_hz": 2}, "plain") == Plain(2.0)
    for table in ({"rate_hz": "2"}, {"rat": 2}):
        with pytest.raises(ConfigError):
            validate(Plain, table, "plain")


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"source": 1.5}, "camera.source: 1.5 is not a whole number or a text"),
        ({"ports": {"left": True}}, "camera.ports.left: True is not a whole number or a text"),
        ({"gains": [1, "a"]}, "camera.gains[1]: 'a' is not a whole number"),
        (
            {"gain": -1},
            "camera.gain: -1 fits none of its types: Input should be greater than 0; Input should be 'auto'",
        ),
        (
            {"lens": {"foc": 1}},
            "camera.lens: {'foc': 1} fits none of its types: Unexpected keyword argument; ",
        ),
        ({"sizes": 3}, "camera.sizes: 3: Input should be a valid "),
    ],
)
def test_a_value_that_is_none_of_several_types_is_one_line_that_names_the_key(table, said):
    @dataclass(frozen=True)
    class Own:
        source: int | str = 0
        ports: dict[str, int | str | None] = field(default_factory=dict)
        gains: list[int] = field(default_factory=list)
        gain: Annotated[int, Interval(gt=0)] | Literal["auto"] = "auto"
        lens: Lens | str = ""
        sizes: tuple = ()

    assert validate(Own, {"source": "a", "gain": 3}, "camera") == Own("a", gain=3)
    with pytest.raises(ConfigError) as caught:
        validate(Own, table, "camera")
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)


QUICK = """
import sys
from pathlib import Path
import cotarget
from cotarget.cli.main import main
rig = Path("rig.toml")
rig.write_text("[safety]\\nstop_file = 'stop'\\nwatchdog = 1\\n")
assert main(["stop", "--rig", "rig.toml"]) == 0 and main(["clear", "--rig", "rig.toml"]) == 0
try:
    main(["--help"])
except SystemExit:
    pass
print(sorted({"pydantic", "numpy", "cotarget.config"} & set(sys.modules)))
"""


def test_stop_and_clear_import_neither_pydantic_nor_the_configuration(tmp_path):
    """They must be quick, and work whatever else is wrong in rig.toml."""
    root = Path(__file__).parents[1]
    run = [sys.executable, "-c", QUICK]
    done = subprocess.run(run, cwd=tmp_path, env={"PYTHONPATH": str(root)}, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr
