"""Stage 03: the state estimator f with aleatoric and epistemic uncertainty, and its two ablations (sec. 3.2, sec. 5.1).

    python 03_train_estimator.py [smoke|quick|laptop|paper] [--method ours|likelihood|mse] [--seed k] [--field value ...]

Reads the train and validation sets of 02. Writes runs/<preset>/03_train_estimator/<method>/seed<k>/: estimator.safetensors
(the epoch of the lowest validation loss), metrics.csv, likelihood_loss.png or mse_loss.png, passes.json: its errors in mm
and degrees on the validation set, for ours against M, and passes.png. Without --method all three are trained in turn.
"""
from dataclasses import dataclass, replace
from typing import Literal

import torch

from common import artifacts, networks, plots, supervised, tables, trajectories

METHODS = ("ours", "likelihood", "mse")
STRIDE = 3  # the loss is taken at every third step: neighbours say the same, and the head costs as much as the LSTM
GRID = (1, 2, 5, 10, 20, 50)  # of M, for the error against M


@dataclass
class Config(artifacts.Stage):
    method: Literal["ours", "likelihood", "mse", "all"] = "all"
    """ours: likelihood loss and MC dropout; likelihood, mse: without dropout (tab. estimator_ablation)"""
    sizes: tuple[int, int, int] = (1024, 512, 256)
    """LSTM and two linear layers (sec. 4)"""
    dropout: float = 0.2
    """probability before every linear layer, of ours (sec. 4)"""
    sequences: int = 100
    """trajectories per mini-batch: 30,000 steps in sequences of 300, padded (tab. estimator_hyperparameters)"""
    epochs: int = 110
    """passes over the training set, each with fresh noise and occlusions (tab. estimator_hyperparameters)"""
    lr: float = 1e-3
    """Adam's learning rate (tab. estimator_hyperparameters)"""
    lr_end: float | None = None
    """learning rate at the end of a cosine; none: it stays, as the paper's"""
    grad_norm: float = 1.0
    """clip of the gradient norm; the paper names none"""
    validation: int = 150_000
    """most trajectories of a validation (appendix B.2)"""


PRESETS = {
    "smoke": dict(sizes=(16, 16, 16), sequences=16, epochs=2, validation=12),
    "quick": dict(sizes=(256, 256, 256), sequences=32, epochs=8, lr=4e-3, lr_end=5e-5, validation=500),
    "laptop": dict(sizes=(256, 256, 256), sequences=32, epochs=20, lr=4e-3, lr_end=5e-5, validation=1000),
    "paper": {},
}


def train(run, cfg, train_set, validation_set, device):
    """f with eq. 1 or the mean squared error of one stochastic pass; False when the time limit stopped it."""
    torch.manual_seed(cfg.seed)
    dropout = cfg.dropout if cfg.method == "ours" else 0.0
    f = networks.Estimator(cfg.sizes, dropout, cfg.method != "mse").to(device)

    def loss(o, s, mask, generator):
        some = slice(generator.initial_seed() % min(STRIDE, len(o)), None, STRIDE)  # a first step for each seed
        with networks.autocast(device):
            q_hat, log_var = f.head(f.lstm(o)[0][some], generator)
        q, valid = s[some, :, :4], mask[some]
        return networks.nll(q_hat, log_var, q, valid) if f.likelihood else networks.mse(q_hat, q, valid)

    return supervised.fit(
        run, f, loss, lambda: networks.save_estimator(run.dir / "estimator.safetensors", f), train_set, validation_set,
        seed=cfg.seed, sequences=cfg.sequences, epochs=cfg.epochs, lr=cfg.lr, lr_end=cfg.lr_end, grad_norm=cfg.grad_norm,
        validation=cfg.validation)


def error_against_passes(estimator, data, cfg, device):
    """Errors on the validation set for each M of GRID; without dropout for M = 1, as every pass is the same."""
    def predict(passes):
        def poses(o):
            with networks.autocast(o.device):
                return estimator.predict(o, passes=passes)[0]
        return poses

    grid = GRID if estimator.dropout else (1,)
    sums = {m: trajectories.measure(data, cfg.validation, cfg.sequences, 3, device, predict(m)) for m in grid}
    return {m: tables.error_table(sums[m]) for m in grid}


def main(cfg):
    if not 0 <= cfg.dropout < 1:
        raise artifacts.UserError(f"--dropout {cfg.dropout}: at least 0 and below 1")
    device = artifacts.device_of(cfg)
    for method in METHODS if cfg.method == "all" else [cfg.method]:
        cfg = replace(cfg, method=method)
        train_set, paths = trajectories.load_set(cfg, "train")
        validation_set, more = trajectories.load_set(cfg, "validation")
        run = artifacts.Run(cfg, "03_train_estimator", paths | more, method)
        if run.skip():
            continue
        if not train(run, cfg, train_set, validation_set, device):
            return
        torch.manual_seed(cfg.seed)
        estimator = networks.load_estimator(run.dir / "estimator.safetensors", device)
        errors = error_against_passes(estimator, validation_set, cfg, device)
        artifacts.save_json(run.dir / "passes.json", errors)
        if len(errors) > 1:
            plots.passes(errors, run.dir / "passes.png")
        name = "mse_loss" if method == "mse" else "likelihood_loss"
        plots.validation_loss(cfg.own, name, run.dir / f"{name}.png")
        run.finish(["estimator.safetensors", "passes.json"], **supervised.outcome(run))
        last = errors[max(errors)]
        print(f"{run.dir}: validation loss {run.record['validation_loss']:.4f}, "
              f"error {last['trans_mean_l2_mm']:.2f} mm and {last['rot_mean_abs_deg']:.2f} degrees (M = {max(errors)})")


if __name__ == "__main__":
    artifacts.main(Config, PRESETS, main, __doc__)
