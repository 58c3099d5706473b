"""A stored policy's episodes are played side by side where they can be; a function's never are."""

from __future__ import annotations

import numpy as np
import pytest

import metrpo
from metrpo.world import batch_episodes


@pytest.mark.parametrize("task", ["Swimmer", "Ant"])
def test_a_stored_policy_earns_what_it_earns_one_episode_after_another(task, monkeypatch):
    played = []
    play = batch_episodes.play
    monkeypatch.setattr(batch_episodes, "play", lambda *a, **kw: played.append(a[0].name) or play(*a, **kw))
    stored = metrpo.evaluate(f"zoo:{task}", episodes=3, seed=4).returns
    assert played == [task]
    policy = metrpo.load_policy(f"zoo:{task}")
    as_function = metrpo.evaluate(lambda state: policy(state), task, episodes=3, seed=4).returns
    assert played == [task]
    np.testing.assert_allclose(stored, as_function, rtol=1e-3)
    assert len(set(stored)) == 3
