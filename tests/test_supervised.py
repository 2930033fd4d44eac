from types import SimpleNamespace

import numpy as np
import pytest
import torch

from common import supervised, trajectories
from common.task import World


def run_in(folder, state=None):
    return SimpleNamespace(dir=folder, load_resume=lambda: state, save_resume=lambda state: None, log=lambda **row: None,
                           out_of_time=lambda: False, world=World())


@pytest.mark.parametrize("slope", [1.0, 1e3])  # the gradient's norm is that, or clipped to 1
def test_a_step_counts_the_same_in_every_minibatch(slope, monkeypatch, tmp_path):
    lengths = np.random.default_rng(0).integers(1, 50, 64)
    data = np.ones((lengths.sum(), 7)), np.concatenate([[0], lengths.cumsum()])
    net, told = torch.nn.Linear(1, 1, bias=False), []
    monkeypatch.setattr(torch.optim.Adam, "step", lambda self: told.append((net.weight.grad.item(), sum(steps[-2:]))))
    steps = []

    def loss(o, s, mask, generator):
        steps.append(int(mask.sum()))
        return slope * net.weight.sum()

    assert supervised.fit(run_in(tmp_path), net, loss, lambda: None, data, data, seed=0, sequences=8, epochs=1, lr=1e-3,
                          lr_end=1e-3, grad_norm=1.0, validation=64, optimizer="adam", fresh=True)
    gradients, counts = np.array(told).T
    assert len(told) == 8 and counts.max() > 2 * counts.min()
    assert gradients * counts.sum() / 8 == pytest.approx(counts, rel=1e-4)


@pytest.mark.parametrize("explosion", [lambda w: 1e5 * w, lambda w: (w - w.detach()).sqrt()], ids=["huge", "infinite"])
def test_a_gradient_that_explodes_moves_nothing(explosion, tmp_path):
    data, net, calls = (np.zeros((64, 7)), np.arange(0, 65, 8)), torch.nn.Linear(1, 1, bias=False), []
    before = net.weight.item()

    def loss(*batch):  # the first of four mini-batches, both halves of it, is as usual
        calls.append(batch)
        return (net.weight if len(calls) <= 2 else explosion(net.weight)).sum()

    assert supervised.fit(run_in(tmp_path), net, loss, lambda: None, data, data, seed=0, sequences=2, epochs=1, lr=1e-3,
                          lr_end=1e-3, grad_norm=1.0, validation=8, optimizer="adam", fresh=True)
    assert net.weight.item() == pytest.approx(before - 1e-3, abs=1e-6)


@pytest.mark.parametrize("fresh", [True, False])
def test_noise_is_drawn_afresh_in_every_epoch_or_once_a_trajectory(fresh, monkeypatch, tmp_path):
    lengths = np.arange(20, 84)
    data = np.zeros((lengths.sum(), 7)), np.concatenate([[0], lengths.cumsum()])
    net, drawn, observe = torch.nn.Linear(1, 1, bias=False), [], trajectories.observe

    def recorded(data, index, seed, *more):  # what an observation is made of
        if len(seed) == 5:  # to train
            drawn.append((*index, *seed))
        return observe(data, index, seed, *more)

    monkeypatch.setattr(trajectories, "observe", recorded)
    supervised.fit(run_in(tmp_path), net, lambda *batch: net.weight.sum(), lambda: None, data, data, seed=0, sequences=8,
                   epochs=2, lr=1e-3, lr_end=1e-3, grad_norm=1.0, validation=8, optimizer="adam", fresh=fresh)
    first, second = drawn[:8], drawn[8:16]
    assert len(second) == 8 and first != second
    assert not {*first} & {*second} if fresh else {*first} == {*second}


def test_a_resume_point_of_older_code_is_gone_on_from(tmp_path):
    data, net = (np.zeros((64, 7)), np.arange(0, 65, 8)), torch.nn.Linear(1, 1, bias=False)
    adam = torch.optim.Adam(net.parameters()).state_dict()
    state = dict(epoch=1, best=0.0, net={"weight": torch.tensor([[5.0]])}, optimizer=adam)
    assert supervised.fit(run_in(tmp_path, state), net, lambda *batch: net.weight.sum(), lambda: None, data, data, seed=0,
                          sequences=8, epochs=2, lr=1e-3, lr_end=1e-3, grad_norm=1.0, validation=8, optimizer="adam", fresh=True)
    assert net.weight.item() == pytest.approx(5 - 1e-3, abs=1e-3)
