"""The recurrent policy and value nets (appendix B.1), and the state estimator with its uncertainty (sec. 3.2)."""
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import nn
from torch.nn import functional as F

from common import artifacts
from common.task import BINS

LOG_VAR = (-14.0, 4.0)  # clamp of the predicted log-variances
# torch computes each operation in one thread: more would wait for each other at each, and for any other job of the machine.
# This pool runs two independent jobs: nets, passes or halves of a mini-batch. A job must not wait for another.
torch.set_num_threads(1)
threads = ThreadPoolExecutor(2, initializer=torch.set_num_threads, initargs=(1,))  # OpenMP keeps the number per thread


def autocast(device):
    """bfloat16 autocast on a CPU that computes in it, else float32: CUDA's runs an LSTM in float16, too coarse for PPO.

    Its cache of weights is off: it would share their graph between threads.
    """
    device = torch.device(device)
    fast = device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()
    return torch.autocast(device.type, torch.bfloat16, enabled=fast, cache_enabled=False)


class Recurrent(nn.Module):
    """linear, LSTM, linear, linear with tanh between: the paper's 128, 256, 128 and the outputs.

    Args:
        inputs, outputs: sizes of the first and last layer.
        sizes: the three hidden sizes.
        memory: without it the LSTM is left out (a feed-forward net, for comparison in the tests).
    """

    def __init__(self, inputs, outputs, sizes=(128, 256, 128), memory=True):
        super().__init__()
        self.inputs, self.sizes, self.memory = inputs, sizes, memory
        self.encoder = nn.Linear(inputs, sizes[0])
        self.lstm = nn.LSTM(sizes[0], sizes[1]) if memory else nn.Linear(sizes[0], sizes[1])
        self.head = nn.Sequential(nn.Linear(sizes[1], sizes[2]), nn.Tanh(), nn.Linear(sizes[2], outputs))
        for name, weight in self.named_parameters():  # larger features than torch's default: learning starts sooner
            if weight.ndim == 1:
                nn.init.zeros_(weight)
            else:
                for gate in weight.chunk(4) if "lstm" in name and memory else [weight]:
                    nn.init.orthogonal_(gate, 1.0 if "weight_hh" in name else 2**0.5)

    def forward(self, x, hidden=None):
        """Outputs (T, B, outputs) float32 and the next hidden state of inputs (T, B, inputs); no hidden state is zeros."""
        z = torch.tanh(self.encoder(x))
        if self.memory:
            z, hidden = self.lstm(z, hidden)
        else:
            z = torch.tanh(self.lstm(z))
        return self.head(z).float(), hidden

    def initial(self, batch, device=None):
        return tuple(torch.zeros(1, batch, self.sizes[1], device=device) for _ in range(2))


def policy(inputs, sizes=(128, 256, 128), memory=True):
    """Net with 22 logits: 11 velocities along x, 11 along y. Starts near the uniform distribution."""
    net = Recurrent(inputs, 2 * BINS, sizes, memory)
    nn.init.orthogonal_(net.head[-1].weight, 0.01)
    return net


def value(inputs, sizes=(128, 256, 128), memory=True):
    return Recurrent(inputs, 1, sizes, memory)


def log_softmax(logits):
    """Log-probabilities (..., 2, 11) of the two categorical velocities from logits (..., 22)."""
    return F.log_softmax(logits.unflatten(-1, (2, BINS)), -1)


def log_prob(logp, actions):
    """Log-probability (...) of actions (..., 2) under log-probabilities (..., 2, 11)."""
    return logp.gather(-1, actions.unsqueeze(-1)).squeeze(-1).sum(-1)


def sample(logits):
    """Actions (..., 2) drawn from logits (..., 22), by the Gumbel trick."""
    logits = logits.unflatten(-1, (2, BINS))
    return (logits - torch.empty_like(logits).exponential_().log_()).argmax(-1)


def mode(logits):
    """The most probable actions (..., 2) of logits (..., 22)."""
    return logits.unflatten(-1, (2, BINS)).argmax(-1)


def forget(hidden, worlds):
    """Hidden state (tuple of (1, B, H)) with zeros where `worlds` (B,) bool is set."""
    return tuple(h * (~worlds)[None, :, None] for h in hidden)


def dropout(x, p, generator=None):
    """F.dropout with a random byte an element: six times as fast on a CPU, where the masks cost more than the layers.

    p in [0, 1) is rounded to whole 256ths.
    """
    drop = min(round(256 * p), 255)
    if drop == 0:
        return x
    draws = torch.empty((x.numel() + 7) // 8, dtype=torch.int64, device=x.device).random_(-2**63, None, generator=generator)
    keep = draws.view(torch.int8)[:x.numel()].view(x.shape).clamp_(drop - 129, drop - 128).sub_(drop - 129)  # 0 or 1
    return x * keep * (256 / (256 - drop))


class EvenLSTM(nn.LSTM):
    """An LSTM that gives odd inputs one more, always zero: oneDNN's matrix units take even widths only, three times as fast."""

    def __init__(self, inputs, size):
        super().__init__(inputs + inputs % 2, size)
        self.odd = inputs % 2

    def forward(self, x, hidden=None):
        return super().forward(F.pad(x, (0, self.odd)), hidden)


class Estimator(nn.Module):
    """f: LSTM 1024, then linear 512, 256, 8 with tanh and dropout before every linear layer (sec. 4).

    Args:
        sizes: of the LSTM and the two hidden linear layers.
        dropout: probability; 0 for the likelihood and MSE variants.
        likelihood: predict log-variances too (8 outputs), else the pose alone (4, MSE).
    """

    def __init__(self, sizes=(1024, 512, 256), dropout=0.2, likelihood=True):
        super().__init__()
        self.sizes, self.dropout, self.likelihood = tuple(sizes), dropout, likelihood
        self.lstm = EvenLSTM(9, sizes[0])
        nn.init.ones_(self.lstm.bias_ih_l0[sizes[0]:2 * sizes[0]])  # the forget gates begin open
        self.layers = nn.ModuleList([nn.Linear(sizes[0], sizes[1]), nn.Linear(sizes[1], sizes[2]),
                                     nn.Linear(sizes[2], 8 if likelihood else 4)])

    def head(self, z, generator=None):
        """Poses (..., 4) and log-variances (..., 4) or None of features (..., H), with a fresh dropout mask each call."""
        for i, layer in enumerate(self.layers):
            z = layer(dropout(z, self.dropout, generator))  # at training and testing time
            if i < 2:
                z = torch.tanh(z)
        q, log_var = z.float().split(4, -1) if self.likelihood else (z.float(), None)
        return q, log_var.clamp(*LOG_VAR) if self.likelihood else None

    def forward(self, o, hidden=None):
        """One stochastic pass: pose (T, B, 4), log-variances and the hidden state of observations (T, B, 9)."""
        z, hidden = self.lstm(o, hidden)
        return *self.head(z), hidden

    def predict(self, o, hidden=None, passes=50):
        """Predictive mean and total variance (T, B, 4) (eqs. 3, 4), and hidden state: LSTM once, head `passes` times."""
        z, hidden = self.lstm(o, hidden)
        passes = passes if self.dropout else 1
        at_once = min(max(1, 2**15 // (z.shape[0] * z.shape[1])), (passes + 1) // 2)  # the first bounds the memory
        counts = [min(at_once, passes - i) for i in range(0, passes, at_once)]
        seeds, graph = torch.randint(2**62, (len(counts),)).tolist(), torch.is_grad_enabled()

        def several(count, seed):  # in a thread that knows no autocast or no_grad of ours
            fast = z.dtype == torch.bfloat16
            with torch.set_grad_enabled(graph), torch.autocast(z.device.type, torch.bfloat16, enabled=fast, cache_enabled=False):
                return self.head(z.expand(count, *z.shape), torch.Generator(z.device).manual_seed(seed))

        q, log_var = zip(*(threads.map if z.device.type == "cpu" else map)(several, counts, seeds))
        return *predictive(torch.cat(q), torch.cat(log_var) if self.likelihood else None), hidden


def predictive(q, log_var):
    """Mean and total variance over the first axis: E[q], E[sigma_ale^2] + E[(q - E[q])^2] (eqs. 3, 4), the diagonal."""
    mean = q.mean(0)
    sigma_epi2 = (q - mean).square().mean(0)
    return mean, sigma_epi2 if log_var is None else log_var.exp().mean(0) + sigma_epi2


def nll(q, log_var, target, mask):
    """Eq. 1 with a diagonal covariance, averaged over the valid steps of `mask` (T, B)."""
    loss = 0.5 * (log_var + (target - q).square() * (-log_var).exp()).sum(-1)
    return (loss * mask).sum() / mask.sum()


def mse(q, target, mask):
    """Mean squared error over the four components and the valid steps of `mask` (T, B)."""
    return ((target - q).square().mean(-1) * mask).sum() / mask.sum()


def _halves(net):
    return {name: x.half() for name, x in net.state_dict().items()}


def save_recurrent(path, net):
    """Writes a policy or value net as float16 safetensors, with its sizes."""
    artifacts.save_tensors(path, _halves(net), inputs=net.inputs, outputs=net.head[-1].out_features, sizes=net.sizes)


def load_recurrent(path, device="cpu"):
    return _load(Recurrent, path, device)


def save_estimator(path, net):
    """Writes an estimator as float16 safetensors, with its sizes and kind."""
    artifacts.save_tensors(path, _halves(net), sizes=net.sizes, dropout=net.dropout, likelihood=net.likelihood)


def load_estimator(path, device="cpu"):
    return _load(Estimator, path, device)


def _load(kind, path, device):
    tensors, meta = artifacts.load_tensors(path)
    try:
        net = kind(**meta)
        net.load_state_dict({name: x.float() for name, x in tensors.items()})
    except (TypeError, RuntimeError):
        raise artifacts.UserError(f"{path} holds another net than expected: rerun its stage with --force, "
                                  "or take weights of this version") from None
    return net.to(device).requires_grad_(False)
