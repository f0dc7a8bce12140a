"""Provide Gymnasium environments on the simulated rig; importing this module registers them.

`cotarget/Follow-v1` and `cotarget/Follow-v0` hold a target in the close-up by commands to head and lens.
`cotarget/Schedule-v1` and `cotarget/Schedule-v0` choose one of several targets in every frame. Version 1 has rewards
and features for learning. Make one by `gymnasium.make("cotarget/Follow-v0", target="person")` after an import, or by
`gymnasium.make("cotarget.env:cotarget/Follow-v0")` without one. The classes describe actions, observations and rewards.
Only `info` holds ground truth.
"""

import gymnasium

from cotarget.control.policy import ENVIRONMENT
from cotarget.env.follow import Follow
from cotarget.env.follow_v1 import FollowV1
from cotarget.env.policies import PipelinePolicy, SchedulingPolicy
from cotarget.env.schedule import Schedule
from cotarget.env.schedule_v1 import ScheduleV1
from cotarget.env.variation import Randomization

__all__ = [
    "FOLLOW",
    "FOLLOW_V1",
    "SCHEDULE",
    "SCHEDULE_V1",
    "Follow",
    "FollowV1",
    "PipelinePolicy",
    "Randomization",
    "Schedule",
    "ScheduleV1",
    "SchedulingPolicy",
]

FOLLOW, FOLLOW_V1 = "cotarget/Follow-v0", ENVIRONMENT
SCHEDULE, SCHEDULE_V1 = "cotarget/Schedule-v0", "cotarget/Schedule-v1"

gymnasium.register(FOLLOW, entry_point="cotarget.env.follow:Follow")
gymnasium.register(SCHEDULE, entry_point="cotarget.env.schedule:Schedule")
gymnasium.register(
    FOLLOW_V1, entry_point="cotarget.env.follow_v1:FollowV1", vector_entry_point="cotarget.env.batch:FollowBatch"
)
gymnasium.register(SCHEDULE_V1, entry_point="cotarget.env.schedule_v1:ScheduleV1")
