"""Muon: momentum made orthogonal, for the matrices within a net (Jordan et al. 2024; its rate is Adam's by Liu et al. 2025)."""
import math

import torch

from common import ranks, speed

MOMENTUM = 0.95
STEPS = 5  # of the Newton-Schulz iteration
A, B, C = 3.4445, -4.7750, 2.0315  # its polynomial a s + b s^3 + c s^5 brings singular values of 0 < s <= 1 near 1 at once
GATES = 4  # of an LSTM, whose matrices stand one above the other


def orthogonal(x):
    """Matrices (k, m, n) with their singular values brought near 1: all but the very small ones to between 0.68 and 1.2."""
    x = x / (x.norm(dim=(1, 2), keepdim=True) + 1e-7)
    flat = x if x.shape[1] <= x.shape[2] else x.mT
    with speed.autocast(x.device):
        for _ in range(STEPS):
            gram = flat @ flat.mT
            polynomial = torch.baddbmm(gram, gram, gram, beta=B, alpha=C)
            flat = torch.baddbmm(flat, polynomial, flat, beta=A)
    return (flat if x.shape[1] <= x.shape[2] else flat.mT).to(x.dtype)


class Muon(torch.optim.Optimizer):
    """torch.optim.Muon, in bfloat16 only where the CPU computes in it, and a gate of an LSTM at a time.

    Args: params: matrices, in groups with `blocks`, how many stand one above the other in each; lr: of the same size as Adam's.
    """

    def __init__(self, params, lr):
        super().__init__(params, dict(lr=lr, blocks=1))

    def step(self):
        """One step; the matrices are shared out among the processes."""
        jobs = sorted(((p, group) for group in self.param_groups for p in group["params"]), key=_work, reverse=True)
        owners = ranks.owners(map(_work, jobs))
        speed.side_by_side(self._descend, *zip(*jobs), owners)
        ranks.hand_out([p.data for p, _ in jobs], owners)

    @torch.no_grad()  # in a thread that knows none of ours
    def _descend(self, p, group, owner):
        if "momentum" not in self.state[p]:
            self.state[p]["momentum"] = torch.zeros_like(p)
        momentum = self.state[p]["momentum"].lerp_(p.grad, 1 - MOMENTUM)
        if owner == ranks.RANK:
            update = p.grad.lerp(momentum, MOMENTUM).view(group["blocks"], -1, p.shape[1])  # Nesterov's
            p.sub_(orthogonal(update).reshape_as(p), alpha=0.2 * group["lr"] * math.sqrt(max(update.shape[1:])))


def _work(job):
    """Of making a parameter's step orthogonal, but for a factor."""
    p, group = job
    return p.numel() * min(p.numel() // p.shape[1] // group["blocks"], p.shape[1])


def optimizers(net, lr):
    """[Muon, Adam] of a net of an LSTM, "lstm" in its parameters' names, and other layers: Muon for its matrices but the first
    and the last, a gate at a time in the LSTM's, and Adam for the rest.
    """
    *within, _ = [name for name, p in net.named_parameters() if p.ndim == 2][1:]
    groups = [{"params": [p for name, p in net.named_parameters() if name in within and ("lstm" in name) == gated],
               "blocks": GATES if gated else 1} for gated in (True, False)]
    return [Muon(groups, lr), torch.optim.Adam([p for name, p in net.named_parameters() if name not in within], lr, fused=True)]
