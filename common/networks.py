"""The recurrent policy and value nets (appendix B.1), and the state estimator with its uncertainty (sec. 3.2)."""
import torch
from torch import nn
from torch.nn import functional as F

from common import speed
from common.task import BINS

LOG_VAR = (-14.0, 4.0)  # clamp of the predicted log-variances


class Recurrent(nn.Module):
    """linear, LSTM, linear, linear with tanh between: the three hidden `sizes` and the outputs (appendix B.1)."""

    def __init__(self, inputs, outputs, sizes=(128, 256, 128)):
        super().__init__()
        self.inputs, self.outputs, self.sizes = inputs, outputs, tuple(sizes)
        self.encoder = nn.Linear(inputs, sizes[0])
        self.lstm = nn.LSTM(sizes[0], sizes[1])
        self.head = nn.Sequential(nn.Linear(sizes[1], sizes[2]), nn.Tanh(), speed.Float32Linear(sizes[2], outputs))
        for name, weight in self.named_parameters():  # larger features than torch's default: learning starts sooner
            if weight.ndim == 1:
                nn.init.zeros_(weight)
            else:
                for gate in weight.chunk(4) if "lstm" in name else [weight]:
                    nn.init.orthogonal_(gate, 1.0 if "weight_hh" in name else 2**0.5)

    def forward(self, x, hidden=None):
        """Outputs (T, B, outputs) float32 and the next hidden state of inputs (T, B, inputs); no hidden state is zeros."""
        z, hidden = self.lstm(torch.tanh(self.encoder(x)), hidden)
        return self.head(z), hidden

    def initial(self, batch, device=None):
        return tuple(torch.zeros(1, batch, self.sizes[1], device=device) for _ in range(2))


def policy(inputs, sizes=(128, 256, 128)):
    """Net with 22 logits: 11 velocities along x, 11 along y. Starts near the uniform distribution."""
    net = Recurrent(inputs, 2 * BINS, sizes)
    nn.init.orthogonal_(net.head[-1].weight, 0.01)
    return net


def value(inputs, sizes=(128, 256, 128)):
    return Recurrent(inputs, 1, sizes)


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


class Estimator(nn.Module):
    """f: LSTM 1024, then linear 512, 256, 8 with tanh and dropout before every linear layer (sec. 4).

    `sizes` are those of the LSTM and the two hidden linear layers. Without `likelihood` it predicts the pose alone (4 outputs,
    MSE), not its log-variances too. The variants without MC dropout have the probability 0. `scale`, if known, are the factors
    on its four standard deviations that fit the validation set best at M = 50; only an Ensemble applies them.
    """

    def __init__(self, sizes=(1024, 512, 256), dropout=0.2, likelihood=True, scale=None):
        super().__init__()
        self.sizes, self.dropout, self.likelihood, self.scale = tuple(sizes), dropout, likelihood, scale
        self.lstm = speed.EvenLSTM(9, sizes[0])
        nn.init.ones_(self.lstm.bias_ih_l0[sizes[0]:2 * sizes[0]])  # the forget gates begin open
        widths = (*sizes, 8 if likelihood else 4)
        kinds = nn.Linear, nn.Linear, speed.Float32Linear
        self.layers = nn.ModuleList([kind(a, b) for kind, a, b in zip(kinds, widths, widths[1:])])

    def head(self, z, generator=None):
        """Poses (..., 4) and log-variances (..., 4) or None of features (..., H), with a fresh dropout mask each call."""
        for i, layer in enumerate(self.layers):
            z = layer(speed.dropout(z, self.dropout, generator))  # at training and testing time
            if i < 2:
                z = torch.tanh(z)
        return (z[..., :4], z[..., 4:].clamp(*LOG_VAR)) if self.likelihood else (z, None)

    def forward(self, o, hidden=None, steps=slice(None), generator=None):
        """One stochastic pass: pose (T, B, 4), log-variances at `steps`, and the hidden state of observations (T, B, 9)."""
        z, hidden = self.lstm(o, hidden)
        return *self.head(z[steps], generator), hidden

    def predict(self, o, hidden=None, passes=50):
        """Predictive mean and total variance (T, B, 4) (eqs. 3, 4), and hidden state: LSTM once, head `passes` times."""
        z, hidden = self.lstm(o, hidden)
        q, log_var = speed.passes(self.head, z, passes if self.dropout else 1)
        return *predictive(q, log_var), hidden


def predictive(q, log_var):
    """Mean and total variance over the first axis: E[q], E[sigma_ale^2] + E[(q - E[q])^2] (eqs. 3, 4), the diagonal."""
    mean = q.mean(0)
    sigma_epi2 = (q - mean).square().mean(0)
    return mean, sigma_epi2 if log_var is None else log_var.exp().mean(0) + sigma_epi2


class Ensemble(nn.Module):
    """Estimators as one: eqs. 3 and 4 over `nets` instead of passes (Lakshminarayanan et al. 2017); `scaled`: by their scales."""

    def __init__(self, nets, scaled=False):
        super().__init__()
        self.nets, self.scaled = nn.ModuleList(nets), scaled

    def predict(self, o, hidden=None, passes=50):
        """As Estimator.predict; the hidden state is that of all nets, one behind the other."""
        each = [hidden and hidden[2 * i:2 * i + 2] for i in range(len(self.nets))]
        q, variance, hidden = zip(*(net.predict(o, own, passes) for net, own in zip(self.nets, each)))
        if self.scaled:
            variance = [v * v.new_tensor(net.scale).square() for v, net in zip(variance, self.nets)]
        return *predictive(torch.stack(q), torch.stack(variance).log()), sum(hidden, ())


def nll(q, log_var, target, mask):
    """Eq. 1 with a diagonal covariance, averaged over the valid steps of `mask` (T, B)."""
    loss = 0.5 * (log_var + (target - q).square() * (-log_var).exp()).sum(-1)
    return (loss * mask).sum() / mask.sum()


def mse(q, target, mask):
    """Mean squared error over the four components and the valid steps of `mask` (T, B)."""
    return ((target - q).square().mean(-1) * mask).sum() / mask.sum()
