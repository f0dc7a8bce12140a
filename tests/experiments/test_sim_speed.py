"""The simulation's speed experiment: what its figures are made of."""

from types import SimpleNamespace

import pytest

from benchmarks import sim_speed


def test_the_real_time_factor_is_of_what_came_after_the_target_had_settled(monkeypatch):
    """Steps at 0.0, 0.5, ... 3.0 s that take 2 s of real time each, the first 10 s."""
    real = [0.0]
    monkeypatch.setattr(sim_speed.time, "perf_counter", lambda: real[0])

    def steps():
        for i in range(7):
            real[0] += 2.0 if i else 10.0
            yield SimpleNamespace(t=0.5 * i), None

    assert sim_speed.real_time_factor(steps()) == pytest.approx(2.0 / 8.0)
