"""Selection of one of several targets by options, or by a recording."""

import argparse
from types import SimpleNamespace

import numpy as np
import pytest

from cotarget.cli.pipeline_run import Selection, add_selection
from cotarget.control.selection import Candidate
from cotarget.tracking.track import Track
from tests.support.rigs import alike

SIZE = (640, 480)
LIMITS = alike((-2.8, 2.8), (-0.8, 0.5), 2.6, 3.6, 0.0)


def chosen(*arguments, recorded=None):
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_selection(parser)
    return Selection(parser.parse_args(arguments), SIZE, recorded)


def track(number, center=(1, 1), confirmed=True):
    center, size = np.array(center, float), np.array([20.0, 30.0])
    return Track(number, 0.0, confirmed, 0, center, np.zeros(2), size, 30.0, np.eye(4), 1.0, None)


@pytest.mark.parametrize(("arguments", "recorded", "number"), [
    ((), None, 2), (("--policy", "first-come"), None, 2), (("--policy", "nearest-deadline"), None, 5),
    (("--policy", "most-served"), None, 2), (("--click", "325", "210"), None, 3),
    (("--click", "325", "400"), None, None), (("--track", "5"), None, 5), (("--track", "4"), None, None),
    ((), {"track": 5}, 5), ((), {"click": [325, 210.0]}, 3), ((), {"policy": "nearest-deadline"}, 5),
    (("--track", "3"), {"track": 5}, 3),
])  # fmt: skip
def test_options_or_recording_select_the_target(arguments, recorded, number):
    """Of three targets: one at the left stays, one in the middle leaves in 9 s, and one at the right in 5 s."""
    places = {2: (100, 200), 3: (320, 200), 5: (600, 200)}
    seen_s = (0.0, 2.0, 2.0) if "most-served" in arguments else (0.0, 0.0, 0.0)
    candidates = [
        Candidate(track(number, at), lambda _, at=at: np.array([(at[0] - 320) / 686, 0.0]), leaves, seen)
        for (number, at), leaves, seen in zip(places.items(), (np.inf, 9.0, 5.0), seen_s, strict=True)
    ]
    selector = chosen(*arguments, recorded=recorded).selector
    selector.start(SIZE)
    assert selector.select(candidates, np.zeros(2), LIMITS) == number


@pytest.mark.parametrize(("arguments", "recorded", "named"), [
    (("--track", "4"), None, "--track"), (("--click", "3", "4"), None, "--click"),
    ((), {"track": 4}, "the recorded track"), ((), {"click": [3.0, 4.0]}, "the recorded click"), ((), None, None),
])  # fmt: skip
def test_unmatched_selection_is_reported_with_the_tracks_seen(arguments, recorded, named):
    selection = chosen(*arguments, recorded=recorded)
    assert selection.warning == ""  # nothing was there at all
    selection.see(SimpleNamespace(target=None, tracks=[track(2), track(3, confirmed=False)]))
    if named is not None:
        assert selection.warning.startswith(f"{named}: ")
        assert selection.warning.endswith(": 2")
        selection.see(SimpleNamespace(target=track(4), tracks=[]))
    assert selection.warning == ""
