"""Wrong calls of all commands: the exit status, one line that names the command and the option, key or file, no file.

`test_commands` and `test_operating` have more mistakes of single commands.
"""

import shlex

import pytest

from cotarget.calibration import save_calibration
from cotarget.config import RigConfig
from tests.cli.test_commands import call, true_calibration
from tests.test_video import bird_film

FAILED, USAGE = 1, 2
HARDWARE = """
backend = "hardware"
[hardware.head]
port = "/dev/nobody"
[hardware.fixed]
url = "http://127.0.0.1:9"
[hardware.zoom]
port = "usb:"
"""
FILES = {
    "rig.toml": '[sim]\nscene = "indoor"\ntargets = ["book"]\n[safety]\nstop_file = "stop"\n',
    "nameless.toml": 'backend = "hardware"\n[board]\nsquare = 0.1\n',
    "number.toml": 'backend = "hardware"\n[hardware.head]\nport = 5\n',
    "hw.toml": HARDWARE,
    "replay.toml": 'backend = "replay"\nrecording = "none"\n',
    "of_nothing.toml": 'backend = "replay"\n',
    "typo.toml": "[sim]\nscenery = 1\n",
    "list.json": "[1, 2]",
    "other.csv": "a,b\n1,2\n",
    "late.csv": "frame,x_px,y_px,width_px,height_px\n900,1,2,3,4\n",
}
FOLLOW = "follow --calibration good.json --seconds 1 --target"
AIM = "aim --calibration good.json --pixel 320 240"
DETECT = "detect film.mp4 --target bird --csv"
CALLS = [
    ("demo --seed 1.5", USAGE, "--seed", "'1.5' is not a whole number"),
    ("demo --out film.mp4", FAILED, "film.mp4", "name a folder"),
    ("calibrate", USAGE, "--rig", "--from"),
    ("calibrate --rig none.toml", FAILED, "none.toml: no such file"),
    ("calibrate --rig number.toml", FAILED, "number.toml: hardware.head.port: 5 is not a text"),
    ("calibrate --rig hw.toml", FAILED, "hw.toml", "[board] square = 0.025"),
    ("calibrate --rig nameless.toml", FAILED, "nameless.toml: hardware.head.port"),
    ("calibrate --rig rig.toml --placements 0", USAGE, "--placements", "'0' is not a whole number from 1"),
    ("calibrate --rig rig.toml --stops x", USAGE, "--stops", "'x'"),
    ("calibrate --rig rig.toml --out -", FAILED, "-: stdout takes the table of --csv alone"),
    ("calibrate --from film.mp4", FAILED, "film.mp4: no such folder"),
    ("report", USAGE, "FILE"),
    ("report none.json", FAILED, "none.json: no such file"),
    ("report list.json", FAILED, "list.json", "calibration.json"),
    ("report film.mp4", FAILED, "film.mp4", "UTF-8"),
    ("report good.json --out folder", FAILED, "folder: is a folder"),
    ("report good.json --out film.mp4/page.html", FAILED, "film.mp4/page.html: film.mp4 is a file, not a folder"),
    (f"{AIM}", USAGE, "--depth", "--size-px"),
    (f"{AIM} --depth 5 --rig typo.toml", FAILED, "typo.toml", "sim.scenery"),
    (f"{AIM} --depth 5 --target dog", FAILED, "--target: unknown target 'dog'", "bird, book, person"),
    (f"{AIM} --depth 5 --target book --wanted-px 5000", FAILED, "--wanted-px: 5000 px", "640x480"),
    ("aim --calibration wide.json --pixel 3 4 --depth 5 --rig rig.toml", FAILED, "wide.json: ", "aspect ratio"),
    ("aim --calibration good.json --pixel a b --depth 5", USAGE, "--pixel", "'a'"),
    (f"{FOLLOW} cat --rig rig.toml", FAILED, "--target: unknown target 'cat'"),
    (f"{FOLLOW} bird --rig rig.toml", FAILED, "rig.toml", '[sim] targets = ["book", "bird"]'),
    (f"{FOLLOW} book --rig hw.toml", FAILED, "good.json: ", "704x576", "aspect ratio"),
    (f"{FOLLOW} book --rig replay.toml", FAILED, "none: is no recording"),
    (f"{FOLLOW} book --rig of_nothing.toml", FAILED, "of_nothing.toml: recording: is missing"),
    (f"{FOLLOW} book --rig rig.toml --click 900 2", FAILED, "--click: (900, 2)", "640x480"),
    (f"{FOLLOW} book --rig rig.toml --policy best", USAGE, "--policy", "first-come"),
    (f"{FOLLOW} book --rig rig.toml --record film.mp4", FAILED, "film.mp4: is a file; give a new folder"),
    (f"{FOLLOW} book --rig rig.toml --video -", FAILED, "-: stdout takes the table of --csv alone"),
    ("replay none", FAILED, "none: no such folder"),
    ("replay folder", FAILED, "folder: is no recording"),
    ("replay film.mp4 --check x", USAGE, "unrecognized arguments: x"),
    ("point --rig rig.toml --pan-deg x", USAGE, "--pan-deg", "'x' is not a number"),
    ("point --rig nameless.toml", FAILED, "nameless.toml: hardware.head.port"),
    ("point --rig replay.toml", FAILED, "replay.toml: backend is 'replay'"),
    ("point --rig rig.toml --pictures film.mp4", FAILED, "film.mp4 is a file, not a folder"),
    ("latency --rig rig.toml --calibration list.json", FAILED, "list.json"),
    ("latency --rig nameless.toml", FAILED, "nameless.toml: hardware.head.port"),
    ("stop --rig none.toml", FAILED, "none.toml: "),
    ("clear", USAGE, "--rig"),
    ("reset-head --rig rig.toml", FAILED, "rig.toml: names no pan-tilt unit"),
    ("emulate --rig rig.toml", USAGE, "--write"),
    ("emulate --write new.toml --fault a.b", FAILED, "--fault: unknown fault 'a.b'", "fixed., head., zoom."),
    ("emulate --write -", FAILED, "-: stdout takes the table of --csv alone"),
    ("view --port 5", FAILED, "--port", "--browser"),
    ("view --target dog", FAILED, "--target: unknown target 'dog'"),
    ("view --rig hw.toml", FAILED, "hw.toml: backend is 'hardware'"),
    ("detect film.mp4", USAGE, "--target", "--csv"),
    ("detect none.mp4 --target bird --csv new.csv", FAILED, "none.mp4: no such file"),
    (f"{DETECT} new.csv --rig none.toml", FAILED, "none.toml: no such file"),
    (f"{DETECT} new.csv --labels other.csv", FAILED, "other.csv", "frame, x_px"),
    (f"{DETECT} new.csv --video new.txt", FAILED, "new.txt: cannot be written", ".mp4"),
    (f"{DETECT} - --labels late.csv", FAILED, "--labels", "--csv"),
    ("board", USAGE, "--out"),
    ("board --out new.txt", FAILED, "new.txt", ".pdf, .png, .svg"),
    ("board --out new.pdf --board 7x7", FAILED, "--board: 7x7 looks the same upside down"),
    ("board --out new.pdf --square 25", FAILED, "--square: 25 m", "25 mm are 0.025"),
    ("board --out new.pdf --kind ring", USAGE, "--kind", "charuco"),
    ("doctor --rig none.toml", FAILED, "none.toml: no such file"),
    ("doctor --rig typo.toml", FAILED, "typo.toml", "sim.scenery"),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calls")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    save_calibration(folder / "good.json", true_calibration(RigConfig()))
    save_calibration(folder / "wide.json", true_calibration(RigConfig(), zoom_size=(640, 360)))
    (folder / "folder").mkdir()
    bird_film(folder / "film.mp4", 5)
    return folder


@pytest.mark.parametrize(
    ("line", "status", "parts"), [(line, status, parts) for line, status, *parts in CALLS], ids=str
)
def test_a_wrong_call_ends_in_one_line(made, monkeypatch, capsys, line, status, parts):
    monkeypatch.chdir(made)
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*")}
    ended, out, err = call(capsys, *shlex.split(line))
    assert (ended, out) == (status, "")
    [said] = err.splitlines()
    assert said.startswith(f"cotarget {line.split()[0]}: ")
    for part in parts:
        assert part in said
    assert {path: path.stat().st_mtime_ns for path in made.rglob("*")} == before


def test_labels_of_another_film_are_an_error(made, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(made)
    status, out, err = call(capsys, *shlex.split(DETECT), tmp_path / "tracks.csv", "--labels", "late.csv")
    assert (status, out) == (FAILED, "")
    assert err == (
        "cotarget detect: late.csv: no labelled frame is in the film, whose last one is 4; give the labels of this "
        "film, with frames from 0\n"
    )


def test_a_table_goes_to_stdout_and_the_summary_to_stderr(made, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(made)
    bird_film(tmp_path / "long.mp4", 60)
    detect = ("detect", tmp_path / "long.mp4", "--target", "bird", "--csv")
    assert call(capsys, *detect, tmp_path / "tracks.csv")[0] == 0
    status, out, err = call(capsys, *detect, "-")
    assert status == 0
    assert out == (tmp_path / "tracks.csv").read_text()
    assert '"frames": 60' in err
    assert not (made / "-").exists()
