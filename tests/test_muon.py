import pytest
import torch

from common import muon, networks


@pytest.mark.parametrize("shape", [(1, 32, 32), (4, 64, 16), (2, 16, 64)])
def test_singular_values_come_near_one(shape):
    x = 1e3 * torch.randn(shape, generator=torch.Generator().manual_seed(0))
    values = torch.linalg.svdvals(muon.orthogonal(x))
    assert 0.5 < values.min() and values.max() < 1.25
    u, _, v = torch.linalg.svd(x, full_matrices=False)
    assert (muon.orthogonal(x) - u @ v).abs().max() < 0.4, "it is a rotation of something else"


def test_a_gate_of_an_lstm_moves_alone():
    net = networks.Estimator((16, 16, 16))
    before = net.lstm.weight_hh_l0.detach().clone()
    matrices, rest = muon.optimizers(net, lr=0.01)
    for p in net.parameters():
        p.grad = torch.zeros_like(p)
    net.lstm.weight_hh_l0.grad[16:32] = torch.randn(16, 16, generator=torch.Generator().manual_seed(0))  # the forget gate's
    matrices.step()
    step = (net.lstm.weight_hh_l0.detach() - before).view(4, 16, 16)
    assert step[[0, 2, 3]].abs().max() == 0
    assert torch.linalg.svdvals(step[1]) == pytest.approx(0.2 * 0.01 * 16**0.5, rel=0.4)


def test_the_first_and_the_last_matrix_are_adams():
    net = networks.Estimator((16, 32, 48))
    matrices, rest = ({p for group in part.param_groups for p in group["params"]} for part in muon.optimizers(net, lr=0.01))
    assert matrices == {net.lstm.weight_hh_l0, net.layers[0].weight, net.layers[1].weight}
    assert matrices | rest == {*net.parameters()} and not matrices & rest


def test_a_step_is_torchs_where_that_computes_in_bfloat16():
    start, gradient = (torch.randn(48, 32, generator=torch.Generator().manual_seed(k)) for k in (0, 1))
    ours, theirs = (torch.nn.Parameter(start.clone()) for _ in range(2))
    optimizers = muon.Muon([ours], lr=0.1), torch.optim.Muon([theirs], lr=0.1, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    for k in range(3):
        for p, optimizer in zip((ours, theirs), optimizers):
            p.grad = gradient + k
            optimizer.step()
    assert (ours - theirs).abs().max() < 0.05 * (ours - start).abs().max()
