"""Scores of rows made by hand, and the table on disk."""

import dataclasses
import math

import pytest

from cotarget.errors import ConfigError
from cotarget.metrics import Row, Score, out_of_frame_s, read_rows, score, write_rows

PERIOD = 0.04
EXACT = 1e-9
CENTRE = (319.5, 239.5)  # of a 640x480 image whose pixel centres are whole numbers
HALF_DIAGONAL = 400.0  # of 640x480
GOOD = Row(
    t_s=0.0, t_fixed_s=0.0, state="following", track=1, u_px=CENTRE[0], v_px=CENTRE[1], width_px=640, height_px=480,
    size_px=160.0, wanted_px=160.0, visible=1.0, in_wide=True, u_wide_px=100.0, v_wide_px=50.0, u_detected_px=100.0,
    v_detected_px=50.0, decoded=True, decoded_wide=False, off_target="", range_m=10.0, depth_m=10.0,
    pan_commanded_deg=1.0, tilt_commanded_deg=2.0, focal_commanded_px=5000.0, pan_deg=1.0, tilt_deg=2.0,
    focal_px=1000.0,
)  # fmt: skip
AWAY = {"u_px": 700.0, "visible": 0.0}


def run(*parts):
    """Rows at 25 Hz from (how many, what differs) in turn."""
    differences = [change for count, change in parts for _ in range(count)]
    return [dataclasses.replace(GOOD, t_s=i * PERIOD, **change) for i, change in enumerate(differences)]


def test_a_perfect_run():
    """Two seconds of learning do not count: 50 of 150 rows lie before t = 2 s."""
    found = score(run((150, {})))
    assert found == Score(
        frames=100, time_to_acquire_s=0.0, closeup_yield=1.0, centred_yield=1.0, in_frame_ratio=1.0, tpo_px_median=0.0,
        tpo_width_median=0.0, tpo_deg_median=0.0, size_ratio_median=1.0, wanted_px=160.0, range_m=10.0,
        tpe_px_median=0.0, fragmentation_per_min=0.0, identification=1.0, identification_wide=0.0,
        commands_per_min=0.0, reversals_per_min=0.0, false_tracks_per_min=0.0, lens_commands_per_min=0.0,
        id_switches_per_min=0.0,
    )  # fmt: skip


def test_counting_starts_with_the_target_wholly_in_the_fixed_view_after_2_s():
    late = score(run((100, {"in_wide": False, **AWAY}), (25, AWAY), (75, {})))
    assert late.frames == 100  # it may leave the wide view again; what counts is the first time
    assert late.time_to_acquire_s == pytest.approx(25 * PERIOD, abs=EXACT)
    assert late.closeup_yield == pytest.approx(0.75)
    early = score(run((20, {}), (40, AWAY), (40, {})))  # what happened before 2 s is forgotten
    assert early.frames == 50
    assert early.time_to_acquire_s == pytest.approx(10 * PERIOD, abs=EXACT)
    gone_again = score(run((60, {}), (40, {"in_wide": False, **AWAY})))
    assert gone_again.frames == 50
    rows = [dataclasses.replace(row, t_s=1000.0 + row.t_s) for row in run((120, {}))]
    assert score(rows).frames == 70  # the clock may begin anywhere


def test_time_out_of_frame_counts_after_acquisition_and_while_nothing_hides_the_target():
    """Ten rows before the acquisition and five hidden ones do not count; twenty of 0.04 s do."""
    rows = run((60, AWAY), (30, {}), (5, AWAY | {"hidden": True}), (20, AWAY), (10, {}))
    assert out_of_frame_s(rows) == pytest.approx(20 * PERIOD, abs=EXACT)
    assert out_of_frame_s(run((100, AWAY))) == math.inf


def test_acquisition_is_at_the_start_of_the_first_half_second_in_frame():
    """12 rows in frame span 0.44 s and do not count; the next ones, from row 90 on, do."""
    found = score(run((60, AWAY), (12, {}), (18, AWAY), (30, {})))
    assert found.time_to_acquire_s == pytest.approx((90 - 50) * PERIOD, abs=EXACT)
    assert found.in_frame_ratio == 1.0  # counted from row 90 on
    assert found.closeup_yield == pytest.approx((12 + 30) / 70)  # counted from row 50 on


def test_lost_frames_count():
    found = score(run((50, {}), (60, {}), (40, {**AWAY, "track": -1, "state": "lost"})))
    assert found.in_frame_ratio == pytest.approx(0.6)
    assert found.closeup_yield == pytest.approx(0.6)
    assert found.tpo_px_median == 0.0
    mostly = score(run((50, {}), (40, {}), (60, AWAY)))
    assert mostly.tpo_px_median == pytest.approx(HALF_DIAGONAL)
    assert mostly.tpo_width_median == pytest.approx(HALF_DIAGONAL / 640)


def test_a_target_behind_the_camera_has_size_0_and_the_largest_offset():
    """30 good frames, then 50 that show nothing of it: of 80 the median is 0, as that of the offset is the worst."""
    behind = {"u_px": math.nan, "v_px": math.nan, "size_px": math.nan, "visible": 0.0}
    found = score(run((50, {}), (30, {}), (50, behind)))
    assert found.size_ratio_median == 0.0
    assert found.tpo_width_median == pytest.approx(HALF_DIAGONAL / 640)


def test_never_acquired_never_there_and_a_single_row():
    never = score(run((100, AWAY)))
    assert (never.frames, never.closeup_yield) == (50, 0.0)
    for field in ("time_to_acquire_s", "in_frame_ratio", "tpo_px_median", "tpo_width_median", "tpo_deg_median",
                  "size_ratio_median", "fragmentation_per_min"):  # fmt: skip
        assert getattr(never, field) is None, field
    assert never.range_m == 10.0
    assert never.summary() == "never acquired in 50 frames"
    for rows in ([], run((100, {"in_wide": False})), run((40, {}))):
        assert score(rows) == Score(0, *[None] * 11)
    found = score(run((51, {})))
    assert found.frames == 1
    assert (found.commands_per_min, found.reversals_per_min, found.false_tracks_per_min) == (None, None, None)


@pytest.mark.parametrize(("change", "in_frame", "good"), [
    ({}, True, True),
    ({"size_px": 0.79 * 160}, True, False),
    ({"size_px": 0.81 * 160}, True, True),
    ({"size_px": 1.24 * 160}, True, True),
    ({"size_px": 1.26 * 160}, True, False),
    ({"size_px": 0.51 * 160}, True, False),
    ({"size_px": 0.49 * 160}, False, False),
    ({"size_px": math.nan}, False, False),
    ({"visible": 0.51}, True, False),
    ({"visible": 0.49}, False, False),
    ({"u_px": -0.4}, True, True),  # pixels reach half a pixel beyond their centres
    ({"u_px": -0.6}, False, False),
    ({"u_px": 639.4, "v_px": 479.4}, True, True),
    ({"v_px": 479.6}, False, False),
    ({"u_px": math.nan, "v_px": math.nan}, False, False),  # behind the camera
])  # fmt: skip
def test_in_frame_and_good_closeup(change, in_frame, good):
    row = dataclasses.replace(GOOD, **change)
    assert (row.closeup.in_frame, row.closeup.good) == (in_frame, good)


@pytest.mark.parametrize(("change", "centred"), [
    ({}, True), ({"u_px": CENTRE[0] + 32}, True), ({"u_px": CENTRE[0] + 33}, False),  # 5 % of 640 px
    ({"u_px": CENTRE[0] - 20, "v_px": CENTRE[1] + 24}, True), ({"v_px": CENTRE[1] - 33}, False),
    ({"size_px": 1.26 * 160}, False), ({"visible": 0.9}, False),
])  # fmt: skip
def test_a_centred_closeup_is_a_good_one_with_the_target_near_the_centre(change, centred):
    assert dataclasses.replace(GOOD, **change).closeup.centred == centred


def test_frames_in_which_something_hides_the_target_do_not_count_in_the_yields_and_those_after_do():
    """Of 100 frames 20 are hidden. Of the other 80, 60 are good and 40 of these centred."""
    aside = {"u_px": CENTRE[0] + 40}
    found = score(run((50, {}), (40, {}), (20, {"visible": 0.0, "hidden": True}), (20, AWAY), (20, aside)))
    assert (found.frames, found.closeup_yield, found.centred_yield) == (100, 0.75, 0.5)
    hidden = score(run((60, {"hidden": True, "visible": 0.0})))
    assert (hidden.closeup_yield, hidden.centred_yield) == (None, None)


def test_target_point_offset():
    off = dataclasses.replace(GOOD, u_px=CENTRE[0] + 30, v_px=CENTRE[1] - 40)
    assert off.closeup.tpo_px == pytest.approx(50.0)
    assert off.tpo_deg == pytest.approx(math.degrees(math.atan(0.05)))
    for lost in (AWAY, {"u_px": math.nan, "v_px": math.nan}):
        assert dataclasses.replace(GOOD, **lost).closeup.tpo_px == pytest.approx(HALF_DIAGONAL)


def test_medians():
    """Three thirds after acquisition: the middle one is the median. TPE counts frames with a detection only."""
    thirds = [
        (20, {"u_px": CENTRE[0] + 16, "size_px": 144.0, "u_detected_px": 103.0, "v_detected_px": 54.0}),
        (20, {"u_px": CENTRE[0] + 32, "size_px": 160.0, "u_detected_px": 103.0, "v_detected_px": 54.0}),
        (20, {"u_px": CENTRE[0] + 64, "size_px": 176.0, "u_detected_px": math.nan}),
    ]
    found = score(run((50, {}), *thirds))
    assert (
        found.summary() == "acquired after 0.00 s, yield 1.00, centred 0.67, offset 5.0% of the width, size ratio 1.00"
    )
    assert found.tpo_px_median == pytest.approx(32.0)
    assert found.tpo_width_median == pytest.approx(0.05)
    assert found.tpo_deg_median == pytest.approx(math.degrees(math.atan(0.032)))
    assert found.size_ratio_median == pytest.approx(1.0)
    assert found.tpe_px_median == pytest.approx(5.0)


@pytest.mark.parametrize(("parts", "breaks"), [
    ([(100, {})], 0),
    ([(40, {}), (5, AWAY), (55, {})], 0),  # out at k, back at k + 5: 0.2 s, no longer than that
    ([(40, {}), (6, AWAY), (54, {})], 1),
    ([(40, {}), (6, AWAY), (24, {}), (10, AWAY), (20, {})], 2),
    ([(40, {}), (60, AWAY)], 1),  # a break that the run's end cuts off
    ([(40, {}), (60, {"size_px": 60.0})], 1),  # too small is out of frame
])  # fmt: skip
def test_fragmentation_per_minute(parts, breaks):
    """100 rows after acquisition are 99 periods, 3.96 s."""
    found = score(run((50, {}), *parts))
    assert found.fragmentation_per_min == pytest.approx(breaks * 60 / (99 * PERIOD))


COUNTED_MIN = 99 * PERIOD / 60  # from the first to the last of 100 rows after the start


def test_identification_counts_all_frames_since_the_start():
    """25 and 5 of 100 rows; those before the start are forgotten, those before acquisition count."""
    parts = (50, {"decoded_wide": True}), (70, {**AWAY, "decoded": False}), (5, {"decoded_wide": True}), (25, {})
    found = score(run(*parts))
    assert found.identification == pytest.approx(0.30)
    assert found.identification_wide == pytest.approx(0.05)


def commanded(*pairs):
    """Rows of the start, then the commanded (pan, tilt) given, then the last of them up to 100 rows."""
    rows = run((150, {}))
    pairs = [pairs[0]] * 50 + list(pairs) + [pairs[-1]] * (100 - len(pairs))
    return [
        dataclasses.replace(row, pan_commanded_deg=pan, tilt_commanded_deg=tilt)
        for row, (pan, tilt) in zip(rows, pairs, strict=True)
    ]


@pytest.mark.parametrize(("pairs", "reversals"), [
    ([(0, 0)], 0),
    ([(0, 0), (1, 0), (2, 0), (2, 0), (3, 0)], 0),  # on in one direction, with a pause
    ([(0, 0), (1, 1), (2, 2)], 0),
    ([(0, 0), (1, 0), (1, 1), (2, 1)], 0),
    ([(0, 0), (1, 0), (0, 0), (1, 0)], 2),
    ([(0, 0), (1, 0), (1, 0), (0, 0)], 1),  # a pause does not hide a reversal
    ([(0, 0), (1, 1), (0, 0)], 2),  # of each axis
])  # fmt: skip
def test_reversals(pairs, reversals):
    assert score(commanded(*pairs)).reversals_per_min == pytest.approx(reversals / COUNTED_MIN)


def test_commands_to_the_same_goal_count():
    """A command with every row to the same goal, and one to the lens with every tenth."""
    rows = [
        dataclasses.replace(row, head_commands=7 + i, lens_commands=1 + i // 10) for i, row in enumerate(run((150, {})))
    ]
    found = score(rows)
    assert found.commands_per_min == pytest.approx(99 / COUNTED_MIN)  # those of the start are forgotten
    assert found.lens_commands_per_min == pytest.approx(9 / COUNTED_MIN)
    assert found.reversals_per_min == 0.0
    every_other = score(rows[::2])  # of a zoom camera half as fast: what was sent between its frames counts too
    assert every_other.commands_per_min == pytest.approx(98 / (98 * PERIOD / 60))


@pytest.mark.parametrize(("parts", "count"), [
    ([(100, {})], 0),
    ([(13, {"off_target": "3"}), (87, {})], 0),  # 12 periods, 0.48 s
    ([(14, {"off_target": "3"}), (86, {})], 1),
    ([(7, {"off_target": "3"}), (1, {}), (7, {"off_target": "3"}), (85, {})], 0),  # not on end
    ([(7, {"off_target": "3"}), (7, {"off_target": "7"}), (86, {})], 0),  # two tracks, each too short
    ([(7, {"off_target": "3"}), (7, {"off_target": "3 7"}), (7, {"off_target": "7"}), (79, {})], 2),
    ([(20, {"off_target": "3"}), (20, {}), (20, {"off_target": "3"}), (40, {})], 1),  # a track is false once
    ([(86, {}), (14, {"off_target": "13"})], 1),
])  # fmt: skip
def test_false_tracks(parts, count):
    assert score(run((50, {}), *parts)).false_tracks_per_min == pytest.approx(count / COUNTED_MIN)


@pytest.mark.parametrize(("parts", "count"), [
    ([(50, {"on_target": "3:bird"}), (50, {"on_target": "3:bird"})], 0),
    ([(50, {"on_target": "3:bird"}), (50, {"on_target": "3:bird2"})], 1),
    ([(40, {"on_target": "3:bird"}), (20, {}), (40, {"on_target": "3:bird2"})], 1),  # over a gap, too
    ([(50, {"on_target": "3:bird 7:bird2"}), (50, {"on_target": "3:bird2 7:bird"})], 2),
    ([(50, {"on_target": "3:bird"}), (50, {"on_target": "7:bird2"})], 0),  # another track
    ([(50, {"on_target": "3:bird"}), (20, {"on_target": "3:bird2 3:bird"}), (30, {"on_target": "3:bird"})], 0),  # pass
    ([(50, {"on_target": "3:bird"}), (20, {"on_target": "3:bird2 3:bird"}), (30, {"on_target": "3:bird2"})], 1),
    ([(30, {"on_target": "3:bird"}), (30, {"on_target": "3:bird2"}), (40, {"on_target": "3:bird"})], 2),
])  # fmt: skip
def test_id_switches(parts, count):
    assert score(run((50, {}), *parts)).id_switches_per_min == pytest.approx(count / COUNTED_MIN)


def test_the_table_comes_back_exactly(tmp_path):
    path = tmp_path / "steps.csv"
    rows = run((3, {"u_px": 1 / 3, "off_target": "3 7"}), (2, {"in_wide": False, "state": "lost", "track": -1}))
    write_rows(path, rows)
    assert read_rows(path) == rows
    assert path.read_text().splitlines()[0].split(",") == [field.name for field in dataclasses.fields(Row)]
    write_rows(path, [dataclasses.replace(GOOD, u_px=math.nan, depth_m=math.nan)])
    back = read_rows(path)[0]
    assert math.isnan(back.u_px)
    assert math.isnan(back.depth_m)
    write_rows(path, [])
    assert read_rows(path) == []


def table(edit):
    names = [field.name for field in dataclasses.fields(Row)]
    values = [str(getattr(GOOD, name)) for name in names]
    names, values = edit(names, values)
    return (",".join(names) + "\n" + ",".join(values) + "\n").encode()


@pytest.mark.parametrize("content", [
    table(lambda n, v: (n[1:], v[1:])),  # a column is missing
    table(lambda n, v: (n, v[:-1])),  # the last line was cut off
    table(lambda n, v: (n, ["soon", *v[1:]])),
    table(lambda n, v: (n, [t.replace("True", "yes") for t in v])),
    table(lambda n, v: (n, [*v[:3], "1.5", *v[4:]])),  # the track's number
    b"",
    b"\x00\xff\xfe\x89PNG\r\n",
    b'{"json": 1}\n',
])  # fmt: skip
def test_a_file_that_is_no_table_is_refused(tmp_path, content):
    path = tmp_path / "steps.csv"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"steps\.csv: is no steps\.csv") as caught:
        read_rows(path)
    assert "\n" not in str(caught.value)
