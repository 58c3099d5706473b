"""What the learner knows of the arm: its sizes, the length of an episode, and that the motor never ends one.

It has no environment (env_id None): only the robot's own program can move the arm. The reward is learned.
"""

import metrpo

task = metrpo.Task("arm", env_id=None, state_size=3, action_size=1, horizon=60, reward=None)
