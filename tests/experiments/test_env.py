"""The environments' experiments: what their figures are made of."""

import math

import pytest

from benchmarks import env_speed
from experiments.following import env_score


def timed(what, target, env_us, alone_us, reset_ms=50.0):
    return {"what": what, "target": target, "env_us": env_us, "alone_us": alone_us, "reset_ms": reset_ms}


def test_speeds_are_medians_and_ratios_those_of_neighbours():
    rows = [timed("tracks", "book", *pair) for pair in ((200.0, 100.0), (400.0, 300.0), (300.0, 120.0))]
    rows += [timed("images", "book", 5000.0, 4500.0), timed("tracks", "bird", 250.0, 100.0, 70.0)]
    summary = env_speed.summarise(rows)
    assert summary["tracks, book"] == pytest.approx(
        {"steps_per_s": 1e6 / 300, "alone_per_s": 1e6 / 120, "ratio": 0.5, "reset_ms": 50.0}
    )
    assert summary["images, book"]["ratio"] == pytest.approx(0.9)
    assert env_speed.missed(summary) == ["tracks, bird"]


def earned(env, of, policy, reward, served=math.nan):
    return {"env": env, "of": of, "policy": policy, "reward": reward, "steps": 100, "served": served}


def test_scores_are_rewards_a_step_and_means():
    rows = [earned(env_score.FOLLOW, "book", "pipeline", 80.0), earned(env_score.FOLLOW, "book", "pipeline", 90.0)]
    rows += [earned(env_score.FOLLOW, "book", "chance", 1.0)]
    rows += [
        earned(env_score.SCHEDULE, "bird", "most-served", 20.0, 3),
        earned(env_score.SCHEDULE, "bird", "chance", 25.0, 4),
    ]
    rows += [earned(env_score.SCHEDULE, "bird", "first-come", 5.0, 1)]
    summary = env_score.summarise(rows)
    follow, schedule = f"{env_score.FOLLOW} book", f"{env_score.SCHEDULE} bird"
    assert summary[follow]["pipeline"] == pytest.approx({"mean": 0.85, "error": 0.05})
    means = env_score.bounded(summary)
    assert means[follow] == {"pipeline": pytest.approx(0.85), "chance": pytest.approx(0.01)}
    assert means[schedule] == {"most-served": 20.0, "chance": 25.0, "first-come": 5.0}
    assert means[f"{schedule}, served"] == {"most-served": 3.0, "chance": 4.0, "first-come": 1.0}
    assert env_score.missed(summary) == [schedule, f"{schedule}, served"]
