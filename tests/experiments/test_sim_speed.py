"""The simulation's speed experiment: what its figures are made of."""

from types import SimpleNamespace

import pytest

from benchmarks import sim_speed


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


def test_what_is_too_slow_is_missed():
    assert sim_speed.missed(sim_speed.summarise(rows())) == []
    slow = [{**row, "factor": 0.9 * row["factor"]} if "factor" in row else row for row in rows()]
    slow = [{**row, "ms": 1.1 * row["ms"]} if row["what"] == sim_speed.LOOP else row for row in slow]
    assert [text.partition(":")[0] for text in sim_speed.missed(sim_speed.summarise(slow))] == list(sim_speed.WANTED)


def test_the_real_time_factor_is_of_what_came_after_the_target_had_settled(monkeypatch):
    """Steps at 0.0, 0.5, ... 3.0 s that take 2 s of real time each, the first 10 s."""
    real = [0.0]
    monkeypatch.setattr(sim_speed.time, "perf_counter", lambda: real[0])

    def steps():
        for i in range(7):
            real[0] += 2.0 if i else 10.0
            yield SimpleNamespace(t=0.5 * i), None

    assert sim_speed.real_time_factor(steps()) == pytest.approx(2.0 / 8.0)


def test_only_the_effects_asked_for_are_on():
    effects = sim_speed.config_with(0, ("blur", "jpeg")).sim.effects
    assert (effects.blur, effects.jpeg) == (True, True)
    assert (effects.noise, effects.distortion, effects.clutter) == (False, False, False)
    assert effects.latency  # no image effect
    assert effects.multisampling
