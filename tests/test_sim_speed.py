"""The simulation's speed experiment: what its figures are made of, and, slowly, the figures themselves."""

import math

import pytest

from experiments import sim_speed

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
