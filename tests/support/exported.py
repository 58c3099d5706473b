"""Exported policies as a program would use them."""

import importlib
import sys

from metrpo.run.policy_file import load_policy


def module_of(path):
    """An exported .py, imported by its name from its folder."""
    sys.path.insert(0, str(path.parent))
    try:
        return importlib.import_module(path.stem)
    finally:
        sys.path.remove(str(path.parent))
        del sys.modules[path.stem]


def act_and_reset(path):
    """How a .npz or a .py acts, and begins an episode."""
    if path.suffix == ".npz":
        policy = load_policy(path)
        return policy, policy.reset
    module = module_of(path)
    return module.act, module.reset
