"""The simulation's speed experiment: what its figures are made of, and, slowly, the figures themselves."""

import math
from types import SimpleNamespace

import pytest

from benchmarks import sim_speed
from cotarget.pipeline import State
from cotarget.safety.safe_rig import guard
from experiments.following import field
from experiments.following.field_scenes import hold_config

# A step against mujoco.Renderer is 1.15 on a quiet machine; a busy one adds what it likes.
BUSY = 1.5


def rows():
    """Hand-made: the loop takes 1.1 times the renderer's time, blur adds 8 ms to 40, every other effect adds 1."""
    found = []
    for renderer in (30.0, 40.0, 50.0):
        found.append({"what": sim_speed.RENDERER, "ms": renderer})
        found.append({"what": sim_speed.LOOP, "ms": 1.1 * renderer})
        for name in (*sim_speed.IMAGE_EFFECTS, sim_speed.ALL):
            found.append({"what": name, "ms": 40.0 + (8.0 if name == "blur" else 1.0), "without_ms": 40.0})
    found += [{"what": "rendered", "factor": 0.5}, {"what": "unrendered", "factor": 20.0}]
    return [*found, {"what": "simulation alone", "ms": 0.4}]


def test_figures_are_medians_of_the_rows():
    summary = sim_speed.summarise(rows())
    assert summary["loop_over_renderer"] == pytest.approx(1.1)
    assert summary["renderer_ms"] == 40.0
    assert summary["effects"]["blur"] == {"ms": 48.0, "without_ms": 40.0, "more_ms": 8.0}
    assert summary["effects"]["noise"]["more_ms"] == 1.0
    assert (summary["real_time_rendered"], summary["real_time_unrendered"]) == (0.5, 20.0)
    assert "ratio 1.10" in sim_speed.describe(sim_speed.SETTINGS, summary)


def test_what_is_too_slow_is_missed():
    assert sim_speed.missed(sim_speed.summarise(rows())) == []
    slow = [{**row, "factor": 0.9 * row["factor"]} if "factor" in row else row for row in rows()]
    slow = [{**row, "ms": 1.1 * row["ms"]} if row["what"] == sim_speed.LOOP else row for row in slow]
    assert sim_speed.missed(sim_speed.summarise(slow)) == list(sim_speed.WANTED)
    assert sim_speed.EXPERIMENT.missed is sim_speed.missed


def test_the_real_time_factor_is_of_what_came_after_the_target_had_settled(monkeypatch):
    """Steps at 0.0, 0.5, ... 3.0 s that take 2 s of real time each, the first 10 s."""
    real = [0.0]
    monkeypatch.setattr(sim_speed.time, "perf_counter", lambda: real[0])

    def steps():
        for i in range(7):
            real[0] += 2.0 if i else 10.0
            yield SimpleNamespace(t=0.5 * i), None

    assert sim_speed.real_time_factor(steps()) == pytest.approx(2.0 / 8.0)


def test_what_is_timed_is_how_a_bird_is_held(monkeypatch):
    """The field's own detector, and the safety layer between the pipeline and the rig."""
    calibration, asked = field.calibrated(field.FieldSettings(calibrated=False)), []
    monkeypatch.setattr(sim_speed, "watched", lambda *arguments: asked.append(arguments))
    sim_speed.held(calibration, 2.0, 3)
    config = hold_config("bird", 3)
    assert asked == [(calibration, config, field.target_of(config, "bird"), sim_speed.SETTLED_S + 2.0)]
    guarded = []
    monkeypatch.setattr(field, "guard", lambda rig, safety: guarded.append(safety) or guard(rig, safety))
    steps = [step for step, _ in sim_speed.held_unrendered(calibration, 1.0, 3)]
    assert steps[-1].t == pytest.approx(2.0, abs=0.2)
    assert State.FOLLOWING in {step.state for step in steps}
    assert guarded == [config.safety]


def test_only_the_effects_asked_for_are_on():
    effects = sim_speed.config_with(0, ("blur", "jpeg")).sim.effects
    assert (effects.blur, effects.jpeg) == (True, True)
    assert (effects.noise, effects.distortion, effects.clutter) == (False, False, False)
    assert effects.latency  # no image effect
    assert effects.multisampling


@pytest.mark.slow
@pytest.mark.render
def test_a_quick_run():
    summary = sim_speed.summarise(sim_speed.EXPERIMENT.run(sim_speed.EXPERIMENT.quick))
    assert summary["loop_over_renderer"] < BUSY
    assert all(math.isfinite(v["more_ms"]) for v in summary["effects"].values())
    assert summary["real_time_rendered"] > 0
    assert summary["simulation_alone_ms"] < 3.0
