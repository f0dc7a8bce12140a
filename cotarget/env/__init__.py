"""Gymnasium environments on the simulated rig; to import this registers them.

`cotarget/Follow-v0`: a target is to be held in the close-up, by commands to head and lens. `cotarget/Schedule-v0`: of
several targets one is to be chosen in every frame. `gymnasium.make("cotarget/Follow-v0", target="person")` after an
import, or `gymnasium.make("cotarget.env:cotarget/Follow-v0")` without. What they take, show and reward is told by their
classes; what is really so they tell in `info` alone.
"""

import gymnasium

from cotarget.env.follow import Follow
from cotarget.env.policies import PipelinePolicy, SchedulingPolicy
from cotarget.env.schedule import Schedule

__all__ = ["FOLLOW", "SCHEDULE", "Follow", "PipelinePolicy", "Schedule", "SchedulingPolicy"]

FOLLOW, SCHEDULE = "cotarget/Follow-v0", "cotarget/Schedule-v0"

gymnasium.register(FOLLOW, entry_point="cotarget.env.follow:Follow")
gymnasium.register(SCHEDULE, entry_point="cotarget.env.schedule:Schedule")
