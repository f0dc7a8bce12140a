"""Provide Gymnasium environments on the simulated rig; importing this module registers them.

`cotarget/Follow-v0` holds a target in the close-up by commands to head and lens. `cotarget/Schedule-v0` chooses one of
several targets in every frame. Make one by `gymnasium.make("cotarget/Follow-v0", target="person")` after an import, or
by `gymnasium.make("cotarget.env:cotarget/Follow-v0")` without one. The classes describe actions, observations and
rewards. Only `info` holds ground truth.
"""

import gymnasium

from cotarget.env.follow import Follow
from cotarget.env.policies import PipelinePolicy, SchedulingPolicy
from cotarget.env.schedule import Schedule

__all__ = ["FOLLOW", "SCHEDULE", "Follow", "PipelinePolicy", "Schedule", "SchedulingPolicy"]

FOLLOW, SCHEDULE = "cotarget/Follow-v0", "cotarget/Schedule-v0"

gymnasium.register(FOLLOW, entry_point="cotarget.env.follow:Follow")
gymnasium.register(SCHEDULE, entry_point="cotarget.env.schedule:Schedule")
