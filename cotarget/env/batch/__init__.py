"""Many environments `cotarget/Follow-v1` in one process: the same dynamics in arrays over all of them.

`gymnasium.make_vec("cotarget/Follow-v1", num_envs=256, vectorization_mode="vector_entry_point")` makes one. Head, lens,
delays, target, detection noise and misses, aims, features and rewards are those of the single environment. Simpler are
the track, see `cotarget.env.batch.tracks`, and the target's outline in the close-up, see
`cotarget.env.batch.appearance`.
"""

from cotarget.env.batch.follow import FollowBatch

__all__ = ["FollowBatch"]
