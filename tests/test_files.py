import json
import os
from pathlib import Path

import pytest
import torch

from common import files, weights
from common.files import UserError


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.json"
    files.save_json(path, {"a": torch.tensor([1.0]), "b": Path("x")})

    def breaks(temporary):
        assert temporary.parent == tmp_path and temporary.suffix == ".json"
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        files.write_atomic(path, breaks)
    assert json.loads(path.read_text()) == {"a": [1.0], "b": "x"}
    assert os.listdir(tmp_path) == ["a.json"]


def test_tensors_and_their_meta_come_back(tmp_path):
    net, path = torch.nn.Linear(2, 3), tmp_path / "net.safetensors"
    weights.save_tensors(path, net.state_dict(), method="ours", widths=[1, 2])
    tensors, meta = weights.load_tensors(path)
    assert meta == {"method": "ours", "widths": [1, 2]}
    assert torch.equal(tensors["weight"], net.weight)
    weights.save_tensors(path, {"turned": torch.arange(6).view(2, 3).T})
    assert weights.load_tensors(path)[0]["turned"].tolist() == [[0, 3], [1, 4], [2, 5]]


@pytest.mark.parametrize("cut", [0, 5, 100])
def test_damaged_tensors_name_the_file(tmp_path, cut):
    path = tmp_path / "03_train_estimator" / "net.safetensors"
    weights.save_tensors(path, {"w": torch.zeros(100)})
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(UserError, match="03_train_estimator/net.safetensors is missing or damaged"):
        weights.load_tensors(path)
