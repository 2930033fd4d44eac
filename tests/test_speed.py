"""Every trick of common/speed.py against its plain form."""
import platform
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from common import networks, speed

ROOT = Path(__file__).parent.parent


def small(**kw):
    return networks.Estimator((16, 12, 10), **kw)


def fresh(code):
    """What a new process prints."""
    told = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert not told.stderr, told.stderr
    return told.stdout.strip()


@pytest.fixture
def pool(monkeypatch):
    """Sets the number of threads, until the test's end."""
    monkeypatch.setattr(speed, "pool", speed.pool)
    return speed.set_up


# The process


def test_importing_the_code_changes_no_thread_count_of_torch():
    count = "print(torch.get_num_threads())"
    told = fresh(f"import torch; torch.set_num_threads(3); import common.env; {count}; import common.training; {count}")
    assert told == "3\n3"


def test_a_stage_has_one_thread_in_an_operation_and_a_pool_above(pool):
    torch.set_num_threads(2)
    pool(3)
    assert torch.get_num_threads() == 1
    together = threading.Barrier(3, timeout=30)  # passes when three jobs run at a time
    assert speed.side_by_side(lambda i: (together.wait(), torch.get_num_threads())[1], range(3)) == [1, 1, 1]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps memory in its own way")
def test_freed_memory_is_kept():
    told = fresh("""if True:
        import resource, torch
        from common import speed

        def faults():
            before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            torch.ones(2**24)  # 64 MiB: 16,384 pages
            return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

        speed.set_up()
        print(*[faults() for _ in range(40)])
    """)
    assert max(map(int, told.split()[20:])) < 100  # the first ones find holes in the heap


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_jobs_side_by_side_come_back_in_their_order(pool, threads):
    pool(threads)
    assert speed.side_by_side(lambda a, b: 10 * a + b, range(50), range(50)) == [11 * i for i in range(50)]
    with pytest.raises(ZeroDivisionError):
        speed.side_by_side(lambda i: 1 / i, [1, 0])


# Precision


def test_autocast_is_bfloat16_where_the_cpu_computes_in_it(monkeypatch):
    x = torch.ones(2, 2)
    for fast, dtype in (True, torch.bfloat16), (False, torch.float32):
        monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: fast)
        with speed.autocast("cpu"):
            assert (x @ x).dtype == dtype and not torch.is_autocast_cache_enabled()
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    assert not speed.autocast(torch.device("cuda"))._enabled


def test_nothing_is_cast_under_the_float32_fixture(float32):
    with speed.autocast("cpu"):
        assert not torch.is_autocast_enabled("cpu") and small()(torch.randn(2, 3, 9))[2][0].dtype == torch.float32


def test_outputs_are_not_rounded_to_bfloat16(monkeypatch):
    """A value net's 40.01 and 40.05 are two numbers, and so are an estimate's of two places 0.1 mm apart."""
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    nets = {"head.2": networks.value(8, (16, 16, 16)), "layers.2": networks.Estimator((16, 16, 16), dropout=0.0)}
    for name, net in nets.items():
        with torch.no_grad():
            net.get_submodule(name).bias += 40.01
            z = torch.zeros(1, 1, 16)  # features: not every machine has an LSTM in bfloat16
            with speed.autocast("cpu"):
                first = net.head(z)
                net.get_submodule(name).bias += 0.04
                second = net.head(z)
            first, second = (x[0] if name == "layers.2" else x for x in (first, second))
        assert first.dtype == torch.float32
        torch.testing.assert_close(second - first, torch.full_like(first, 0.04), rtol=0, atol=1e-4)


def test_a_layer_in_float32_is_that_layer(monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    layer, x = speed.Float32Linear(16, 8), torch.randn(5, 16)
    plain = layer(x)
    with speed.autocast("cpu"):
        assert layer(x).equal(plain) and layer(x.bfloat16()).dtype == torch.float32
    loss = layer(x.bfloat16().requires_grad_()).sum()
    loss.backward()
    assert layer.weight.grad.dtype == torch.float32


# Dropout


@pytest.mark.parametrize("p", [0.2, 0.5, 0.01, 0.9])
def test_dropout_is_that_of_torch_in_distribution(p):
    x = 1 + torch.rand(1001, 999)  # no multiple of the eight bytes of a draw
    ours, plain = speed.dropout(x, p), F.dropout(x, p)
    rate = round(256 * p) / 256
    assert ours.shape == x.shape and ours.dtype == x.dtype
    dropped, tolerance = ours == 0, 4 * (p * (1 - p) / x.numel())**0.5
    assert dropped.float().mean().item() == pytest.approx(rate, abs=tolerance)
    assert dropped.float().mean().item() == pytest.approx((plain == 0).float().mean().item(), abs=2 * tolerance + 1 / 512)
    torch.testing.assert_close(ours[~dropped], x[~dropped] / (1 - rate))
    both = ~dropped & (plain != 0)
    torch.testing.assert_close(ours[both], plain[both], rtol=0.03, atol=0)  # p is rounded to 256ths
    spread = 3 * (p / (1 - p) / x.numel())**0.5
    assert ours.mean().item() == pytest.approx(x.mean().item(), rel=2 * spread)
    for a, b in (dropped[1:], dropped[:-1]), (dropped[:, 1:], dropped[:, :-1]), (dropped[:, 8:], dropped[:, :-8]):
        assert torch.corrcoef(torch.stack([a.flatten(), b.flatten()]).float())[0, 1].abs() < 0.006


def test_a_dropout_of_nothing_does_nothing_and_none_drops_all():
    x = torch.ones(1000)
    assert speed.dropout(x, 0.0) is x and speed.dropout(x, 0.001) is x
    assert set(speed.dropout(torch.ones(100_000), 0.9999).tolist()) == {0.0, 256.0}


def test_a_dropout_draws_from_its_generator_alone():
    x, state = torch.ones(40, 30), torch.get_rng_state()
    one, same, other = (speed.dropout(x, 0.5, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert one.equal(same) and not one.equal(other) and torch.get_rng_state().equal(state)
    torch.manual_seed(5), speed.dropout(x, 0.5)
    assert not torch.get_rng_state().equal(state)


def test_the_gradient_of_a_dropout_is_that_of_its_mask():
    x = torch.rand(50, 40, requires_grad=True)
    y = speed.dropout(x, 0.3)
    gradient, = torch.autograd.grad(y.sum(), x)
    torch.testing.assert_close(gradient, y.detach() / x.detach())


# LSTM


@pytest.mark.parametrize("inputs", [9, 8])
def test_an_even_lstm_is_an_lstm(inputs):
    even, plain, x = speed.EvenLSTM(inputs, 16), nn.LSTM(inputs, 16), torch.randn(7, 5, inputs)
    plain.load_state_dict({name: w[:, :inputs] if name == "weight_ih_l0" else w for name, w in even.state_dict().items()})
    assert even.weight_ih_l0.shape[1] == inputs + inputs % 2
    for hidden in None, (torch.randn(1, 5, 16), torch.randn(1, 5, 16)):
        (y, (h, c)), (wanted, (h_plain, c_plain)) = even(x, hidden), plain(x, hidden)
        torch.testing.assert_close((y, h, c), (wanted, h_plain, c_plain))
        for (name, a), b in zip(even.named_parameters(), plain.parameters()):
            a, b = (torch.autograd.grad(out.square().sum(), w, retain_graph=True)[0] for out, w in ((y, a), (wanted, b)))
            torch.testing.assert_close(a[:, :inputs] if name == "weight_ih_l0" else a, b)


# Stochastic passes


@pytest.mark.parametrize("shape, count, calls", [((7, 5), 13, [13]), ((7, 50), 13, [6, 7]), ((2, 2**13), 7, [1, 2, 2, 2]),
                                                 ((2, 2**14), 3, [1, 1, 1]), ((1, 1), 1, [1])])
def test_passes_of_a_plain_head_are_its_calls(shape, count, calls):
    f, z, taken = small(dropout=0.0), torch.randn(*shape, 16), []
    f.layers[-1].register_forward_hook(lambda m, x, y: taken.append(len(y)))
    q, log_var = speed.passes(f.head, z, count)
    assert q.shape == log_var.shape == (count, *shape, 4) and sorted(taken) == calls
    generator = torch.Generator()
    plain = [torch.stack(x) for x in zip(*(f.head(z, generator) for _ in range(count)))]
    torch.testing.assert_close((q, log_var), tuple(plain))


def test_passes_without_log_variances_have_none():
    f = small(likelihood=False)
    q, log_var = speed.passes(f.head, torch.randn(3, 2, 16), 5)
    assert q.shape == (5, 3, 2, 4) and log_var is None


@pytest.mark.parametrize("shape, count", [((7, 5), 13), ((70, 50), 13), ((2, 2**13), 7)])
def test_passes_are_the_same_for_any_number_of_threads(pool, shape, count):
    f, z, told = small(dropout=0.3), torch.randn(*shape, 16), []
    for threads in (1, 2, 3, 1):
        pool(threads)
        torch.manual_seed(4)
        told.append(speed.passes(f.head, z, count))
    for q, log_var in told[1:]:
        assert q.equal(told[0][0]) and log_var.equal(told[0][1])
    assert not speed.passes(f.head, z, count)[0].equal(told[0][0])


@torch.no_grad()
def test_passes_are_calls_with_draws_of_their_own():
    f, z, count = small(dropout=0.3), torch.randn(3, 2, 16), 4000
    generator = torch.Generator().manual_seed(1)
    at_once, plain = speed.passes(f.head, z, count), zip(*(f.head(z, generator) for _ in range(count)))
    for ours, wanted in zip(at_once, map(torch.stack, plain)):
        assert len(ours.flatten(1).unique(dim=0)) == count  # no mask twice
        deviation = wanted.std(0)
        assert ((ours.mean(0) - wanted.mean(0)).abs() < 5 * deviation * (2 / count)**0.5).all()
        torch.testing.assert_close(ours.std(0), deviation, rtol=0.1, atol=1e-6)
        ends = torch.stack([ours[:-1].flatten(), ours[1:].flatten()]) - ours.mean(0).flatten().repeat(count - 1)
        assert torch.corrcoef(ends)[0, 1].abs() < 0.03


@pytest.mark.parametrize("graph", [True, False])
def test_passes_keep_the_callers_graph_and_precision(graph, monkeypatch):
    seen = []

    def head(z, generator):
        seen.append((torch.is_grad_enabled(), torch.is_autocast_enabled("cpu")))
        return f.head(z, generator)

    f = small()
    with torch.set_grad_enabled(graph):
        for dtype in torch.float32, torch.bfloat16:
            q, _ = speed.passes(head, torch.randn(70, 50, 16).to(dtype), 6)  # in threads
            assert q.requires_grad == graph and q.dtype == torch.float32
    assert seen == 2 * [(graph, False)] + 2 * [(graph, True)]


# Halves of a mini-batch


def batch_of(lengths):
    """Random observations and states of trajectories of these lengths, as trajectories.observe pads them."""
    steps, count = max(lengths), len(lengths)
    mask = (torch.arange(steps)[:, None] < torch.tensor(lengths)).float()
    return torch.randn(steps, count, 9), torch.randn(steps, count, 8), mask


def loss_of(f):
    return lambda o, s, mask, generator=None: networks.nll(*f(o)[:2], s[..., :4], mask)


@pytest.mark.parametrize("lengths", [[7, 5, 4, 2, 1], [1, 5], [3]])
def test_halves_have_the_gradient_of_the_whole(lengths, float32):
    f, batch = small(dropout=0.0), batch_of(lengths)

    def gradient(*part):
        return torch.autograd.grad(loss_of(f)(*part) * part[-1].sum(), f.parameters())

    parts = speed.halves(batch)
    assert len(parts) == min(2, len(lengths)) and all(mask[-1].any() for _, _, mask in parts)
    assert sum(part[-1].sum() for part in parts) == sum(lengths)
    torch.testing.assert_close([sum(shares) for shares in zip(*(gradient(*part) for part in parts))], list(gradient(*batch)))


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("lengths", [[7, 5, 4, 2, 1], [1, 5], [3]])
def test_the_gradient_that_is_set_is_that_of_plain_autograd(lengths, threads, pool, float32):
    pool(threads)
    f, batch = small(dropout=0.0), batch_of(lengths)
    parameters = list(f.parameters())
    parts = speed.halves(batch)
    assert len(parts) == min(2, len(lengths))
    value, steps = speed.set_gradient(loss_of(f), parts, torch.Generator(), parameters)
    set_, whole = [p.grad.clone() for p in parameters], loss_of(f)(*batch)
    assert steps == sum(lengths) and value.item() == pytest.approx(whole.item(), rel=1e-5)
    torch.testing.assert_close(set_, list(torch.autograd.grad(whole, parameters)))
    speed.set_gradient(loss_of(f), parts, torch.Generator(), parameters)  # it adds nothing to the last one
    torch.testing.assert_close([p.grad for p in parameters], set_)


def test_each_half_draws_from_a_seed_of_its_own(pool):
    f, batch, told = small(dropout=0.5), batch_of([6, 5, 4, 3]), []

    def loss(o, s, mask, generator):
        seeds.add(generator.initial_seed())
        z = f.lstm(o)[0]
        return networks.nll(*f.head(z, generator), s[..., :4], mask)

    for threads, first in (1, 7), (2, 7), (2, 9):
        pool(threads)
        seeds, draws = set(), torch.Generator().manual_seed(first)
        value, _ = speed.set_gradient(loss, speed.halves(batch), draws, list(f.parameters()))
        assert len(seeds) == 2
        told.append((value, [p.grad.clone() for p in f.parameters()]))
    assert told[0][0] == told[1][0] and told[1][0] != told[2][0]
    torch.testing.assert_close(told[0][1], told[1][1], rtol=0, atol=0)


def test_what_is_made_ahead_comes_in_order_and_one_early():
    made = []
    for used, value in enumerate(speed.ahead(lambda x: made.append(x) or x * x, range(5))):
        assert value == used**2
    assert made == [0, 1, 2, 3, 4] and list(speed.ahead(abs, [])) == []
    with pytest.raises(ZeroDivisionError):
        list(speed.ahead(lambda x: 1 / x, [1, 0]))


def test_what_is_left_is_a_multiple_of_the_width():
    wanted = np.zeros(100, bool)
    wanted[[3, 50, 99]] = True
    kept = speed.fewer(wanted)
    assert len(kept) == speed.WIDTH and (np.diff(kept) > 0).all() and {3, 50, 99} <= {*kept}
    wanted[:90] = True
    assert (speed.fewer(wanted) == np.arange(100)).all()
