"""Files get their name when they are complete, and are written through links."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

from cotarget.drawing import write_picture
from cotarget.errors import ConfigError, CotargetError
from cotarget.files import CsvFile, PartFile, write_atomically
from cotarget.video import Film, FilmWriter
from tests.support.full_disk import SAID, full_disk

ROOT = Path(__file__).parents[1]
IMAGE = np.full((48, 64, 3), 90, np.uint8)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def write_table(path, rows, error=None, keep=False):
    with CsvFile(path, ("n",), keep=keep) as table:
        for row in range(rows):
            table.write([row])
        if error is not None:
            raise error


def write_film(path, frames, error=None, keep=False):
    with FilmWriter(path, 25.0, keep=keep) as film:
        for number in range(frames):
            film.write(IMAGE, number / 25)
        if error is not None:
            raise error


@pytest.mark.parametrize(("name", "write"), [("a.csv", write_table), ("a.mp4", write_film)])
@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), SystemExit(143), ConfigError("the camera is gone"), ValueError()]
)
def test_partial_result_is_kept_after_an_error_with_a_note(tmp_path, name, write, error):
    error.__dict__.pop("__notes__", None)
    path = tmp_path / name
    path.write_text("old")
    with pytest.raises(type(error)):
        write(path, 3, error)
    assert path.read_text() == "old"
    with pytest.raises(type(error)) as caught:
        write(path, 0, error, keep=True)  # without a row there is nothing to keep
    assert path.read_text() == "old"
    assert not hasattr(caught.value, "__notes__")
    with pytest.raises(type(error)) as caught:
        write(path, 3, error, keep=True)
    assert [str(path) in note for note in caught.value.__notes__] == [True]
    assert names(tmp_path) == [name]
    if name == "a.csv":
        assert path.read_text().split() == ["n", "0", "1", "2"]
    else:
        assert len(times_in(path)) == 3


@pytest.mark.parametrize("keep", [True, False])
def test_full_disk_leaves_the_old_table(tmp_path, keep):
    path = tmp_path / "a.csv"
    path.write_text("old")
    with full_disk(), pytest.raises(ConfigError, match=f"a.csv: .*{SAID}"):
        write_table(path, 1, keep=keep)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.csv"]


def test_table_on_a_filling_disk_keeps_its_complete_lines(tmp_path):
    """The name of the column and 3 lines of "9\\r\\n" are 12 bytes, and the next is cut."""
    path = tmp_path / "a.csv"
    with full_disk(14), pytest.raises(ConfigError, match=r"a\.csv: ") as caught:
        write_table(path, 9, keep=True)
    assert str(path) in caught.value.__notes__[0]
    assert path.read_text().split() == ["n", "0", "1", "2"]


def test_film_without_room_for_its_header_is_removed(tmp_path):
    path = tmp_path / "a.mp4"
    with full_disk(1000), pytest.raises(KeyboardInterrupt) as caught:
        write_film(path, 3, KeyboardInterrupt(), keep=True)
    assert str(path) in caught.value.__notes__[0]
    assert names(tmp_path) == []


def noisy_film(path, seconds):
    """A film at 25 Hz whose seconds take some 60 kB each."""
    rng = np.random.default_rng(0)
    with FilmWriter(path, 25.0, keep=True) as film:
        for number in range(25 * seconds):
            film.write(rng.integers(0, 256, (48, 64, 3), np.uint8), number / 25)


def times_in(path):
    with Film(path) as film:
        return [frame.t for frame in film]


def full_at(path, size, part):
    """The error of a film for which the disk has room but for a part of its size.

    x264 reads memory that it has not written, by which films of the same frames differ in size by up to 2 %: a film
    that fitted was smaller, and gives the size for the next.
    """
    while True:
        try:
            with full_disk(int(part * size)):
                noisy_film(path, 6)
        except CotargetError as error:
            return error
        size = path.stat().st_size


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_film_on_a_filling_disk_can_be_played_up_to_there(tmp_path, suffix):
    whole, path = tmp_path / f"whole{suffix}", tmp_path / f"a{suffix}"
    noisy_film(whole, 6)
    size = whole.stat().st_size
    for part, least, most in ((0.6, 50, 100), (1 - 1e-3, 125, 150)):  # on the way, and when it is completed
        error = full_at(path, size, part)
        assert re.search(rf"a{suffix}: .*{SAID}", str(error))
        assert [str(error), *getattr(error, "__notes__", ())][-1].endswith("holds what there was until then")
        times = times_in(path)
        assert least <= len(times) <= most
        np.testing.assert_allclose(times, np.arange(len(times)) / 25, atol=1e-3)
    assert names(tmp_path) == sorted([f"a{suffix}", f"whole{suffix}"])


def test_two_runs_on_one_result_leave_the_whole_file_of_the_later(tmp_path):
    path = tmp_path / "a.csv"
    with CsvFile(path, ("n",)) as first:
        first.write([1])
        write_table(path, 3)
        assert path.read_text().split() == ["n", "0", "1", "2"]
    assert path.read_text().split() == ["n", "1"]
    assert names(tmp_path) == ["a.csv"]


class Signalled:
    """A film's container; its process gets a signal while the film is completed."""

    def __init__(self, container):
        self.container, self.number = container, None

    def __getattr__(self, name):
        return getattr(self.container, name)

    def mux(self, packets):
        if self.number is not None:
            signal.raise_signal(self.number)
        self.container.mux(packets)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_second_signal_while_a_film_is_completed_loses_nothing(tmp_path, monkeypatch, number):
    """The first one has ended the run; the second one is ignored while the file is completed."""
    containers, plain = [], av.open
    monkeypatch.setattr(av, "open", lambda *a, **k: containers.append(Signalled(plain(*a, **k))) or containers[-1])

    def leave(*_):
        raise KeyboardInterrupt("second")

    def write_and_end():
        with FilmWriter(tmp_path / "a.mp4", 25.0, keep=True) as film:
            for index in range(3):
                film.write(IMAGE, index / 25)
            containers[0].number = number
            raise KeyboardInterrupt("first")

    former = signal.signal(number, leave)
    try:
        with pytest.raises(KeyboardInterrupt, match="first") as caught:
            write_and_end()
        assert signal.getsignal(number) is leave
    finally:
        signal.signal(number, former)
    assert str(tmp_path / "a.mp4") in caught.value.__notes__[0]
    assert len(times_in(tmp_path / "a.mp4")) == 3


@pytest.fixture
def _ctrl_c():
    """Ctrl-C raises KeyboardInterrupt, as it does outside of pytest."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.usefixtures("_ctrl_c")
def test_signal_while_a_file_is_completed_acts_afterwards(tmp_path):
    path = tmp_path / "a.json"
    with pytest.raises(KeyboardInterrupt):
        complete(PartFile(path), signals=1)
    assert path.read_text() == "whole"


@pytest.mark.usefixtures("_ctrl_c")
def test_repeated_ctrl_c_abandons_a_file(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        complete(PartFile(tmp_path / "a.json"), signals=3)
    assert names(tmp_path) == []


def complete(part, signals):
    with part.ending(keep=True):
        for _ in range(signals):
            signal.raise_signal(signal.SIGINT)
        part.file.write(b"whole")


KILLED = """
import os, pathlib
import numpy as np
from cotarget.files import CsvFile
from cotarget.video import FilmWriter
table, film = CsvFile(pathlib.Path("a.csv"), ("n",)), FilmWriter(pathlib.Path("a.mp4"), 25.0)
rng = np.random.default_rng(0)
for number in range(150):
    table.write([number])
    film.write(rng.integers(0, 256, (48, 64, 3), np.uint8), number / 25)
os.kill(os.getpid(), 9)
"""


def test_part_file_of_a_killed_run_is_readable(tmp_path):
    subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, check=False)
    [table], [film] = tmp_path.glob(".a.*.part.csv"), tmp_path.glob(".a.*.part.mp4")
    assert table.read_text().split() == ["n", *map(str, range(150))]
    assert len(times_in(film)) >= 50
    assert len(names(tmp_path)) == 2


@pytest.mark.parametrize("exists", [True, False])
def test_link_is_kept_and_its_target_written(tmp_path, exists):
    (tmp_path / "far").mkdir()
    (tmp_path / "near").mkdir()
    goal, link = tmp_path / "far" / "goal.csv", tmp_path / "near" / "a.csv"
    link.symlink_to(goal)
    if exists:
        goal.write_text("old")
    write_table(link, 1)
    assert link.is_symlink()
    assert goal.read_text().split() == ["n", "0"]
    write_atomically(link, b"whole")
    assert link.is_symlink()
    assert goal.read_bytes() == b"whole"
    assert names(goal.parent) == ["goal.csv"]
    assert names(link.parent) == ["a.csv"]


def test_picture_is_the_old_or_the_new_one(tmp_path):
    path = tmp_path / "a.png"
    write_picture(path, IMAGE)
    old = path.read_bytes()
    with full_disk(10), pytest.raises(ConfigError, match=f"a.png: .*{SAID}"):
        write_picture(path, np.zeros_like(IMAGE))
    assert path.read_bytes() == old
    assert names(tmp_path) == ["a.png"]
