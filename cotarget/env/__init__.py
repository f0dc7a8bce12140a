"""Provide Gymnasium environments on the simulated rig; importing this module registers them.

`cotarget/Follow-v1` and `cotarget/Follow-v0` hold a target in the close-up by commands to head and lens, version 1 with
actions, features and rewards for learning. `cotarget/Schedule-v0` chooses one of several targets in every frame. Make
one by `gymnasium.make("cotarget/Follow-v0", target="person")` after an import, or
by `gymnasium.make("cotarget.env:cotarget/Follow-v0")` without one. The classes describe actions, observations and
rewards. Only `info` holds ground truth.
"""

import gymnasium

from cotarget.control.policy import ENVIRONMENT
from cotarget.env.follow import Follow
from cotarget.env.follow_v1 import FollowV1
from cotarget.env.policies import PipelinePolicy, SchedulingPolicy
from cotarget.env.schedule import Schedule
from cotarget.env.variation import Randomization

__all__ = [
    "FOLLOW",
    "FOLLOW_V1",
    "SCHEDULE",
    "Follow",
    "FollowV1",
    "PipelinePolicy",
    "Randomization",
    "Schedule",
    "SchedulingPolicy",
]

FOLLOW, FOLLOW_V1, SCHEDULE = "cotarget/Follow-v0", ENVIRONMENT, "cotarget/Schedule-v0"

gymnasium.register(FOLLOW, entry_point="cotarget.env.follow:Follow")
gymnasium.register(SCHEDULE, entry_point="cotarget.env.schedule:Schedule")
gymnasium.register(
    FOLLOW_V1, entry_point="cotarget.env.follow_v1:FollowV1", vector_entry_point="cotarget.env.batch:FollowBatch"
)
