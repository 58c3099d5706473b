"""What the learner knows of the arm: its sizes, the length of an episode, and that the motor never ends one.

It has no environment (env_id None): only the robot's own program can move the arm. The reward is learned. What the
numbers mean stands in the policy's file: its actions, in [-1, 1], stand for -4 to 4 N m (`policy.to_env`).
"""

import metrpo

shows = metrpo.Interface(
    observation=((2, "cosine and sine of the angle from upright"), (1, "speed (5 rad/s)")),
    action_low=(-4.0,),  # N m
    action_high=(4.0,),
)
task = metrpo.Task("arm", env_id=None, state_size=3, action_size=1, horizon=60, reward=None, interface=shows)
