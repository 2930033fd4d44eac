"""Stage 03: the state estimator f with aleatoric and epistemic uncertainty, and its two ablations (sec. 3.2, sec. 5.1).

    python 03_train_estimator.py [smoke|quick|laptop|paper] [--method ours|likelihood|mse] [--seed k]
        [--weights DIR] [--field value ...]

Reads the train and validation sets of 02. Writes runs/<preset>/03_train_estimator/<method>/seed<k>/: estimator.safetensors
(the epoch of the lowest validation loss), metrics.csv, likelihood_loss.png or mse_loss.png, passes.json: its errors in mm
and degrees on the validation set, for ours against M, and passes.png. Without --method all three are trained in turn.
"""
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch

from common import calibration, command, networks, plots, ranks, runs, speed, statistics, supervised, trajectories, weights
from common.files import UserError, save_json
from common.stacks import TRAINED

STRIDE = 3  # the loss is taken at every third step: neighbours say the same, and the head costs as much as the LSTM
GRID = (1, 2, 5, 10, 20, 50)  # of M, for the error against M


@dataclass
class Config(command.Reader):
    method: Literal[(*TRAINED, "all")] = "all"  # ours: MC dropout; likelihood, mse: none (tab. estimator_ablation)
    sizes: tuple[int, int, int] = (1024, 512, 256)  # LSTM and two linear layers (sec. 4)
    dropout: float = 0.2  # probability before every linear layer, of ours (sec. 4)
    sequences: int = 100  # trajectories per mini-batch: 30,000 steps, 300 each (tab. estimator_hyperparameters)
    epochs: int = 110  # passes over the training set (tab. estimator_hyperparameters)
    fresh: bool = command.setting(False, before=True)  # draw noise and occlusions every epoch, not once a trajectory (sec. 3.2)
    optimizer: Literal["adam", "muon"] = "adam"  # muon: of the matrices within the net, Adam of the rest (Jordan et al. 2024)
    lr: float = 1e-3  # Adam's learning rate (tab. estimator_hyperparameters), and Muon's
    lr_end: float | None = None  # learning rate at the end of a cosine; none: it stays, as the paper's
    grad_norm: float = 1.0  # clip of the gradient norm; the paper names none
    validation: int = 150_000  # most trajectories of a validation (appendix B.2)


PRESETS = {
    "smoke": dict(sizes=(16, 16, 16), sequences=16, epochs=2, fresh=True, optimizer="muon", validation=12),
    "quick": dict(sizes=(128, 256, 256), dropout=0.05, sequences=32, epochs=8, fresh=True, optimizer="muon", lr=4e-3,
                  lr_end=5e-5, validation=500),
    "laptop": dict(sizes=(256, 256, 256), dropout=0.05, sequences=32, epochs=8, fresh=True, optimizer="muon", lr=2.5e-3,
                   lr_end=5e-5, validation=1000),
    "paper": {},
}


def train(run, cfg, train_set, validation_set, device):
    """f with eq. 1 or the mean squared error of one stochastic pass; False when the time limit stopped it."""
    torch.manual_seed(cfg.seed)
    kind = TRAINED[cfg.method]
    f = networks.Estimator(cfg.sizes, cfg.dropout if kind.dropout else 0.0, kind.likelihood).to(device)

    def loss(o, s, mask, generator):
        first = torch.randint(min(STRIDE, len(o)), (), generator=generator, device=device)
        steps = slice(int(first), None, STRIDE)
        with speed.autocast(device):
            q_hat, log_var, _ = f(o, steps=steps, generator=generator)
        q, valid = s[steps, :, :4], mask[steps]
        return networks.nll(q_hat, log_var, q, valid) if f.likelihood else networks.mse(q_hat, q, valid)

    return supervised.fit(
        run, f, loss, lambda: weights.save(run.dir / "estimator.safetensors", f), train_set, validation_set,
        seed=cfg.seed, sequences=cfg.sequences, epochs=cfg.epochs, lr=cfg.lr, lr_end=cfg.lr_end, grad_norm=cfg.grad_norm,
        validation=cfg.validation, optimizer=cfg.optimizer, fresh=cfg.fresh)


def settings_of(cfg):
    """Names of the settings that a method reads."""
    return {field.name for field in fields(cfg)} - ({"dropout"} if not TRAINED[cfg.method].dropout else set())


def against_passes(estimator, data, cfg, device, world):
    """{M: sums of trajectories.measure} on the validation set; without dropout for M = 1, as every pass is the same."""
    return {m: trajectories.measure(data, cfg.validation, cfg.sequences, 3, device,
                                    lambda o, m=m: estimator.predict(o, passes=m)[:2], world)
            for m in (GRID if estimator.dropout else (1,))}


def main(cfg):
    if not 0 <= cfg.dropout < 1:
        raise UserError(f"--dropout {cfg.dropout}: at least 0 and below 1")
    device = command.device_of(cfg)
    for method in TRAINED if cfg.method == "all" else [cfg.method]:
        cfg = replace(cfg, method=method)
        train_set, paths = trajectories.load_set(cfg, "train")
        supervised.check(train_set, cfg.sequences)
        validation_set, validation_paths = trajectories.load_set(cfg, "validation")
        run = runs.Run(cfg, "03_train_estimator", paths | validation_paths, method, settings_of(cfg))
        if run.skip():
            continue
        if not train(run, cfg, train_set, validation_set, device):
            return
        estimator = weights.load(networks.Estimator, run.dir / "estimator.safetensors", device)
        measured = against_passes(estimator, validation_set, cfg, device, run.world)
        if ranks.RANK:
            continue
        if "calibration" in (sums := measured[max(measured)]):
            estimator.scale = calibration.scale(sums["calibration"].T)
            weights.save(run.dir / "estimator.safetensors", estimator)
        errors = {m: statistics.error_table(sums) for m, sums in measured.items()}
        save_json(run.dir / "passes.json", errors)
        if len(errors) > 1:
            plots.passes(errors, run.dir / "passes.png")
        name = next(name for name, (_, methods, _) in plots.LOSSES.items() if method in methods)
        plots.validation_loss(cfg.roots, name, run.dir / f"{name}.png")
        run.finish(["estimator.safetensors", "passes.json"], **supervised.outcome(run))
        last = errors[max(errors)]
        print(f"{run.dir}: validation loss {run.record['validation_loss']:.4f}, "
              f"error {last['trans_mean_l2_mm']:.2f} mm and {last['rot_mean_abs_deg']:.2f} degrees (M = {max(errors)})")


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
