"""Wrong calls end in one line that names command and option, key or file, and make no file."""

import shlex
import socket
import sys

import cv2
import numpy as np
import pytest

from cotarget.config import RigConfig
from cotarget.geometry import RigidTransform
from tests.support.commands import (
    HARDWARE,
    NO_PORT,
    OLD,
    bird_film,
    board_photo,
    call,
    capture,
    refused,
    true_calibration,
    write_index,
)
from tests.support.rigs import with_zoom_head

FAILED, USAGE = 1, 2
FILES = {
    "rig.toml": '[sim]\nscene = "indoor"\ntargets = ["book"]\n[safety]\nstop_file = "stop"\n',
    "sim.toml": "[sim]\n",
    "dog.toml": "[targets.dog]\nsize = 0.6\ndimension = 'height'\nwanted_px = 500\ndetector = 'motion'\n",
    "pixels.toml": "ignored = [[[0, 0], [320, 0], [320, 240]]]\n",
    "ignore.toml": "ignore = [[[0, 0], [1, 0], [1, 1]]]\n",
    "cat.toml": '[follow]\ntarget = "cat"\n',
    "house.toml": '[sim]\ntargets = ["book"]\n[targets.book]\nsize = 23.4\n',
    "crow.toml": '[sim]\ntargets = ["bird"]\n[targets.crow]\nsize = 180\ndimension = "wingspan"\nwanted_px = 160\n',
    "narrow.toml": "[safety]\npan_deg = [-5, 5]\n",
    "other_shape.toml": "[sim.fixed]\nsize = [640, 360]\n",
    "typo.toml": "[sim]\nscenery = 1\n",
    "moon.toml": '[sim]\nscene = "moon"\n',
    "broken.toml": "[sim\n",
    "unstoppable.toml": "[safety]\nstop_file = 5\n",
    "nameless.toml": 'backend = "hardware"\n[board]\nsquare = 0.1\n',
    "hw.toml": HARDWARE,
    "no_backend.toml": HARDWARE.replace('backend = "hardware"', ""),
    "replay.toml": 'backend = "replay"\nrecording = "none"\n',
    "of_nothing.toml": 'backend = "replay"\n',
    "broken.json": '{"schema": 2, "fixed": {',
    "list.json": "[1, 2]",
    "text.mp4": "no film",
    "other.csv": "a,b\n1,2\n",
    "cut.txt": "31,1,5,5,9,9\n",
    "late.csv": "frame,x_px,y_px,width_px,height_px\n900,1,2,3,4\n",
    **dict.fromkeys(("out.json", "out.csv", "out.mp4"), OLD),
    "index/index.json": '{"schema": 1, "board": 5, "pitch_mm": null, "captures": [1]}',
}
AIM = "aim --calibration good.json --pixel 320 240"
FOLLOW = "follow --calibration good.json --rig rig.toml --target book"
TARGET = "follow --calibration good.json --rig rig.toml --target"
DETECT = "detect film.mp4 --target bird --csv"
OUT = "calibrate --out out.json"
PHOTOS = "--fixed 'left*.png' --zoom 'right*.png' --board 9x6 --square 0.1"
SINGLE = f"{OUT} --from single --fixed 'left*.png' --zoom 'right*.png'"
POSE = "millimetres.json: T_zoom0_fixed"
# The command line, the exit status, and what the line names.
CALLS = [
    ("dance", USAGE, "'dance'", "calibrate"),
    ("demo --out film.mp4", FAILED, "film.mp4"),
    # calibrate
    ("calibrate --rig folder", FAILED, "folder"),
    ("calibrate --rig moon.toml", FAILED, "moon.toml: ", "'moon'", "indoor, outdoor"),
    ("calibrate --rig nameless.toml", FAILED, "nameless.toml: hardware.head.port"),
    ("calibrate --rig rig.toml --out folder", FAILED, "folder: "),
    ("calibrate --rig replay.toml --out new.json", FAILED, "replay.toml: backend is 'replay'"),
    ("calibrate --rig rig.toml --board 9x6", FAILED, "--board", "--from"),
    ("calibrate --rig rig.toml --insist --method sequential", FAILED, "--insist", "--method joint"),
    (f"{OUT} --from grey {PHOTOS}", FAILED, "grey: ", "9x6"),
    (f"{OUT} --from folder {PHOTOS}", FAILED, "folder: ", "'left*.png'"),
    (f"{OUT} --from none {PHOTOS}", FAILED, "none: "),
    (f"{OUT} --from folder", FAILED, "folder: ", "index.json"),
    (f"{OUT} --from film.mp4", FAILED, "film.mp4: "),
    (f"{OUT} --from index", FAILED, "index/index.json: ", "board"),
    (f"{OUT} --from no_fixed", FAILED, "no_fixed: ", "fixed camera"),
    (f"{OUT} --from index --kind charuco", FAILED, "--fixed, --zoom, --board and --square"),
    (f"{OUT} --from index --encoders --method sequential", FAILED, "--encoders", "--method joint"),
    (f"{OUT} --from index --captures x", FAILED, "--captures", "--rig"),
    (f"{OUT} --from index --stops 3", FAILED, "--stops", "--rig"),
    (f"{SINGLE} --square 0.1 --board 9by6", USAGE, "--board", "9by6", "9x6"),
    (f"{SINGLE} --square 0.1 --board 7x6", FAILED, "single: ", "7x6"),
    (f"{SINGLE} --square 25 --board 9x6", FAILED, "--square", "0.025"),
    (f"{OUT} --from single {PHOTOS} --kind charuco", FAILED, "single: ", "charuco of 9x6"),
    (f"{OUT} --from single {PHOTOS} --encoders", FAILED, "--encoders", "--rig"),
    # report and board
    ("report list.json", FAILED, "list.json"),
    ("report millimetres.json --out page.html", FAILED, POSE, "metres", "--insist"),
    ("report good.json --out film.mp4/page.html", FAILED, "film.mp4/page.html: "),
    ("board --out new.txt", FAILED, "new.txt", ".pdf, .png, .svg"),
    # aim
    (f"{AIM} --depth -3", USAGE, "--depth", "-3"),
    (f"{AIM} --depth nan", USAGE, "--depth", "nan"),
    (f"{AIM} --depth 1e300", FAILED, "1e+300"),
    (f"{AIM} --depth 5 --fast", USAGE, "--fast"),
    (f"{AIM} --depth 9 --rig crow.toml --target crow", FAILED, "crow.toml: targets.crow.size", "cm are 1.8; --insist"),
    (f"{AIM} --depth 5 --rig typo.toml", FAILED, "typo.toml", "sim.scenery", "scene"),
    (f"{AIM} --depth 5 --rig replay.toml", FAILED, "replay.toml: backend is 'replay'"),
    (f"{AIM} --depth 5 --rig other_shape.toml", FAILED, "good.json: ", "640x360", "640x480"),
    (f"{AIM} --depth 0.5 --rig narrow.toml", FAILED, "pan -5 to 5"),
    (f"{AIM} --depth 5 --target dog", FAILED, "--target", "'dog'", "bird, book, person"),
    (f"{AIM} --depth 5 --wanted-px 16", FAILED, "--wanted-px", "--target"),
    (f"{AIM} --depth 5 --target book --wanted-px 5000", FAILED, "--wanted-px", "5000", "640x480"),
    (f"{AIM} --depth 5 --rig dog.toml --target dog", FAILED, "--wanted-px: missing", "targets.dog.wanted_px: 500 px"),
    (f"{AIM} --depth 5 --focal-mm 100", FAILED, "--focal-mm", "100", "6 to 72 mm"),
    (f"{AIM} --size-px 16", FAILED, "--size-px", "--target"),
    (f"{AIM} --size-px 5000 --target book", FAILED, "--size-px", "book of 0.234 m", "640x480"),
    ("aim --calibration good.json --pixel 640 240 --depth 5", FAILED, "--pixel", "(640, 240)", "640x480"),
    ("aim --calibration headless.json --pixel 3 4 --depth 5", FAILED, "T_head_zoom"),
    ("aim --calibration millimetres.json --pixel 3 4 --depth 5", FAILED, POSE, "metres", "--insist"),
    ("aim --calibration wide.json --pixel 3 4 --depth 5 --rig rig.toml", FAILED, "wide.json: ", "640x360"),
    # follow and replay
    ("follow --calibration good.json --rig dog.toml", FAILED, "--target: missing", "dog, person", "[follow] target"),
    ("point --rig cat.toml", FAILED, "cat.toml: follow.target: unknown target 'cat'", "bird, book, person"),
    (f"{TARGET} cat", FAILED, "--target", "'cat'"),
    ("follow --calibration good.json --rig dog.toml --target dog", FAILED, "dog.toml", "[sim] targets"),
    ("follow --calibration good.json --rig hw.toml --target book", FAILED, "good.json: ", "704x576"),
    ("follow --calibration good.json --rig replay.toml --target book", FAILED, "none: "),
    ("follow --calibration good.json --rig of_nothing.toml --target book", FAILED, "of_nothing.toml: recording"),
    ("follow --calibration wide.json --rig rig.toml --target book", FAILED, "wide.json: ", "640x480", "640x360"),
    ("follow --calibration headless.json --rig rig.toml --target book", FAILED, "headless.json: ", "T_head_zoom"),
    ("follow --calibration millimetres.json --rig rig.toml --target book", FAILED, POSE, "metres", "--insist"),
    ("follow --calibration good.json --rig house.toml --target book", FAILED, "targets.book.size: 23.4", "--insist"),
    (f"{FOLLOW} --seconds 0", USAGE, "--seconds"),
    (f"{FOLLOW} --click 640 3", FAILED, "--click", "(640, 3)", "640x480"),
    (f"{FOLLOW} --csv out.csv --video out.csv", FAILED, "out.csv: "),
    (f"{FOLLOW} --video none/out.mp4", FAILED, "none/out.mp4"),
    (f"{FOLLOW} --record film.mp4", FAILED, "film.mp4: "),
    ("replay folder", FAILED, "folder: "),
    # what operates a rig; refused before any device is opened
    ("point --rig nameless.toml", FAILED, "nameless.toml: hardware.head.port"),
    ("point --rig replay.toml", FAILED, "replay.toml: backend"),
    ("where --rig no_backend.toml", FAILED, "no_backend.toml: backend: ", 'backend = "hardware"'),
    ("point --rig rig.toml --pictures film.mp4", FAILED, "film.mp4"),
    ("latency --rig replay.toml", FAILED, "replay.toml: backend"),
    ("latency --rig nameless.toml", FAILED, "hardware.head.port", "/dev/tty"),
    ("latency --rig hw.toml", FAILED, "http://127.0.0.1:9"),
    ("latency --rig rig.toml --calibration headless.json", FAILED, "T_head_zoom"),
    ("stop --rig unstoppable.toml", FAILED, "unstoppable.toml: safety.stop_file: 5"),
    ("clear --rig sim.toml", FAILED, "sim.toml: ", "[safety] stop_file"),
    ("reset-head --rig sim.toml --yes", FAILED, "sim.toml: "),
    ("reset-head --rig hw.toml --yes", FAILED, NO_PORT),
    ("emulate --rig hw.toml --write new.toml", FAILED, "hw.toml: backend"),
    ("emulate --write new.toml --user root", FAILED, "--user", "COTARGET_PASSWORD"),
    ("emulate --write new.toml --fault silence", FAILED, "--fault", "'silence'", "fixed., head., zoom."),
    ("emulate --write new.toml --units evi_d70", FAILED, "--units", "--ptz visca"),
    ("emulate --write new.toml --ptz onvif --tcp", FAILED, "--tcp", "VISCA"),
    ("emulate --write new.toml --head 65536", USAGE, "--head", "'65536'"),
    # what shows and inspects
    ("view --port 5", FAILED, "--port", "--browser"),
    ("view --calibration good.json", FAILED, "--calibration", "--target"),
    ("view --target dog", FAILED, "--target", "'dog'"),
    ("view --rig hw.toml", FAILED, "hw.toml: backend"),
    ("detect text.mp4 --target bird --csv new.csv", FAILED, "text.mp4"),
    (f"{DETECT} none/new.csv", FAILED, "none/new.csv"),
    (f"{DETECT} new.csv --labels other.csv", FAILED, "other.csv", "frame, x_px", "separated by commas"),
    (f"{DETECT} new.csv --video new.txt", FAILED, "new.txt", ".mp4"),
    (f"{DETECT} new.csv --labels cut.txt", FAILED, "cut.txt", "line 1 is cut off; it wants frame, id, left"),
    (f"{DETECT} new.csv --ignore none.toml", FAILED, "none.toml"),
    (f"{DETECT} new.csv --ignore pixels.toml", FAILED, "pixels.toml: ignored[0][1]: [320, 0]", "from 0 to 1"),
    (f"{DETECT} new.csv --ignore ignore.toml", FAILED, "ignore.toml: unknown key 'ignore'; valid here: ignored"),
    (f"{DETECT} new.csv --ignore rig.toml", FAILED, "rig.toml: holds no region", "[follow] ignored"),
    (f"{DETECT} new.csv --ignore cat.toml", FAILED, "cat.toml: ", "'cat'"),
    (f"{DETECT} new.csv --iou 0.3", FAILED, "--iou", "--labels"),
    (f"{DETECT} new.csv --small-px 9", FAILED, "--small-px", "--labels"),
    (f"{DETECT} - --labels late.csv", FAILED, "--labels", "--csv"),
    ("doctor --rig typo.toml", FAILED, "typo.toml", "sim.scenery"),
]
# Messages that a newcomer meets first, word for word.
FIRST = {
    "": "the following arguments are required: COMMAND; see cotarget --help",
    "calibrate --rig rig.toml --from index": (
        "argument --from: not allowed with argument --rig; see cotarget calibrate --help"
    ),
    "follow": "calibration.json: no such file; give a calibration.json, as cotarget calibrate writes it",
    "follow --calibration good.json --rig none.toml --target book": (
        "none.toml: no such file; give the path of a rig.toml, or make one: cotarget config > rig.toml"
    ),
    f"{TARGET} dog": "--target: unknown target 'dog'; the targets are: bird, book, person",
    f"{TARGET} bird": 'rig.toml: the simulated scene has no bird; add it: [sim] targets = ["book", "bird"]',
    "calibrate --rig hw.toml": (
        "hw.toml: does not say how large the squares of your board are; measure ten of them, and say so in metres: "
        "[board] square = 0.025"
    ),
    "calibrate --from single --fixed 'left*.png'": (
        "plain photos need --zoom too: --fixed, --zoom, --board and --square"
    ),
    "board --out new.pdf --board 7x7": (
        "--board: 7x7 looks the same upside down; one count must be odd and the other even, like 7x8"
    ),
    "stop --rig sim.toml": 'sim.toml: has no stop file; give one: [safety] stop_file = "stop"',
    "view": "this machine has no display; --browser shows the scene in a web browser instead",
    "replay none": "none: is no folder of a recording: it holds no recording.json",
}
OPENED = [
    (f"{FOLLOW} --video out.xyz", FAILED, "out.xyz: ", ".mp4"),
    (f"{OUT} --rig rig.toml --captures out.csv/x", FAILED, "out.csv/x: "),
    (f"{OUT} --rig rig.toml --captures index", FAILED, "index: "),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with good and wrong rigs and calibrations, and old results."""
    folder = tmp_path_factory.mktemp("calls")
    for name in ("folder", "index", "no_fixed", "grey", "single"):
        (folder / name).mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text)
    good = true_calibration(RigConfig())
    gamma = good.zoom_head.T_zoom0_fixed
    wide_apart = RigidTransform.from_components(1000 * gamma.translation, gamma.rotation)
    good.save(folder / "good.json")
    true_calibration(RigConfig(), zoom_size=(640, 360)).save(folder / "wide.json")
    true_calibration(RigConfig(), with_head=False).save(folder / "headless.json")
    with_zoom_head(good, T_zoom0_fixed=wide_apart).save(folder / "millimetres.json")
    cv2.imwrite(str(folder / "no_fixed" / "a.png"), board_photo())
    write_index(folder / "no_fixed", [capture("a.png", "zoom")])
    for side in ("left", "right"):
        for number in range(4):
            cv2.imwrite(str(folder / "grey" / f"{side}{number}.png"), np.full((120, 160, 3), 128, np.uint8))
        cv2.imwrite(str(folder / "single" / f"{side}1.png"), board_photo())
    bird_film(folder / "film.mp4", 5)
    return folder


@pytest.fixture
def folder(made, monkeypatch):
    """The working folder, in which the test must change nothing."""
    monkeypatch.chdir(made)
    for name in ("COTARGET_PASSWORD", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("LP_NUM_THREADS", "1")  # emulate sets it, and how long threads take turns, for its process
    turns = sys.getswitchinterval()
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*")}
    yield made
    assert {path: path.stat().st_mtime_ns for path in made.rglob("*")} == before
    sys.setswitchinterval(turns)


def check(capsys, line, status, *parts):
    ended, out, err = call(capsys, *shlex.split(line))
    assert (ended, out) == (status, "")
    [said] = err.splitlines()
    assert said.startswith(f"cotarget {line.split()[0]}: " if line and line != "dance" else "cotarget: ")
    for part in parts:
        assert part in said


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call[0])
def test_wrong_call_ends_in_one_line(folder, capsys, call):
    check(capsys, *call)


@pytest.mark.render
@pytest.mark.parametrize("call", OPENED, ids=lambda call: call[0])
def test_wrong_call_found_with_the_rig_open_ends_in_one_line(folder, capsys, call):
    check(capsys, *call)


@pytest.mark.parametrize("line", FIRST)
def test_first_messages_have_this_wording(folder, capsys, line):
    _, _, said = call(capsys, *shlex.split(line))
    assert said == f"{' '.join(['cotarget', *line.split()[:1]])}: {FIRST[line]}\n"


@pytest.mark.wire
@pytest.mark.render
@pytest.mark.parametrize(
    "command", [("emulate", "--write", "new.toml", "--seconds", "1", "--control"), ("view", "--browser", "--port")]
)
def test_port_in_use_is_named(folder, capsys, command):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert port in refused(capsys, *command, port)


def test_labels_of_another_film_are_refused(folder, capsys, tmp_path):
    assert "late.csv: " in refused(capsys, *shlex.split(DETECT), tmp_path / "tracks.csv", "--labels", "late.csv")
