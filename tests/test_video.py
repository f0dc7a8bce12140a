"""Films written and read back, refused, and run through detector and tracker."""

import csv
import json
import re
import struct
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from cotarget.cli.main import main
from cotarget.config import DEFAULT_TARGETS
from cotarget.detect_video import COLUMNS, run_on_film
from cotarget.errors import CotargetError
from cotarget.video import Film, FilmWriter
from tests.support.commands import FILM_HZ as RATE
from tests.support.commands import bird_film

BIRD = DEFAULT_TARGETS["bird"]


def test_a_film_is_h264_yuv420p_and_reads_back(tmp_path):
    path = tmp_path / "a.mp4"
    bird_film(path, 10)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert "creation_time" not in container.metadata  # its epoch is not set
    with Film(path) as film:
        frames = list(film)
        assert film.size == (162, 122)
        assert film.rate_hz == pytest.approx(RATE)
    np.testing.assert_allclose([f.t for f in frames], np.arange(10) / RATE, atol=1e-3)
    assert frames[0].image[52, 8].max() < 70
    assert frames[0].image[20, 100].min() > 140
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".mov"])
def test_frames_are_shown_at_their_own_times(tmp_path, suffix):
    """A real rig's clock, which began with the machine; frames that were skipped or came late, and a jump back."""
    begin, gaps = 7_654_321.098, [0.04, 0.12, 0.04, 0.35, 0.041, 2.0, -0.04, 0.04]
    times = begin + np.concatenate([[0.0], np.cumsum(gaps)])
    path = tmp_path / f"a{suffix}"
    with FilmWriter(path, RATE) as film:
        film.epoch = datetime(2024, 2, 29, 23, 59, 58, tzinfo=UTC) - timedelta(seconds=begin)
        for t in times:
            film.write(np.zeros((48, 64, 3), np.uint8), t)
    with Film(path) as film:
        shown = np.array([frame.t for frame in film])
    whole = [0, 1, 2, 3, 4, 5, 6]
    np.testing.assert_allclose(shown[whole], times[whole] - begin, atol=1e-3)  # a millisecond is Matroska's tick
    assert shown[6] < shown[7] < shown[8] < shown[6] + 0.05
    with av.open(str(path)) as container:
        assert container.metadata.get("creation_time", "").startswith("2024-02-29T23:59:58")
        assert container.duration == pytest.approx(1e6 * (shown[-1] + 1 / RATE), abs=2e3)


@pytest.mark.parametrize(("matrix", "size"), [
    ((0, 1, -1, 0), (122, 162)),  # taken with a phone that was held upright
    ((-1, 0, 0, -1), (162, 122)),
    ((0, -1, 1, 0), (122, 162)),
])  # fmt: skip
def test_a_film_is_turned_as_players_turn_it(tmp_path, matrix, size):
    path, unit = tmp_path / "a.mp4", 0x10000
    bird_film(path, 3)
    content = path.read_bytes()
    straight = struct.pack(">9i", unit, 0, 0, 0, unit, 0, 0, 0, 0x40000000)
    at = content.index(straight, content.rindex(b"tkhd"))  # of the last header, which counts
    a, b, c, d = (unit * each for each in matrix)
    path.write_bytes(content[:at] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 0x40000000) + content[at + 36 :])
    _, shown = cv2.VideoCapture(str(path)).read()
    with Film(path) as film:
        assert film.size == size
        np.testing.assert_array_equal(next(iter(film)).image, shown)


def test_a_name_may_have_a_colon(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bird_film(Path("12:30:00.mp4"), 3)
    with Film(Path("12:30:00.mp4")) as film:
        assert len(list(film)) == 3


def test_films_that_cannot_be_read_name_the_file(tmp_path):
    text, sound, cut = tmp_path / "text.mp4", tmp_path / "sound.wav", tmp_path / "cut.mp4"
    text.write_text("no film")
    with av.open(str(sound), "w") as out:
        stream = out.add_stream("pcm_s16le", rate=8000)
        block = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        block.sample_rate = 8000
        out.mux(stream.encode(block))
    bird_film(tmp_path / "whole.mp4", 10)
    cut.write_bytes((tmp_path / "whole.mp4").read_bytes()[:300])
    for path in (tmp_path / "none.mp4", tmp_path, text, sound, cut):
        with pytest.raises(CotargetError, match=f"^{re.escape(str(path))}: ") as caught:
            run_on_film(path, BIRD, tmp_path / "out.csv")
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "out.csv").exists()


def other_film(path, codec, count=60, empty_from=None, begin=0, **options):
    """A film of noise in any container, from a number of frames on; from a frame on only every tenth is there."""
    rng = np.random.default_rng(0)
    with av.open(str(path), "w", options=options) as out:
        stream = out.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for i in range(count):
            if empty_from is not None and i >= empty_from and i % 10:
                continue
            picture = av.VideoFrame.from_ndarray(rng.integers(0, 256, (120, 160, 3), np.uint8), format="bgr24")
            picture.pts, picture.time_base = begin + i, Fraction(1, 25)
            out.mux(stream.encode(picture))
        out.mux(stream.encode(None))


KINDS = [
    ("a.mp4", "libx264", {"movflags": "faststart"}),
    ("b.mp4", "libx264", {"movflags": "frag_keyframe+empty_moov"}),
    ("a.mkv", "libx264", {}),
    ("a.avi", "mpeg4", {}),
    ("b.avi", "mjpeg", {}),
]


@pytest.mark.parametrize(("name", "codec", "options"), KINDS)
def test_a_film_that_is_cut_short_has_a_shortfall(tmp_path, name, codec, options):
    """Of 2.4 s; the frames up to the cut are those of the whole film."""
    whole, cut = tmp_path / f"whole-{name}", tmp_path / name
    other_film(whole, codec, **options)
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    with Film(whole) as film:
        frames = list(film)
        assert (len(frames), film.shortfall) == (60, "")
    with Film(cut) as film:
        left = list(film)
        assert 20 < len(left) < 45
        ends = left[-1].t + 1 / RATE
    assert re.fullmatch(r"the film says that it lasts 2\.4 s, and ends at 1\.\d s", film.shortfall)
    assert float(film.shortfall[-5:-2]) == pytest.approx(ends, abs=0.25)  # a few frames are lost with the last piece
    assert np.array_equal(left[10].image, frames[10].image)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts", "a.mpg", "a.mov", "a.h264", "a.flv"])
def test_a_whole_film_has_no_shortfall(tmp_path, name):
    """What says its length, and what does not or has it estimated; at a rate that slows down too."""
    codec = {"a.mpg": "mpeg1video", "a.flv": "flv"}.get(name, "libx264")
    for empty_from in (None, 30) if name in ("a.mp4", "a.mkv", "a.mov") else (None,):
        other_film(tmp_path / name, codec, empty_from=empty_from)
        with Film(tmp_path / name) as film:
            assert len(list(film)) == (60 if empty_from is None else 33)
            assert film.shortfall == ""


def damaged(whole, path, packets):
    """Copy a film, with these packets of it overwritten by zeros."""
    with av.open(str(whole)) as film:
        places = [(packet.pos, packet.size) for packet in film.demux(video=0) if packet.size]
    data = bytearray(whole.read_bytes())
    for packet in packets:
        at, size = places[packet]
        data[at : at + size] = bytes(size)
    path.write_bytes(data)


@pytest.mark.parametrize(("name", "write", "beside"), [
    ("a.mp4", bird_film, 6),  # frames that the decoder holds back, for their order or to work on several at a time
    ("b.mp4", lambda path: other_film(path, "libx264"), 6),
    ("a.avi", lambda path: other_film(path, "mpeg4"), 0),
    ("b.avi", lambda path: other_film(path, "mjpeg"), 0),
])  # fmt: skip
def test_frames_after_a_damaged_packet_keep_their_numbers(tmp_path, name, write, beside):
    """One alone, and two in a row."""
    whole = tmp_path / f"whole-{name}"
    write(whole)
    for lost in ((20,), (20, 40, 41)):
        damaged(whole, tmp_path / name, lost)
        with Film(tmp_path / name) as film:
            read = [(film.number, frame.t) for frame in film]
        begin = read[0][1]
        far = [(number, t) for number, t in read if min(abs(number - at) for at in lost) > beside]
        assert all(t - begin == pytest.approx(number / RATE, abs=1e-3) for number, t in far)
        assert len(read) == 60 - len(lost)
        packets, first = re.match(
            r"(\d) packets? from frame (\d+) on could not be decoded \(Invalid data", film.shortfall
        ).groups()
        assert int(packets) == len(lost)
        assert abs(int(first) - 20) <= beside


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_a_film_whose_time_does_not_begin_at_zero_is_whole(tmp_path, name):
    other_film(tmp_path / name, "libx264", begin=25_000)
    with Film(tmp_path / name) as film:
        assert len(list(film)) == 60
    assert film.shortfall == ""


def stamped(path, wild):
    """Write 30 frames from 100 s on, a cluster each, whose stamps [s] are overwritten by number."""
    with av.open(str(path), "w", options={"cluster_time_limit": "1", "cluster_size_limit": "1"}) as film:
        stream = film.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for k in range(30):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 8 * k, np.uint8), format="bgr24")
            frame.pts, frame.time_base = 2500 + k, Fraction(1, 25)
            film.mux(stream.encode(frame.reformat(format="yuvj420p")))
        film.mux(stream.encode(None))
    data = bytearray(path.read_bytes())
    clusters = [found.start() for found in re.finditer(rb"\x1f\x43\xb6\x75", data)]
    assert len(clusters) == 30
    for number, t in wild.items():
        at = data.index(b"\xe7", clusters[number] + 4)
        length = data[at + 1] & 0x7F
        data[at + 2 : at + 2 + length] = round(1000 * t).to_bytes(length, "big")
    path.write_bytes(data)


@pytest.mark.parametrize("wild", [{12: 162.0}, {12: 3.0}, {12: 162.0, 14: 163.0, 20: 100.5}])
def test_wild_time_stamps_are_replaced_and_reported(tmp_path, caplog, wild):
    stamped(tmp_path / "a.mkv", wild)
    with Film(tmp_path / "a.mkv") as film:
        frames = [(film.number, frame) for frame in film]
    np.testing.assert_allclose([frame.t for _, frame in frames], 100 + np.arange(30) / 25, atol=2e-3)
    assert [number for number, _ in frames] == list(range(30))
    assert [round(frame.image.mean() / 8) for _, frame in frames] == list(range(30))
    said = [f"a.mkv: the wild time stamp of frame {number} is replaced" for number in wild]
    assert [message.rpartition("/")[2] for message in caplog.messages] == said


@pytest.mark.parametrize(("first", "jump"), [(12, 60.0), (1, 60.0), (12, -0.48), (12, -40.0)])
def test_a_film_whose_time_jumps_and_stays_there_keeps_its_gap(tmp_path, caplog, first, jump):
    times = 100 + np.arange(30) / 25 + np.where(np.arange(30) < first, 0.0, jump)
    stamped(tmp_path / "a.mkv", dict(enumerate(times)))
    with Film(tmp_path / "a.mkv") as film:
        np.testing.assert_allclose([frame.t for frame in film], times, atol=1e-3)
    assert not caplog.records


def test_detect_continues_after_damage_and_counts_labels_beyond_the_end(tmp_path, capsys):
    other_film(tmp_path / "whole.avi", "mjpeg")
    labels = tmp_path / "labels.csv"
    labels.write_text("frame,x_px,y_px,width_px,height_px\n" + "".join(f"{i},5,5,9,9\n" for i in (10, 59, 60)))
    for name, lost, beyond in (("a.avi", [], 1), ("b.avi", [20], 1), ("c.avi", range(40, 60), 2)):
        damaged(tmp_path / "whole.avi", tmp_path / name, lost)
        command = ["detect", str(tmp_path / name), "--target", "bird", "--csv", str(tmp_path / "a.csv")]
        assert main([*command, "--labels", str(labels)]) == 0
        out, err = capsys.readouterr()
        found = json.loads(out)
        assert (found["frames"], found["last_frame"]) == (60 - len(lost), 39 if len(lost) > 1 else 59)
        assert found["labels_beyond_end"] == beyond
        assert ("another film" in err) == (not lost)
        if lost:
            said = f"{tmp_path / name}: is not whole: {found['shortfall']}; the results are of what there is\n"
            assert err.endswith(said)
        else:
            assert (found["shortfall"], "is not whole" in err) == (None, False)


def test_a_film_whose_size_changes_is_refused(tmp_path):
    path = tmp_path / "two.mjpeg"
    for width in (64, 96):
        picture = cv2.imencode(".jpg", np.full((48, width, 3), 128, np.uint8))[1].tobytes()
        with path.open("ab") as file:
            file.write(picture * 3)
    with pytest.raises(CotargetError, match=r"64x48 to 96x48 at frame 3"), Film(path) as film:
        list(film)


def test_run_on_film(tmp_path):
    film, table, drawn = tmp_path / "a.mp4", tmp_path / "a.csv", tmp_path / "drawn.mp4"
    bird_film(film)
    reported = []
    summary = run_on_film(film, BIRD, table, drawn, lambda *given: reported.append(given[:2]))
    assert reported == [(i, 60) for i in range(1, 61)]
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert {row["track"] for row in rows} == {"1"}
    assert summary.tracks == 1
    assert summary.frames == 60
    assert summary.frames_with_target == len(rows) > 35  # half a second to learn the sky, some frames to be sure
    for row in rows:
        i = int(row["frame"])
        if i < 40:  # while little of the sky is known, a slow bird's tail melts into it
            continue
        assert float(row["t"]) == pytest.approx(i / RATE, abs=1e-3)
        assert float(row["u_px"]) == pytest.approx(9.5 + 2 * i, abs=1.5)  # columns u-6 to u+5; coding blurs by a pixel
        assert float(row["v_px"]) == pytest.approx(52.5, abs=1.0)
        assert float(row["width_px"]) == pytest.approx(12, abs=3)
        assert 0 <= float(row["score"]) <= 1
    with Film(drawn) as out:
        last = list(out)[-1].image.astype(int)
    with Film(film) as original:
        before = list(original)[-1].image.astype(int)
    assert (np.abs(last - before).max(axis=2) > 60).sum() > 40  # a box, a number and a trail are there


def test_a_failed_run_keeps_the_old_table_and_no_film_is_overwritten(tmp_path):
    table = tmp_path / "a.csv"
    table.write_text("old")
    bird_film(tmp_path / "a.mp4", 5)

    def fail(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_on_film(tmp_path / "a.mp4", BIRD, table, tmp_path / "b.mp4", fail)
    assert table.read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.mp4"]
    with pytest.raises(CotargetError, match=r"a\.mp4: "):
        run_on_film(tmp_path / "a.mp4", BIRD, tmp_path / "a.mp4")
