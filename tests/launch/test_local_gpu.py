"""Runs that share one GPU: each takes its part of the memory, unless the user has said how much."""

import os

import pytest

from metrpo.launch import local
from metrpo.launch.backend import Means
from metrpo.run import machine

NAME = "XLA_PYTHON_CLIENT_MEM_FRACTION"


@pytest.mark.parametrize(
    ("there", "platforms", "user", "jobs", "share"),
    [
        (True, "", None, 3, "0.300"),
        (True, "cuda,cpu", None, 2, "0.450"),
        (True, "", None, 1, None),
        (True, "cpu", None, 3, None),
        (False, "", None, 3, None),
        (True, "", "0.2", 3, "0.2"),
    ],
)
def test_each_run_gets_its_part_of_the_gpu(monkeypatch, tmp_path, there, platforms, user, jobs, share):
    monkeypatch.setattr(machine, "may_have_gpu", lambda: there)
    monkeypatch.setenv("JAX_PLATFORMS", platforms)
    monkeypatch.setenv(NAME, user or "")
    if user is None:
        monkeypatch.delenv(NAME)
    local.run_locally([], tmp_path, Means(jobs=jobs), lambda text: None)
    assert os.environ.get(NAME) == share
