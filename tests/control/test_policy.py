"""Learnt policies as files: what a file must be, and that one drives head and lens behind the same guard."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.config import SafetyConfig
from cotarget.control.policy import GAIN, OFF, RATE, TASK_FEATURES, ZOOM_UNIT, OnnxPolicy, moved_aim, proportional
from cotarget.env.common import DEFAULT_RIG
from cotarget.errors import ConfigError
from cotarget.evaluation import TruthDetector, closeup_of, true_calibration
from cotarget.pipeline import FollowSettings, Run
from cotarget.safety.safe_rig import guard
from cotarget.sim.targets.random_paths import lone_path
from cotarget.sim.truth import Outlines
from cotarget.sim.world import SimWorld

pytest.importorskip("onnxruntime", reason="runs policies")
onnx = pytest.importorskip("onnx", reason="writes policies")
COUNT = len(TASK_FEATURES)
ROUNDING = 1e-5  # of float32


def write(path, layers, mean=0.0, scale=1.0, action="rates"):
    from experiments.learning.onnx_policy import write_policy

    layers = [(np.float32(weights), np.float32(biases)) for weights, biases in layers]
    write_policy(path, layers, np.full(COUNT, mean), np.full(COUNT, scale), 10.0, action)
    return OnnxPolicy(path)


def proportional_layer():
    """The proportional controller as one layer."""
    weights = np.zeros((3, COUNT))
    for i in range(3):
        weights[i, OFF.start + i] = 1 / ZOOM_UNIT if i == 2 else GAIN
        weights[i, RATE.start + i] = 0.0 if i == 2 else 1.0
    return [(weights, np.zeros(3))]


def test_a_file_holds_the_normalisation_and_the_network(tmp_path):
    rng = np.random.default_rng(0)
    layers = [(rng.normal(size=(5, COUNT)), rng.normal(size=5)), (rng.normal(size=(3, 5)), rng.normal(size=3))]
    policy, features = write(tmp_path / "a.onnx", layers, 0.3, 2.0), rng.normal(size=(7, COUNT))
    features[:, 0] = 1.0  # known
    hidden = np.tanh(np.clip((features - 0.3) * 2.0, -10, 10) @ layers[0][0].T + layers[0][1])
    wanted = np.clip(hidden @ layers[1][0].T + layers[1][1], -1, 1)
    np.testing.assert_allclose(policy(features), wanted, atol=ROUNDING)
    np.testing.assert_allclose(policy(features[0]), wanted[0], atol=ROUNDING)  # one rig
    np.testing.assert_array_equal(policy.rates(features), policy(features))
    assert not policy(features * ([0.0] + [1.0] * (COUNT - 1))).any()  # without a track it waits
    residual = write(tmp_path / "b.onnx", layers, 0.3, 2.0, "residual")
    np.testing.assert_allclose(residual.rates(features), moved_aim(features, wanted), atol=ROUNDING)


def test_wrong_files_are_refused_in_one_line(tmp_path):
    (tmp_path / "text.onnx").write_text("no network")
    write(tmp_path / "good.onnx", proportional_layer())
    model = onnx.load(tmp_path / "good.onnx")
    onnx.helper.set_model_props(model, {"environment": "Pong"})
    onnx.save(model, tmp_path / "other.onnx")
    for name, said in (("none.onnx", "no such file"), ("text.onnx", "is no ONNX file"), ("other.onnx", "is no policy")):
        with pytest.raises(ConfigError, match=said) as caught:
            OnnxPolicy(tmp_path / name)
        assert "\n" not in str(caught.value)
    ends = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["n", COUNT]) for name in ("in", "out")]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["in"], ["out"])], "same", ends[:1], ends[1:])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.helper.set_model_props(model, {"environment": "cotarget/Follow-v1", "action": "rates"})
    onnx.save(model, tmp_path / "same.onnx")
    with pytest.raises(ConfigError, match="14 features into 3 numbers"):
        OnnxPolicy(tmp_path / "same.onnx")


def test_a_policy_follows_a_bird_within_the_soft_limits(tmp_path):
    """The proportional controller as a file, behind the guard, with limits that a part of the path is beyond."""
    policy = write(tmp_path / "policy.onnx", proportional_layer())
    features = np.random.default_rng(1).uniform(-1, 1, (9, COUNT)).astype(np.float32)
    features[:, 0] = 1.0  # known
    np.testing.assert_allclose(policy(features), proportional(features), atol=ROUNDING)
    good, pans = [], []
    for limit_deg in (90.0, 5.0):
        sim = replace(DEFAULT_RIG.sim, seed=4, targets=("bird",), paths=lone_path("bird", 4))
        world = SimWorld(replace(DEFAULT_RIG, sim=sim), rendered=())
        rig = guard(world.rig, SafetyConfig(pan_deg=(-limit_deg, limit_deg)))
        outlines, target = Outlines(world.truth()), DEFAULT_RIG.target("bird")
        settings = FollowSettings(closed_loop=False, policy=policy)
        run = Run(rig, true_calibration(world), target, TruthDetector(outlines, 4), settings=settings)
        steps = list(run.follow(4.0))
        good.append(np.mean([closeup_of(outlines, "bird", target, step.zoom.t).good for step in steps[50:]]))
        pans.append(max(abs(math.degrees(step.head.pan)) for step in steps))
        rig.close()
    assert good[0] > 0.6
    assert pans[0] > 6.0
    assert 1.0 < pans[1] <= 5.0
