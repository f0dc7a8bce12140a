"""Tables of TOML and JSON against dataclasses: what is taken, and what is refused."""

import datetime
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


def test_table_becomes_a_frozen_dataclass():
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


def test_missing_keys_are_taken_from_the_base():
    base = Camera("a", rate_hz=5.0)
    assert validate(Camera, {"quality": 3}, "camera", base=base) == Camera("a", rate_hz=5.0, quality=3)


# Values that a key refuses, and the key that the message begins with.
REFUSED = [
    ("name", 3, "camera.name: "),
    ("name", datetime.date(2026, 1, 2), "camera.name: "),
    ("rate_hz", "12", "camera.rate_hz: "),
    ("rate_hz", float("nan"), "camera.rate_hz: "),
    ("rate_hz", 0, "camera.rate_hz: "),
    ("quality", 101, "camera.quality: "),
    ("sign", 2, "camera.sign: "),
    ("on", 1, "camera.on: "),
    ("lens", 3, "camera.lens: "),
    ("lens", {"foc": 1}, "unknown key 'camera.lens.foc'; valid here: focal_mm, steps"),
    ("lens", {"focal_mm": [2, 1]}, "camera.lens.focal_mm: "),
    ("lens", {"focal_mm": [1]}, "camera.lens.focal_mm[1]: Field required"),
    ("lens", {"steps": 4}, "camera.lens.steps: 4 is even"),
    ("lens", {"steps": 1001, "focal_mm": [0.5, 1]}, "camera.lens.steps: 1001 are too many for so short a lens"),
    ("mount", {"translation": [0, 0, 0]}, "camera.mount.rotvec_deg: Field required"),
    ("file", "", "camera.file: "),
    ("points", [3], "camera.points[0]: "),
]


def refusal(cls, table):
    with pytest.raises(ConfigError) as caught:
        validate(cls, table, "camera")
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("key", "value", "said"), REFUSED)
def test_each_refusal_is_one_line_that_names_the_key(key, value, said):
    assert refusal(Camera, {"name": "a", key: value}).startswith(said)


def test_missing_and_unknown_keys_are_named_with_the_valid_ones():
    assert refusal(Camera, {}) == "camera.name: Field required"
    assert refusal(Camera, {"nam": "a"}).startswith("unknown key 'camera.nam'; valid here: file, lens, mount, name, on")
    assert refusal(Camera, []).startswith("camera: ")


def test_plain_dataclass_is_read_strictly():
    @dataclass(frozen=True)
    class Plain:
        rate_hz: float = 1.0

    assert validate(Plain, {"rate_hz": 2}, "plain") == Plain(2.0)
    for table in ({"rate_hz": "2"}, {"rat": 2}):
        with pytest.raises(ConfigError):
            validate(Plain, table, "plain")


@pytest.mark.parametrize(("key", "value", "at"), [
    ("source", 1.5, "source"), ("ports", {"left": True}, "ports.left"), ("gains", [1, "a"], "gains[1]"),
    ("gain", -1, "gain"), ("lens", {"foc": 1}, "lens"), ("sizes", 3, "sizes"),
])  # fmt: skip
def test_value_outside_a_union_is_one_line_that_names_the_key(key, value, at):
    @dataclass(frozen=True)
    class Own:
        source: int | str = 0
        ports: dict[str, int | str | None] = field(default_factory=dict)
        gains: list[int] = field(default_factory=list)
        gain: Annotated[int, Interval(gt=0)] | Literal["auto"] = "auto"
        lens: Lens | str = ""
        sizes: tuple = ()

    assert validate(Own, {"source": "a", "gain": 3}, "camera") == Own("a", gain=3)
    assert refusal(Own, {key: value}).startswith(f"camera.{at}: ")
