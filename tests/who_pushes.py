"""Why a sigma that is true on the test set is short in the loop: estimators judge the episodes of other players.

    python tests/who_pushes.py [pretrained|quick|laptop|paper] [--weights DIR] [--episodes n] [--seed k]

Each player plays the same starts. Its pushes are observed anew, with noise and occlusions of their own; those of a policy that
acts on an estimate also as it saw them, once more with other dropout masks, and by the very estimate that it acted on. Prints
the shares of x, y and theta within one and two standard deviations, scaled as the validation set gave, in %, +- half the widest
of their intervals, and the mean error of ours and of likelihood.
"""
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
from common import collection, command, runs, speed, stacks, statistics, symmetry, tables, task, trajectories
from common.files import UserError
from common.measurements import Measurement
from common.players import Players, first_seed

KINDS = ("ours", "likelihood")
POLICIES = ("est_uncertainty", "est_likelihood")


@dataclass
class Config(command.Reader):
    episodes: int = 1000  # of each player: the first of 05's list, where it has so many worlds at once
    passes: int = 10  # M, stochastic passes of the estimators, in the loop and beside it


PRESETS = {"pretrained": dict(weights=Path(__file__).parent.parent / "pretrained"), "quick": {}, "laptop": {}, "paper": {}}


def row(player, observed, judged):
    """Cells of a line from {kind: statistics.error_table}; a kind that did not judge is blank."""
    told = [judged.get(kind) for kind in KINDS]
    return [player, observed, *(cell for e in told for cell in (tables.coverage(e["scaled"]) if e else ("", ""))),
            "; ".join(f"{e['trans_mean_l2_mm']:.1f}" if e else "-" for e in told)]


def main(cfg):
    if cfg.episodes == 1:
        raise UserError("--episodes 1: one tells no interval, say 2 or more")
    device, seed = command.device_of(cfg), first_seed(cfg)
    policies = {("priv_on_state", 0): runs.find(cfg, "01_train_privileged", "policy.safetensors")}
    policies |= {(m, 0): runs.find(cfg, "04_train_policy", "policy.safetensors", m) for m in POLICIES}
    nets = {kind: stacks.find_estimator(cfg, kind) for kind in KINDS}
    world = runs.world_of(cfg, [*policies.values(), *sum(nets.values(), [])])
    players = Players(cfg, policies | nets, device, world)
    estimators = {kind: players.estimator(kind) for kind in KINDS}

    def predict(kind):
        return lambda o: estimators[kind].predict(o, passes=cfg.passes)[:2]

    def anew(states, length):
        """{kind: errors} on the flat states of trajectories, observed anew, the same for all kinds."""
        data = states, np.concatenate([[0], length]).cumsum()
        sums = {kind: trajectories.measure(data, cfg.episodes, 100, seed, device, predict(kind), world, f.scale)
                for kind, f in estimators.items()}
        return {kind: statistics.error_table(of) for kind, of in sums.items()}

    @torch.no_grad()
    def as_seen(env, length):
        """{kind: errors} on what a policy saw, from its film.Recorded."""
        state, o = (np.stack([row[name] for row in env.rows[:length.max()]]) for name in ("state", "o"))
        sign, mask = symmetry.signs(o[0]), np.arange(len(o))[:, None] < length
        q, seen = symmetry.mirror(task.scale(state, world.max_force), sign)[..., :4].astype(float), symmetry.mirror(o, sign)
        told = {}
        for kind, f in estimators.items():
            parts = []
            for some in trajectories.batches(np.arange(len(length)), 100):
                with speed.autocast(device):
                    estimate = predict(kind)(torch.as_tensor(seen[:, some], device=device))
                arrays = [x.double().cpu().numpy() for x in estimate]
                parts.append(trajectories.compared(*arrays, q[:, some], seen[:, some, 8], mask[:, some], f.scale))
            told[kind] = statistics.error_table({name: np.concatenate([part[name] for part in parts], 1) for name in parts[0]})
        return told

    rows = []
    for drifting in (0, cfg.episodes):
        states, length, _ = collection.collect(players.policy("priv_on_state", 0), world, cfg.episodes, seed, drifting)
        player = f"pi_priv, {'sees the box drift' if drifting else 'knows the pose'}, sampled"
        rows.append(row(player, "anew", anew(states, length)))
    for method in ("priv_on_state", *POLICIES):
        success, length, env = players.chunk(Measurement(method, cfg.episodes, worlds=cfg.episodes), 0)
        states = np.concatenate([env.episode(i, n)["state"][:n] for i, n in enumerate(length)])
        rows.append(row("pi_priv, knows the pose" if method == "priv_on_state" else method, "anew", anew(states, length)))
        if own := stacks.METHODS[method].estimator:
            rows.append(row(method, "as it saw them", as_seen(env, length)))
            told = statistics.in_the_loop(trajectories.in_the_loop(env, length, success, estimators[own].scale))
            rows.append(row(method, "its own estimate", {own: told}))
    print(f"{cfg.episodes} episodes each\n")
    header = [f"{kind}: {level}" for kind in KINDS for level in ("1 (68 %)", "2 (95 %)")]
    print(tables.aligned(["player", "observed", *header, f"mean L2 (mm): {'; '.join(KINDS)}"], rows))


if __name__ == "__main__":
    command.main(Config, PRESETS, main, __doc__)
