"""The batch as Stable-Baselines3 wants it: resets in the same step, last observations and truncation in the infos."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra `learn` is not installed")


def test_the_batch_is_a_vector_environment_of_stable_baselines3(tmp_path):
    from cotarget.env.batch import FollowBatch
    from experiments.learning.vec_env import BatchVecEnv

    arguments = {"target": "bird", "seconds": 0.4, "paths": 4}
    batch, env = FollowBatch(3, **arguments), BatchVecEnv(FollowBatch(3, **arguments))
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), batch.reset(seed=5)[0])
    rng, known = np.random.default_rng(0), np.zeros((3, 1))
    for k in range(1, 25):
        actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        observation, rewards, _, truncated, infos = batch.step(actions * known)  # it waits for a track
        known = observation[:, :1]
        found, earned, over, told = env.step(actions)
        np.testing.assert_array_equal(found, observation)
        np.testing.assert_allclose(earned, rewards, rtol=1e-6)
        assert over.tolist() == truncated.tolist() == [k % 10 == 0] * 3
        for i, info in enumerate(told):
            assert info.get("TimeLimit.truncated", False) == (k % 10 == 0)
            if over[i]:
                np.testing.assert_array_equal(info["terminal_observation"], infos["final_obs"][i])
                assert info["terminal_observation"][0] == 1.0
                assert not found[i].any()  # the first observation of the next episode
    env.close()


def test_ppo_learns_from_the_batch_and_its_file_acts_as_its_network(tmp_path):
    """Values bootstrap at truncation, the loop runs, and the exported mean is the network's with its normalisation."""
    torch = pytest.importorskip("torch", reason="the extra `learn` is not installed")
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from cotarget.control.policy import OnnxPolicy
    from cotarget.env.batch import FollowBatch
    from experiments.learning.train import CLIP, export
    from experiments.learning.vec_env import BatchVecEnv

    torch.set_num_threads(1)
    env = VecNormalize(BatchVecEnv(FollowBatch(8, "bird", seconds=1.0, paths=4)), norm_reward=False, clip_obs=CLIP)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(512)
    export(model, env, tmp_path / "policy.onnx", "rates")
    features = env.get_original_obs()
    features[:, 0] = 1.0  # known
    wanted, _ = model.predict(env.normalize_obs(features), deterministic=True)
    np.testing.assert_allclose(OnnxPolicy(tmp_path / "policy.onnx")(features), wanted, atol=1e-5)
    env.close()
