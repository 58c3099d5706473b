"""The annotations of the learned side are checked while the tests run (tests/conftest.py)."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from metrpo.policy.advantage import gae

ONES = np.ones((3, 2), np.float32)


@pytest.mark.parametrize(
    ("given", "parameter"),
    [((ONES, ONES.T, ONES), "values"), ((ONES, ONES, ONES > 0), "mask"), ((ONES[0], ONES, ONES), "rewards")],
    ids=["steps and episodes exchanged", "bool for float", "one dimension too few"],
)
def test_a_wrong_shape_or_kind_is_refused(given, parameter):
    with pytest.raises(TypeCheckError, match=f"typechecking parameter '{parameter}'"):
        gae(*given, 0.9, 0.9)
