"""A figure that is off its goal is missed, and no other: on the figures of v0.1.0's rows, with one of them changed."""

import math
from copy import deepcopy

import pytest

from experiments.following import dead_zone, hold
from experiments.report import draw
from experiments.tables import plain
from tests.formats.test_experiments import OLD_RESULTS, experiment_of, old_jobs

OURS = "this project"


def figures_of(name):
    return experiment_of(name).summarise([row for job in old_jobs(name) for row in job["rows"]])


@pytest.mark.parametrize(("name", "path", "value", "said"), [
    ("hold", "book/closeup_yield/median", 0.87, "book: closeup_yield"),
    ("first_shot", "book/corrected_width", math.nan, "book: corrected_width"),
    ("delay", "bird/wide view alone/200 ms/times", 2.9, "bird"), ("delay", "bird/closed loop/times", 2.9, "bird"),
    ("five_targets", "person/best over first", 1.4, "person"),
    ("dead_zone", "person/commands_per_min/over", 0.51, "person: commands_per_min"),
    ("env_speed", "images, bird/ratio", 0.79, "images, bird"),
    ("env_score", "cotarget/Schedule-v0 person/chance/mean", 99.0, "cotarget/Schedule-v0 person"),
    ("sim_speed", "loop_over_renderer", 1.16, "loop_over_renderer"),
    ("fig4_book", f"{OURS}/close up/decoded", 0.89, "close up: decoded"),
    ("fig5_person", f"{OURS}/in_frame_ratio/median", 0.98, "in_frame_ratio"),
    ("fig6_outdoors", f"{OURS}/tpo_percent/median", 4.1, "tpo_percent"),
    ("table2_table3", "zoom/fx/bias", -3.1, "zoom: fx: bias"),
    ("calibration_budget", "exponent_noise", 0.7, "exponent_noise"),
    ("depth_error", "pixels/over_first_order/median", 1.13, "pixels"),
    ("models", "seen/regime/offset ignored/to", math.nan, "seen: full model 5 times better than offset ignored"),
    ("pointing", "default/full model/p95_deg/median", 0.0061, "default: p95_deg"),
    ("zoom_range", "steps/ratio", 1.11, "steps: ratio"),
    ("shortcut", "mounted/exact/whole view/all/worst_deg", 2e-6, "exact range"),
    ("single_ptz", "person/lone, misses 5 %/in_frame_ratio", 0.84, "person, lone, misses 5 %"),
    ("sweep_speed", "fitted/rows_that_differ", 1, "fitted"),
])  # fmt: skip
def test_a_figure_off_its_goal_is_missed(name, path, value, said):
    missed, right = experiment_of(name).missed, figures_of(name)
    wrong = node = deepcopy(right)
    *trail, last = path.replace("cotarget/", "cotarget|").split("/")
    for key in trail:
        node = node[key.replace("|", "/")]
    node[last] = value
    more = [text for text in missed(wrong) if text not in missed(right)]
    assert [text.startswith(said) for text in more] == [True]


DRAWN = [name for name in OLD_RESULTS if experiment_of(name).plot and name != "shortcut"]  # of which rows are left out


@pytest.mark.parametrize("name", DRAWN)
def test_a_plot_is_drawn_from_rows(name):
    assert draw(experiment_of(name), [row for job in old_jobs(name) for row in job["rows"]]).startswith(b"\x89PNG")


def test_the_papers_way_has_no_goals():
    for name in ("fig4_book", "fig5_person", "fig6_outdoors"):
        rows = [row for job in old_jobs(name) for row in job["rows"]]
        bad = [{key: 99.0 if isinstance(v, float) else v for key, v in row.items()} for row in rows]
        summary = experiment_of(name).summarise([*rows, *(row | {"way": "as the paper"} for row in bad)])
        assert experiment_of(name).missed(summary) == experiment_of(name).missed(figures_of(name))


def test_a_run_without_a_figure_counts_as_the_worst():
    """A target that is never acquired has the least shares and the largest times and offsets, or no ratio."""
    (row, *_) = [row for job in old_jobs("hold") for row in job["rows"] if row["target"] == "book"]
    never = dict.fromkeys(row) | {"target": "book", "closeup_yield": 0.0}
    most = hold.summarise([row, never, never])["book"]
    assert (most["identification"]["median"], most["time_to_acquire_s"]["median"]) == (0.0, math.inf)
    assert math.isnan(most["identification"]["largest"])
    few = hold.summarise([row, row, never])["book"]
    assert few["identification"]["median"] == row["identification"]
    assert math.isnan(few["time_to_acquire_s"]["largest"])
    run = {"target": "book", "commands_per_min": 9.0, "reversals_per_min": 0.0}
    rows = [run | {"way": "with", "tpo_width_median": None}, run | {"way": "without", "tpo_width_median": 0.02}]
    found = {key: each["over"] for key, each in dead_zone.summarise(rows)["book"].items()}
    assert found["reversals_per_min"] == 1.0  # nothing over nothing
    assert plain(found["tpo_width_median"]) is None
