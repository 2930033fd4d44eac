"""The command line of a stage: `python 0N_name.py [preset] [--field value ...]`, and what a mistake there says."""
import contextlib
import errno
import io
import os
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch
import tyro

from common import ranks, speed
from common.files import UserError


def setting(default, **past):
    """A field that older runs may not know: was="its old name", before=what the code did then, if not what the default does."""
    return field(default=default, metadata=past)


def flat(cfg):
    """[(field, value)] of the settings of a config, those of a group of its, such as the world, among its own."""
    parts = [(known, getattr(cfg, known.name)) for known in fields(cfg)]
    return [pair for part in parts for pair in (flat(part[1]) if is_dataclass(part[1]) else [part])]


@dataclass
class Stage:
    """What every stage can be told. A script's Config adds its own fields, with the paper's values as defaults."""

    free: ClassVar[tuple[str, ...]] = ()  # fields that may change from one call to the next of the same run
    weights: ClassVar[Path | None] = None
    preset: tyro.conf.Suppress[str] = "paper"
    seed: int = 0  # seed of every random draw; names the run folder
    out: Path = Path("runs")  # root of the run folders
    device: Literal["auto", "cpu", "cuda"] = "auto"  # where the networks run; auto is cuda if there is one
    threads: int = 2  # independent jobs at a time on the CPU (nets, passes, halves); changes no result
    force: bool = False  # redo a finished, or differently configured, run from nothing
    max_minutes: float = float("inf")  # stop at the next resume point after so many minutes

    @property
    def own(self) -> Path:
        """Folder that the run folders of this preset lie in."""
        return self.out / self.preset

    @property
    def roots(self) -> list[Path]:
        """Folders in which the artifacts of earlier stages are looked for, in this order."""
        return [self.weights, self.own] if self.weights else [self.own]


@dataclass
class Reader(Stage):
    """A stage that can be shown nets from elsewhere."""

    free: ClassVar = ("weights",)
    weights: Path | None = None  # take what this folder has, laid out as <out>/<preset>, from there


def parse(config_class: type, presets: dict[str, dict], doc: str, args: list[str]):
    """The config of `[preset] [--field value ...]`; no preset means quick."""
    path, names = Path(sys.argv[0]), "|".join(presets)
    script = f"python {'tests/' * (path.parent.name == 'tests')}{path.name}"
    preset, *args = args if args and not args[0].startswith("-") else ["quick", *args]
    if preset not in presets:
        raise UserError(f"unknown preset {preset!r}: say one of {names}, or --help")
    default, doc = config_class(preset=preset, **presets[preset]), f"{doc.strip()}\n\nDefaults of the preset {preset}:"
    try:
        with contextlib.redirect_stderr(io.StringIO()) as box:
            cfg = tyro.cli(config_class, default=default, args=args, prog=f"{script} [{names}]", description=doc)
    except SystemExit as end:
        if not end.code:
            raise
        # tyro frames its message, with a rule below it and more help below that
        message = box.getvalue().partition("\n")[2].partition("│ ─")[0].replace("│", " ").strip().rstrip(".")
        message = message.removeprefix("Error parsing world: ")
        raise UserError(f"{message}; see {script} {preset} --help") from None
    if cfg.weights and not any(cfg.weights.glob("0*/**/config.json")):
        raise UserError(f"--weights {cfg.weights}: no run is in there; say pretrained, or the runs/<preset> of a study")
    for name, value in ((known.name, value) for known, value in flat(cfg)):
        for number in value if isinstance(value, tuple) else [value]:
            least = int(type(number) is int and name != "seed")
            if type(number) in (int, float) and not number >= least:
                raise UserError(f"--{name.replace('_', '-')} {number}: at least {least}")
    return cfg


def main(config_class: type, presets: dict[str, dict], run: Callable, doc: str):
    """Runs a stage from the command line. A mistake is one line on stderr and exit code 2, Ctrl-C is 130."""
    sys.stdout = open(os.devnull, "w") if ranks.RANK else sys.stdout
    sys.stdout.reconfigure(line_buffering=True)
    try:
        cfg = parse(config_class, presets, doc, sys.argv[1:])
        speed.set_up(cfg.threads, ranks.LOCAL_COUNT)
        ranks.begin(device_of(cfg))
        run(cfg)
        return ranks.end()
    except UserError as mistake:
        ranks.let_the_cause_speak(mistake)
        message, code = str(mistake), 2
    except KeyboardInterrupt:
        message, code = "interrupted: the same command, without --force, goes on from the last resume point", 130
    except BrokenPipeError:  # `--help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except Exception as failure:
        known = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST, errno.ENOTDIR)
        ranks.let_the_cause_speak(failure)
        if isinstance(failure, OSError) and failure.errno in (None, *known):  # numpy gives no errno where the disk is full
            message, code = f"cannot read or write ({failure}): make room, or choose another --out", 2
        elif ranks.COUNT == 1:
            raise
        else:
            traceback.print_exc()
            os._exit(1)  # a thread of this rank may wait in a collective that the others never call
    if code == 2 or not ranks.RANK:
        print("error:", " ".join(message.split()), file=sys.stderr, flush=True)
    (sys.exit if ranks.COUNT == 1 else os._exit)(code)


def device_of(cfg: Stage) -> torch.device:
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: torch finds no GPU here; use --device cpu or auto")
    if cfg.device == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    if ranks.LOCAL_COUNT > torch.cuda.device_count():
        raise UserError(f"{ranks.LOCAL_COUNT} processes for {torch.cuda.device_count()} GPUs: one for each, or --device cpu")
    return torch.device("cuda", ranks.LOCAL)
