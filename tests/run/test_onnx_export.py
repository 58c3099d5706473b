"""An exported ONNX graph is valid and says what it is."""

import json
import sys

import numpy as np
import pytest

from exported import HOSTILE, A, S, onnx, saved
from metrpo.errors import MetrpoError
from metrpo.run.policy_export import export
from metrpo.world.interface import Interface


def test_onnx_says_the_layout_and_the_range_too(tmp_path):
    onnx_package = pytest.importorskip("onnx")
    saved(tmp_path, interface=Interface(((1, "height"), (S - 1, "the rest")), (-2.0,) * A, (3.0,) * A))
    model = onnx_package.load(str(export(tmp_path, tmp_path / "p.onnx")))
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert json.loads(said["observation"]) == [[1, "height"], [S - 1, "the rest"]]
    assert (json.loads(said["action_low"]), json.loads(said["action_high"])) == ([-2.0] * A, [3.0] * A)


def test_onnx_is_valid_and_describes_itself(tmp_path):
    package = pytest.importorskip("onnx")
    saved(tmp_path, (32, 32))
    model = package.load(export(tmp_path, tmp_path / "policy.onnx"))
    package.checker.check_model(model, full_check=True)
    ends = [(*model.graph.input, "observation", S), (*model.graph.output, "action", A)]
    for end, name, size in ends:
        batch, numbers = end.type.tensor_type.shape.dim
        assert (end.name, batch.dim_param, numbers.dim_value) == (name, "batch", size)
        assert end.type.tensor_type.elem_type == package.TensorProto.FLOAT
        assert end.doc_string
    beside = json.loads((tmp_path / "policy.json").read_text())
    facts = {entry.key: entry.value for entry in model.metadata_props}
    expected = {"task": "Swimmer", "observation_size": "11", "action_size": "3", "hidden": "[32, 32]"}
    assert expected.items() | {("metrpo", beside["metrpo"]), ("policy_sha256", beside["sha256"])} <= facts.items()
    assert (model.producer_name, model.producer_version) == ("metrpo", beside["metrpo"])
    assert "Swimmer" in model.doc_string
    assert model.opset_import[0].version == 13


@pytest.mark.parametrize("name", HOSTILE)
def test_onnx_holds_any_name(name, tmp_path):
    package = pytest.importorskip("onnx")
    saved(tmp_path, task=name)
    path = export(tmp_path, tmp_path / "policy.onnx")
    package.checker.check_model(package.load(path))
    onnx(path)(np.zeros((1, S)))


def test_onnx_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    saved(tmp_path)
    with pytest.raises(MetrpoError, match=r"no package onnx: pip install 'metrpo\[export\]'"):
        export(tmp_path, tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()
