from types import SimpleNamespace

import numpy as np
import pytest
import torch

from common import supervised


def test_a_step_counts_the_same_in_every_minibatch(monkeypatch, tmp_path):
    lengths = np.random.default_rng(0).integers(1, 50, 64)
    data = np.random.default_rng(1).standard_normal((lengths.sum(), 7)), np.concatenate([[0], lengths.cumsum()])
    net, slopes = torch.nn.Linear(1, 1, bias=False), []

    def loss(data, index, seed):
        values = np.concatenate([data[0][data[1][i]:data[1][i + 1], 0] for i in index])
        return net.weight.sum() * float(values.mean()), len(values)

    run = SimpleNamespace(dir=tmp_path, load_resume=lambda: None, save_resume=lambda state: None, log=lambda **row: None,
                          out_of_time=lambda: False)
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda parameters, norm: slopes.append(net.weight.grad.item()))
    assert supervised.fit(run, net, loss, lambda: None, data, data, seed=0, sequences=8, epochs=1, lr=1e-3, lr_end=1e-3,
                          grad_norm=1.0, validation=64)
    assert len(slopes) == 8 and np.mean(slopes) == pytest.approx(data[0][:, 0].mean(), rel=1e-4)
