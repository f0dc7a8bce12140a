"""The report on a calibration: what it says is so, whatever the calibration lacks, and the page needs nothing."""

import base64
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from cotarget import cli
from cotarget.calibration import Covariance, HeldOut, Options, Rejected, calibrate_views
from cotarget.cli.calibrate import calibration_summary
from cotarget.errors import CalibrationError
from cotarget.report.analysis import (
    JITTER_GROUP,
    Analysis,
    Corners,
    analyse,
    averaged,
    empty_places,
    gather,
    left_open,
    lens_curves,
    pointing,
    what_stays,
    with_more_placements,
)
from cotarget.report.page import write_report
from cotarget.report.text import advice, digits, judge
from experiments.calibration.synthetic.aims import pointing_errors
from experiments.calibration.synthetic.rig import NOMINAL_PX, SIZE, SIZES, Lens, Stop, Truth
from experiments.calibration.synthetic.views import Placing, synthetic_views
from tests.support.rigs import with_zoom_head
from tests.support.synthetic_calibration import BOARD, NOISE_PX, POINTS, drawn_at_stops

SECTIONS = ["figures", "pointing", "parameters", "residuals", "coverage", "lens", "heldout", "rejected", "advice"]
ZOOMED = 3.0  # the second stop's focal length over the first's
LARGEST_PAGE = 3_000_000
UNCHECKED = Options(folds=0)  # nothing is kept out, to be quick
UNKNOWN = Analysis((), (), {}, None)
ROUNDED = 0.06  # two digits are printed
FAR_LENS = Lens(ZOOMED * 692.0, ZOOMED * 693.0, 328.0, 234.0)
ZOOMING = Truth(stops=(Stop(ZOOMED * NOMINAL_PX, FAR_LENS, 0.01),))


@pytest.fixture(scope="module")
def plain():
    views = synthetic_views(Truth(), POINTS, np.random.default_rng(2), boards=12, moved=2)
    return calibrate_views(views, BOARD, SIZES)


@pytest.fixture(scope="module")
def stops():
    views = drawn_at_stops(ZOOMING, np.random.default_rng(4), Placing(boards=8), looks=1)
    return calibrate_views(views, BOARD, SIZES, pitch_mm=0.005, options=UNCHECKED)


def bare(calibration, **changes):
    """Without corners, so that a page is written quickly."""
    return replace(calibration, views=(), **changes)


def text_of(page):
    """What a reader sees of a page."""
    return " ".join(unescape(re.sub(r"<style>.*?</style>|<[^>]+>", " ", page, flags=re.S)).split())


class Reader(HTMLParser):
    """Checks that elements are nested and closed, and keeps what could load something."""

    VOID = ("meta", "img")

    def __init__(self):
        super().__init__()
        self.open, self.images, self.sections, self.loads = [], [], [], []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "img":
            self.images.append(given)
        if tag == "section":
            self.sections.append(given["id"])
        self.loads += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "action") and "data:" not in v]
        self.loads += [tag] if tag in ("script", "link", "iframe", "object") else []
        self.loads += [k for k, _ in attrs if k.startswith("on")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def read(page):
    reader = Reader()
    reader.feed(page)
    assert not reader.open
    return reader


def test_page_is_complete_and_self_contained(stops, plain, tmp_path):
    path = tmp_path / "r.html"
    found = write_report(path, stops, "stops.json")
    page = path.read_text()
    reader = read(page)
    assert reader.sections == SECTIONS
    assert reader.loads == []
    assert "http" not in re.sub(r"base64,[^\"]+", "", page)
    assert len(page) < LARGEST_PAGE
    assert found.text in text_of(page)
    assert len(reader.images) == len(list((tmp_path / "r_pictures").glob("*.png"))) == 8
    for image in reader.images:
        assert len(image["alt"]) > 20
        assert base64.b64decode(image["src"].removeprefix("data:image/png;base64,")).startswith(b"\x89PNG")
    for picture in (tmp_path / "r_pictures").iterdir():
        assert cv2.imread(str(picture)).std() > 1  # not blank

    write_report(path, bare(plain, covariance=None), "plain.json")  # without pictures: those of before go
    assert list((tmp_path / "r_pictures").iterdir()) == []
    assert read(path.read_text()).images == []


def test_numbers_in_the_page_are_those_of_the_calibration(plain, tmp_path):
    rejected = tuple(Rejected(f"<script>{i}</script>.png", "blurred & <b>dark</b>") for i in range(9))
    changed = bare(
        plain,
        residuals=replace(plain.residuals, rejected=rejected, outliers=3),
        provenance={**plain.provenance, "rig": "<img src=x onerror=alert(1)>"},
        jitter=np.radians(0.02),
        held_out=HeldOut(20, 0.123, 0.0456, 0.1, 1.95, 2.0),
    )
    write_report(tmp_path / "r.html", changed, "<i>x</i>.json")
    page = (tmp_path / "r.html").read_text()
    text = text_of(page)
    sigma = np.sqrt(plain.covariance.matrix[0, 0])
    assert plain.covariance.parameters[0] == "fixed.fx"
    value, printed = re.search(r"focal length across ([\d.]+) ± ([\d.]+) px", text).groups()
    assert float(value) == pytest.approx(plain.fixed.lens.focal_px[0], abs=sigma)
    assert float(printed) == pytest.approx(sigma, rel=ROUNDED)
    shift = plain.zoom_head.T_zoom0_fixed.translation[0] * 1000
    assert float(re.search(r"position x (-?[\d.]+) ±", text).group(1)) == pytest.approx(shift, abs=0.5)
    assert "distance measured 0.123 px distance predicted 0.0456 px" in text
    assert "each distance over its predicted value 1.95" in text
    assert "They disagree: the miss is 2.0 times what it should be" in text
    assert "0.020 degrees an axis" in text
    assert "9 images, 3 single corners" in text
    for name in ("<script>8</script>.png", "blurred & <b>dark</b>", "<img src=x onerror=alert(1)>", "<i>x</i>.json"):
        assert name in text
    assert read(page).loads == []
    assert len(read(page).images) == 2


@pytest.mark.slow
def test_verdict_agrees_with_the_measured_pointing_error(plain, stops):
    for calibration in (plain, stops):
        said = float(re.match(r"Points to ([\d.]+) degrees", judge(calibration).text).group(1))
        errors = pointing_errors(calibration, Truth(), np.random.default_rng(1), 30)
        # One calibration's error is one draw; over the view it is within a factor of three but once in hundreds.
        assert said / 3 < np.sqrt(np.mean(errors**2)) < said * 3
    last = pointing(stops)[-1]
    assert last.focal_px == pytest.approx(ZOOMED * Truth().zoom.fx, rel=0.01)
    assert (
        f"({digits(last.rms * last.focal_px)} px at {last.focal_px:.0f} px, the longest focal length"
        in judge(stops).text
    )


def without_covariance(method):
    return {"covariance": None, "held_out": None, "provenance": {"method": method}}


@pytest.mark.parametrize(("changed", "level", "said"), [
    (lambda c: {}, "good", "captures kept out of the fit agree"),
    (lambda c: {"held_out": replace(c.held_out, widened=1.84)}, "care", "Captures kept out of the fit miss 1.8 times"),
    (lambda c: {"held_out": replace(c.held_out, ratio=0.5)}, "care", "miss only 0.50 times"),
    (lambda c: {"held_out": None}, "care", "no captures were kept out"),
    (lambda c: {"jitter": np.radians(0.05)}, "care", "by 0.050 degrees an axis"),
    (lambda c: {"jitter": np.radians(3.0)}, "care", "of the close-up's width"),
    (lambda c: {"jitter": np.radians(30.0)}, "bad", "of the close-up's width"),
    (lambda c: {"covariance": c.covariance.scaled({"T_head_zoom.rx": 1e6})}, "bad", "T_head_zoom"),
    (lambda c: without_covariance("sequential"), "unknown", "sequential method"),
    (lambda c: without_covariance("joint"), "bad", "undetermined"),
    (lambda c: without_covariance(""), "unknown", "has no uncertainty"),
    (lambda c: {"zoom_head": replace(c.zoom_head, T_head_zoom=None)}, "unknown", "without a head"),
    (lambda c: {"provenance": {"focal_range_px": [667.0, 2001.0]}}, "care", "the lens goes to 2001 px"),
    (lambda c: {"provenance": {"focal_range_px": [667.0, 2001.0]}}, "care", "show a larger board farther away"),
    (lambda c: {"provenance": {"focal_range_px": [667.0, 667.0]}}, "good", "captures kept out of the fit agree"),
])  # fmt: skip
def test_verdict_levels(plain, changed, level, said):
    found = judge(bare(plain, **changed(plain)))
    assert found.level == level
    assert said in found.text


def test_widening_does_not_make_parameters_undetermined(plain):
    """However far it has captures miss; what is undetermined is still said."""
    scaled = plain.covariance.scaled
    wide, held_out = scaled(dict.fromkeys(plain.covariance.parameters, 3e3)), replace(plain.held_out, widened=3000.0)
    wrong = bare(plain, held_out=held_out, covariance=wide)
    assert "not determine" not in judge(wrong).text
    assert "not determine" in judge(replace(wrong, held_out=plain.held_out)).text
    assert "does not determine the rig" in judge(replace(wrong, covariance=wide.scaled({"T_head_zoom.rx": 1e6}))).text
    words = advice(wrong, UNKNOWN)
    assert "more captures do not help" in words[0]
    assert not any("Add what is missing" in item for item in words)


def test_what_a_covariance_leaves_open_does_not_depend_on_units(plain):
    """With a lens of 35 000 px, k2 is as well known with 6 million times the standard deviation, in its unit."""
    lens, f = plain.zoom_head.lens, 50.0
    longer = replace(lens, nominal_px=(f * lens.nominal_px[0],), stops=(lens.stops[0].scaled(f),))
    powers = {"fx": 1, "fy": 1, "k1": 2, "k2": 4, "p1": 1, "p2": 1}
    covariance = plain.covariance.scaled({f"zoom[0].{name}": f**power for name, power in powers.items()})
    tele = with_zoom_head(bare(plain, covariance=covariance), lens=longer)
    assert left_open(plain) == left_open(tele) == ""
    unknown = replace(tele, covariance=covariance.scaled({"T_zoom0_fixed.tz": 1e6}))
    assert left_open(unknown).startswith("T_zoom0_fixed's position is free")


def test_corners_of_another_rig_are_noticed(plain):
    others = tuple(replace(view, corners_px=view.corners_px[::-1] / 2) for view in plain.views)
    assert "not made from them" in judge(replace(plain, views=others)).text


def partial_calibrations():
    """By name, whether the calibration has a head, and what else is changed."""
    nothing = {"covariance": None, "held_out": None, "residuals": None, "board": None, "provenance": {}}
    return {
        "photos": (False, {"covariance": None}),
        "nothing but the rig": (True, nothing),
        "not even a head": (False, nothing),
        "one parameter": (True, {"covariance": Covariance(("fixed.fx",), np.eye(1))}),
    }


@pytest.mark.parametrize(("has_head", "changes"), partial_calibrations().values(), ids=partial_calibrations())
def test_page_of_an_incomplete_calibration(plain, has_head, changes, tmp_path):
    calibration = bare(plain if has_head else with_zoom_head(plain, T_head_zoom=None), **changes)
    found = write_report(tmp_path / "r.html", calibration)
    page = (tmp_path / "r.html").read_text()
    assert read(page).sections == [name for name in SECTIONS if name != "lens"]
    assert found.text in text_of(page)
    assert " nan" not in text_of(page)


def test_residuals_of_stored_corners_equal_their_noise(plain):
    evidence = gather(plain)
    for corners in evidence.corners.values():
        assert corners.sigma == pytest.approx(NOISE_PX, rel=0.1)
        assert averaged(corners).beyond_chance.mean() < 0.1
    assert len(evidence.distances) == 12
    assert 2.5 < evidence.distances.min() < evidence.distances.max() < 10
    assert evidence.per_stop == (sum(view.camera == "zoom" for view in plain.views),)
    assert gather(bare(plain)) is None


def one_line(view, seen=slice(0, 5)):
    """The view with a few corners of one row alone."""
    corners = np.full_like(view.corners_px, np.nan)
    corners[seen] = view.corners_px[seen]
    return replace(view, corners_px=corners, source="line.png")


def test_view_with_corners_on_one_line_is_left_out_of_the_report(plain, caplog):
    for bad in (
        one_line(plain.views[0]),
        one_line(plain.views[0], slice(0, 40, 10)),  # the diagonal
        replace(plain.views[0], corners_px=np.full((54, 2), 100.0), source="line.png"),
    ):
        views = (bad, *plain.views[1:])
        with pytest.raises(CalibrationError, match=r"line\.png: all corners seen lie on one line"):
            calibrate_views(views, BOARD, SIZES)
        caplog.clear()
        assert len(gather(replace(plain, views=views)).views) == len(plain.views) - 1
        assert caplog.messages == ["line.png: not in the report: its corners are too few, or all on one line"]


def test_wavy_board_is_noticed(plain):
    bent = POINTS.copy()
    bent[:, 2] = 0.003 * np.sin(12 * POINTS[:, 0])  # waves, which no parabola takes up
    flat = np.polyval(np.polyfit(POINTS[:, 0], bent[:, 2], 1), POINTS[:, 0])  # what a pose takes up
    views = synthetic_views(Truth(), POINTS, np.random.default_rng(2), boards=12, moved=2, shape=bent)
    calibration = calibrate_views(views, BOARD, SIZES, options=UNCHECKED)
    evidence = gather(calibration)
    assert evidence.shape.wrong
    assert evidence.shape.out == pytest.approx(np.std(bent[:, 2] - flat), rel=0.2)  # noise adds a tenth
    found = analyse(calibration)
    verdict, words = judge(calibration, found), advice(calibration, found)
    assert verdict.level == "care"
    assert "not counting that the board's corners are 1." in verdict.text
    assert any("mount the board on something flat and rigid" in item.lower() for item in words)
    # Nothing that more images of the same board, or another lens, would mend.
    assert not any("more placements" in each or "Without the part" in each for each in words)
    stretched = replace(evidence.shape, offsets=evidence.shape.offsets[:, [2, 1, 0]])
    words = advice(calibration, replace(found, evidence=replace(evidence, shape=stretched)))
    assert any("measure its squares both ways" in item for item in words)
    assert not gather(plain).shape.wrong


def test_board_too_bent_for_the_motions_is_suspected():
    bent = POINTS - [[0.0, 0.0, 0.125]] * POINTS[:, :1] * (POINTS[:, :1] - 0.8)  # 20 mm in its middle
    views = synthetic_views(Truth(), POINTS, np.random.default_rng(2), boards=12, moved=2, shape=bent)
    with pytest.raises(CalibrationError, match=r"the head reports a turn .* that the board is flat"):
        calibrate_views(views, BOARD, SIZES, options=UNCHECKED)


def test_patterns_in_residuals_and_empty_corners_are_noticed():
    rng = np.random.default_rng(0)
    at = rng.uniform([0, 0], [640, 480], (8000, 2))
    at = at[~((at[:, 0] > 400) & (at[:, 1] < 200))]
    noise = rng.normal(0, 0.1, at.shape)
    plain = Corners(SIZE, at, noise)
    bent = Corners(SIZE, at, noise + 0.1 * np.sin(at / 100))
    assert averaged(plain).beyond_chance.mean() < 0.05
    assert averaged(bent).beyond_chance.mean() > 0.3
    assert empty_places(plain) == ["upper right corner"]


def test_advice_follows_from_the_figures(plain):
    found = replace(analyse(plain), between=())
    at, words = found.at, advice(plain, found)
    group, left = next(iter(found.parts.items()))
    assert f"Without the part of {group} the error would be {digits(np.degrees(left))} instead" in words[0]
    assert any("36 more would halve it" in item for item in words)  # a quarter of the variance takes 4 * 12
    assert with_more_placements(plain, at[0], 36) == pytest.approx(at[0].rms / 2)
    still = replace(plain, views=tuple(replace(v, tilt=0.0) if v.camera == "zoom" else v for v in plain.views))
    assert any(
        "The head's tilt changed by 0 degrees" in item for item in advice(still, replace(found, evidence=gather(still)))
    )
    much = replace(at[0], rms=10 * at[0].rms)
    shaky = replace(plain, jitter=np.radians(0.05))
    words = advice(shaky, Analysis((much,), (), {JITTER_GROUP: at[0].rms}, None))
    words += advice(shaky, analyse(shaky))
    between = (replace(at[0], nominal_px=777.0, rms=4 * at[0].rms),)
    assert any(
        "777 px" in item and "Add a zoom sample" in item for item in advice(plain, replace(found, between=between))
    )
    assert any("play in the gears" in item for item in words)
    assert any("no number of them would halve it" in item for item in words)


@pytest.mark.slow
def test_more_placements_do_not_reduce_jitter_or_interpolation_error(plain, stops):
    (exact,) = pointing(plain)
    assert what_stays(plain, exact) == 0.0
    jitter = np.radians(0.05)
    shaky = replace(plain, jitter=jitter)
    (at,) = pointing(shaky)
    # Turns of pan count by the cosine of the tilt: a little less than both axes' together.
    assert 0.9 * np.sqrt(2) * jitter < what_stays(shaky, at) < np.sqrt(2) * jitter
    assert with_more_placements(shaky, at, 36) ** 2 == pytest.approx(at.rms**2 - 0.75 * exact.rms**2)
    (between,) = pointing(stops, [1.7 * NOMINAL_PX])
    doubt = np.linalg.norm(stops.zoom_head.lens.center_doubt_px(1.7 * NOMINAL_PX)) / between.focal_px
    assert doubt > 0
    assert what_stays(stops, between) == pytest.approx(doubt, rel=0.01)
    said = f"from {digits(np.degrees(at.rms))} to {digits(np.degrees(with_more_placements(shaky, at)))} degrees"
    assert any(said in item for item in advice(shaky, analyse(shaky)))
    summary = calibration_summary(shaky, Path("c.json"))
    assert summary["predicted_error_deg_with_10_more_placements"] == {
        "667 px": pytest.approx(np.degrees(with_more_placements(shaky, at)))
    }


def test_lens_curves_have_the_uncertainty_of_the_zoom_samples(stops):
    curves = lens_curves(stops)
    for where, i in ((0, 0), (-1, 1)):
        nominal = stops.zoom_head.lens.nominal_px[i]
        sigma = stops.covariance.sigma
        assert curves.values["ratio_x"][where] == pytest.approx(stops.zoom_head.lens.stops[i].focal_px[0] / nominal)
        assert curves.sigmas["ratio_x"][where] == pytest.approx(sigma(f"zoom[{i}].fx") / nominal, rel=1e-4)
        assert curves.sigmas["cy"][where] == pytest.approx(sigma(f"zoom[{i}].cy"), rel=1e-4)
        grown = (nominal / stops.zoom_head.lens.nominal_px[0]) ** 2
        assert curves.sigmas["kappa1"][where] == pytest.approx(sigma(f"zoom[{i}].k1") / grown, rel=1e-4)
    assert curves.sigmas["pupil_mm"][-1] == pytest.approx(1000 * stops.covariance.sigma("zoom[1].pupil"), rel=1e-4)


def test_report_command_keeps_the_old_page_unless_all_is_written(plain, tmp_path, capsys):
    source, page = tmp_path / "calibration.json", tmp_path / "page.html"
    bare(plain, covariance=None).save(source)
    page.write_text("old")
    (tmp_path / "page_pictures").write_text("a file")
    command = ["report", str(source), "--out", str(page)]
    assert cli.main(command) == 1
    assert "page_pictures" in capsys.readouterr().err
    assert page.read_text() == "old"
    (tmp_path / "page_pictures").unlink()
    assert cli.main(command) == 0
    assert judge(bare(plain, covariance=None)).text in capsys.readouterr().out
    assert page.read_text().startswith("<!DOCTYPE html>")
