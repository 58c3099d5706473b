"""The library in a few lines: train, load, act, judge; and the loop in one's own hands.

python examples/library.py            # a few minutes
"""

import numpy as np

import metrpo

config = metrpo.preset("Swimmer", "fast", seed=0, iterations=3)
metrpo.train(config, "runs/example")  # resumes what it finds there

policy = metrpo.load_policy("runs/example")  # NumPy in, NumPy out
print(policy(np.zeros(10)), policy(np.zeros((5, 10))).shape)
print(metrpo.evaluate("runs/example", episodes=20).mean)

state = metrpo.init(config)  # or drive the loop yourself
state, row = metrpo.step(config, state)
print(row["real_steps"], row["return_real"], row["gap"])
