import math

import pytest
import torch
from torch import distributions, nn

from common import files, networks, stacks, weights
from common.files import UserError

INPUTS = torch.randn(7, 5, 9)


def shapes(net):
    return [(m.in_features, m.out_features) if isinstance(m, nn.Linear) else (m.input_size, m.hidden_size)
            for m in net.modules() if isinstance(m, nn.Linear | nn.LSTM)]


def small(**kw):
    return networks.Estimator((16, 12, 10), **kw)


# Policy and value


def test_the_papers_sizes_are_the_defaults():
    assert shapes(networks.policy(12)) == [(12, 128), (128, 256), (256, 128), (128, 22)]
    assert shapes(networks.value(8)) == [(8, 128), (128, 256), (256, 128), (128, 1)]
    assert shapes(networks.Estimator()) == [(9 + 1, 1024), (1024, 512), (512, 256), (256, 8)]
    assert shapes(networks.Estimator(likelihood=False))[-1] == (256, 4)
    assert networks.Estimator().dropout == 0.2


def test_an_untrained_policy_is_nearly_uniform():
    logp = networks.log_softmax(networks.policy(9)(INPUTS)[0])
    assert (logp + math.log(11)).abs().max() < 0.05


def test_actions_are_two_categoricals():
    logits, actions = torch.randn(6, 3, 22), torch.randint(0, 11, (6, 3, 2))
    x, y = (distributions.Categorical(logits=half) for half in logits.split(11, -1))
    logp = networks.log_softmax(logits)
    torch.testing.assert_close(networks.log_prob(logp, actions), x.log_prob(actions[..., 0]) + y.log_prob(actions[..., 1]))
    assert networks.mode(logits)[..., 1].equal(y.probs.argmax(-1))
    drawn = networks.sample(logits[0, 0].expand(40_000, 22))
    share = torch.stack([drawn[:, i].bincount(minlength=11) for i in (0, 1)]) / len(drawn)
    torch.testing.assert_close(share, logp[0, 0].exp(), atol=0.012, rtol=0)


def test_a_net_goes_step_by_step_or_all_at_once_and_remembers():
    net = networks.Recurrent(9, 3, (8, 6, 4))
    at_once, _ = net(INPUTS, net.initial(5))
    hidden, steps = net.initial(5), []
    for x in INPUTS:
        y, hidden = net(x[None], hidden)
        steps.append(y)
    torch.testing.assert_close(at_once, torch.cat(steps))
    changed = INPUTS.clone()
    changed[0] += 1
    assert not net(changed)[0][-1].equal(at_once[-1])


def test_forget_clears_the_chosen_worlds_only():
    h, c = networks.forget((torch.ones(1, 3, 4), torch.full((1, 3, 4), 2.0)), torch.tensor([True, False, True]))
    assert h[0].sum(1).tolist() == [0, 4, 0] and c[0].sum(1).tolist() == [0, 8, 0]


# Estimator


def test_dropout_stands_before_every_linear_layer_in_evaluation_too():
    f, inputs = networks.Estimator((64, 48, 32), dropout=0.2).eval(), []
    for layer in f.layers:
        layer.register_forward_pre_hook(lambda m, x: inputs.append(x[0]))
    with torch.no_grad():
        features = f.lstm(wide := torch.randn(40, 50, 9))[0]
        assert not f(wide)[0].equal(f(wide)[0])
    kept = [x != 0 for x in inputs]
    assert [x.shape[-1] for x in inputs] == 2 * [64, 48, 32]
    assert [k.float().mean().item() for k in kept] == pytest.approx([205 / 256] * 6, abs=0.01)
    torch.testing.assert_close(inputs[0].view(features.shape)[kept[0].view(features.shape)],
                               (features * 256 / 205)[kept[0].view(features.shape)])  # 51 of 256 drop
    correlation = torch.corrcoef(kept[0].view(-1, 64).float().T) - torch.eye(64)
    assert correlation.abs().max() < 0.12


def test_every_step_and_pass_has_its_own_mask():
    f = small(dropout=0.5)
    nn.init.zeros_(f.lstm.weight_ih_l0), nn.init.zeros_(f.lstm.weight_hh_l0)
    z = f.lstm(torch.zeros(30, 1, 9))[0][-1:, :1]
    q, _ = f.head(z.expand(20, 4, 5, 16))  # the same features at 20 passes, 4 steps, 5 worlds
    assert len(q.reshape(-1, 4).unique(dim=0)) == 20 * 4 * 5


def test_the_lstm_runs_once_and_the_head_m_times():
    f, outputs, lstm_calls = small(), [], []
    f.lstm.register_forward_hook(lambda *_: lstm_calls.append(1))
    f.layers[-1].register_forward_hook(lambda m, x, y: outputs.append(y.flatten(0, -4)))
    mean, variance, _ = f.predict(INPUTS, passes=13)
    passes = torch.cat(outputs)
    assert len(lstm_calls) == 1 and passes.shape == (13, 7, 5, 8)
    torch.testing.assert_close(mean, passes[..., :4].mean(0))
    torch.testing.assert_close(variance, passes[..., 4:].exp().mean(0) + passes[..., :4].var(0, correction=0))


def test_without_dropout_passes_agree_and_mse_knows_no_variance():
    f = small(dropout=0.0)
    q, log_var, _ = f(INPUTS)
    mean, variance, _ = f.predict(INPUTS, passes=9)
    torch.testing.assert_close((mean, variance), (q, log_var.exp()))
    q, log_var, _ = (f := small(dropout=0.0, likelihood=False))(INPUTS)
    mean, variance, _ = f.predict(INPUTS, passes=9)
    assert log_var is None and mean.equal(q) and not variance.any()


def test_without_dropout_the_head_is_tanh_layers():
    f = small(dropout=0.0)
    a, b, c = f.layers
    z = torch.randn(3, 2, 16)
    torch.testing.assert_close(torch.cat(f.head(z), -1), c(torch.tanh(b(torch.tanh(a(z))))))


def test_forget_gates_begin_open():
    gates = small().lstm.bias_ih_l0.view(4, 16)  # input, forget, cell, output
    assert (gates[1] == 1).all() and (gates[[0, 2, 3]].abs() <= 16**-0.5).all()


@pytest.mark.parametrize("width", [8, 10, 12])
def test_an_estimator_takes_nothing_but_observations(width):
    with pytest.raises(RuntimeError, match="input"):
        small()(torch.zeros(3, 2, width))


def test_log_variances_are_clamped():
    f = small()
    with torch.no_grad():
        f.layers[-1].bias[4:] = torch.tensor([-1e3, 1e3, -14.5, 4.5])
    log_var = f(INPUTS)[1]
    assert (log_var[..., :2] == torch.tensor([-14.0, 4.0])).all()
    assert log_var.min() == -14 and log_var.max() == 4


def test_the_estimator_goes_step_by_step_or_all_at_once():
    f = small(dropout=0.0)
    at_once, hidden, steps = f.predict(INPUTS)[0], None, []
    for o in INPUTS:
        q, _, hidden = f.predict(o[None], hidden)
        steps.append(q)
    torch.testing.assert_close(at_once, torch.cat(steps))


# The paper's equations


def test_predictive_mean_and_covariance_are_equations_3_and_4():
    q, log_var = torch.randn(50, 6, 4, dtype=torch.float64), torch.randn(50, 6, 4, dtype=torch.float64)
    mean, variance = networks.predictive(q, log_var)
    m = len(q)
    for step in range(6):
        total = q[:, step].sum(0)
        sigma = sum(torch.diag(log_var[i, step].exp()) for i in range(m)) / m
        sigma += sum(torch.outer(q[i, step], q[i, step]) for i in range(m)) / m - torch.outer(total, total) / m**2
        torch.testing.assert_close(mean[step], total / m)
        torch.testing.assert_close(variance[step], sigma.diag())


def test_epistemic_variance_survives_float32():
    q = 1 + 1e-4 * torch.randn(50, 1000, 4)
    variance = networks.predictive(q, None)[1]
    assert (variance > 0).all()
    torch.testing.assert_close(variance, q.double().var(0, correction=0).float(), rtol=1e-2, atol=0)


def test_nll_is_the_normal_log_likelihood_of_the_valid_steps():
    q, log_var, target = torch.randn(3, 7, 5, 4)
    mask = (torch.arange(7)[:, None] < torch.tensor([7, 3, 1, 5, 2])).float()
    normal = distributions.MultivariateNormal(q, torch.diag_embed(log_var.exp()))
    constant = 2 * math.log(2 * math.pi)
    wanted = -(normal.log_prob(target) + constant)[mask > 0].mean()
    torch.testing.assert_close(networks.nll(q, log_var, target, mask), wanted)
    torch.testing.assert_close(networks.nll(q + 1e3 * (1 - mask)[..., None], log_var, target, mask), wanted)


def test_mse_is_over_valid_steps():
    q, target = torch.randn(2, 7, 5, 4)
    mask = (torch.arange(7)[:, None] < torch.tensor([7, 3, 1, 5, 2])).float()
    torch.testing.assert_close(networks.mse(q, target, mask), nn.functional.mse_loss(q[mask > 0], target[mask > 0]))


# Files


def test_nets_come_back_from_files(tmp_path):
    net, f = networks.policy(12, (8, 6, 4)), small(dropout=0.0, likelihood=False)
    for parameter in (*net.parameters(), *f.parameters()):
        parameter.data = parameter.half().float()  # as the files hold them
    weights.save(policy := tmp_path / "policy.safetensors", net)
    weights.save(estimator := tmp_path / "estimator.safetensors", f)
    assert {x.dtype for path in (policy, estimator) for x in weights.load_tensors(path)[0].values()} == {torch.float16}
    again, f_again = weights.load(networks.Recurrent, policy), weights.load(networks.Estimator, estimator)
    x = torch.randn(3, 2, 12)
    assert again(x)[0].equal(net(x)[0]) and f_again(INPUTS)[0].equal(f(INPUTS)[0])
    assert (f_again.dropout, f_again.likelihood) == (0.0, False) and (again.inputs, again.sizes) == (12, (8, 6, 4))
    assert {x.dtype for net in (again, f_again) for x in net.parameters()} == {torch.float32}
    assert not any(x.requires_grad for net in (again, f_again) for x in net.parameters())


def test_a_damaged_net_is_a_users_error(tmp_path):
    weights.save(path := tmp_path / "policy.safetensors", networks.value(8, (8, 6, 4)))
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(files.UserError, match="policy.safetensors is missing or damaged"):
        weights.load(networks.Recurrent, path)


def test_another_net_than_expected_is_a_users_error(tmp_path):
    path, net, sizes = tmp_path / "net.safetensors", networks.value(8, (8, 6, 4)), (8, 6, 4)
    weights.save(path, net)
    with pytest.raises(files.UserError, match="another net than expected: rerun its stage"):
        weights.load(networks.Estimator, path)
    weights.save_tensors(path, net.state_dict(), sizes=sizes)  # an Estimator by its arguments
    with pytest.raises(files.UserError, match="another net than expected: rerun its stage"):
        weights.load(networks.Estimator, path)
    weights.save(path, small())
    with pytest.raises(files.UserError, match="another net than expected: rerun its stage"):
        weights.load(networks.Recurrent, path)


# Ensembles


def test_an_ensemble_is_eqs_3_and_4_over_its_nets():
    nets, o = [small(dropout=0.0).requires_grad_(False) for _ in range(3)], torch.randn(7, 5, 9)
    told = [net.predict(o) for net in nets]
    q, variance = (torch.stack([part[i] for part in told]) for i in range(2))
    mean, total, hidden = networks.Ensemble(nets).predict(o)
    assert mean == pytest.approx(q.mean(0)) and total == pytest.approx(variance.mean(0) + (q - q.mean(0)).square().mean(0))
    first = networks.Ensemble(nets).predict(o[:3])  # a step at a time it goes on
    again = networks.Ensemble(nets).predict(o[3:], first[2])
    assert torch.cat([first[0], again[0]]) == pytest.approx(mean, abs=1e-6) and len(hidden) == 6


def test_a_scaled_estimator_has_its_own_scale_of_sigma():
    net, o = small(dropout=0.0).requires_grad_(False), torch.randn(7, 5, 9)
    net.scale = [1.0, 2.0, 3.0, 0.5]
    q, variance, _ = net.predict(o)
    scaled = networks.Ensemble([net], scaled=True).predict(o)
    assert scaled[0].equal(q) and scaled[1] == pytest.approx(variance * torch.tensor([1, 4, 9, 0.25]))


def test_a_scale_is_kept_in_the_file(tmp_path):
    net = small(dropout=0.0)
    net.scale = [1.0, 2.0, 3.0, 0.5]
    weights.save(tmp_path / "f.safetensors", net)
    paths = [tmp_path / "f.safetensors"]
    assert stacks.load_estimator("ours", paths).scale == net.scale and stacks.load_estimator("ours_scaled", paths).scaled
    net.scale = None
    weights.save(paths[0], net)
    with pytest.raises(UserError, match="has no scale of its sigma: train it anew"):
        stacks.load_estimator("ours_scaled", paths)
