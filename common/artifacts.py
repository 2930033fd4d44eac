"""The command line of a stage, its run folder, and what earlier stages made.

runs/<preset>/<stage>/[method/]seed<k>/ holds config.json (settings, versions, sha256 of inputs and outputs, finished or
not), metrics.csv, resume.pt while unfinished, and the artifacts. A file that is there is whole: see write_atomic.
"""

import contextlib
import csv
import ctypes
import errno
import hashlib
import io
import json
import os
import re
import shutil
import sys
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Callable, ClassVar, Literal

import safetensors.torch
import torch
import tyro
from tqdm import tqdm

_STARTED = time.monotonic()


class UserError(Exception):
    """A user's mistake: one line, what is wrong and what to do."""


@dataclass
class Stage:
    """What every stage can be told. A script's Config adds its own fields, with the paper's values as defaults."""

    free: ClassVar[tuple[str, ...]] = ()  # fields that may change from one call to the next of the same run
    preset: tyro.conf.Suppress[str] = "paper"
    seed: int = 0
    """seed of every random draw; names the run folder"""
    out: Path = Path("runs")
    """root of the run folders"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where the networks run; auto is cuda if there is one"""
    force: bool = False
    """redo a finished, or differently configured, run from nothing"""
    max_minutes: float = float("inf")
    """stop at the next resume point after so many minutes"""

    @property
    def own(self) -> Path:
        """Folder that the run folders of this preset lie in."""
        return self.out / self.preset

    @property
    def source(self) -> Path:
        """Folder that the run folders of earlier stages lie in."""
        return self.own


@dataclass
class Reader(Stage):
    """A stage that trains nothing: it can be shown trained nets from elsewhere."""

    free: ClassVar = ("weights",)
    weights: Path | None = None
    """read the earlier stages in this folder, laid out as <out>/<preset>, instead of there"""

    @property
    def source(self) -> Path:
        return self.weights or self.own


def run_folder(study: Path, stage: str, method: str | None, seed: int) -> Path:
    """<study>/<stage>/[method/]seed<k>."""
    return study / stage / (method or "") / f"seed{seed}"


def parse(config_class: type, presets: dict[str, dict], doc: str, args: list[str]):
    """The config of `[preset] [--field value ...]`; no preset means quick."""
    script, names = f"python {Path(sys.argv[0]).name}", "|".join(presets)
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
        raise UserError(f"{message}; see {script} {preset} --help") from None
    for name, value in vars(cfg).items():
        for number in value if isinstance(value, tuple) else [value]:
            least = int(type(number) is int and name != "seed")
            if type(number) in (int, float) and not number >= least:
                raise UserError(f"--{name.replace('_', '-')} {number}: at least {least}")
    return cfg


def keep_memory():
    """Freed memory stays with the process (of a thread: blocks below 64 MB), where the C library is glibc: a training frees
    and takes arrays of the same sizes all the time, and the kernel would zero every page anew (a fifth of the time of PPO).
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(-4, 0), mallopt(-1, -1)  # M_MMAP_MAX: no mappings of single arrays; M_TRIM_THRESHOLD: no return of the rest


def main(config_class: type, presets: dict[str, dict], run: Callable, doc: str):
    """Runs a stage from the command line. A mistake is one line on stderr and exit code 2, Ctrl-C is 130."""
    sys.stdout.reconfigure(line_buffering=True)
    keep_memory()
    try:
        return run(parse(config_class, presets, doc, sys.argv[1:]))
    except UserError as mistake:
        message, code = str(mistake), 2
    except KeyboardInterrupt:
        message, code = "interrupted: the same command, without --force, goes on from the last resume point", 130
    except BrokenPipeError:  # `--help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except OSError as failure:
        # numpy gives no errno where the disk is full
        if failure.errno not in (None, errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST,
                                 errno.ENOTDIR):
            raise
        message, code = f"cannot read or write ({failure}): make room, or choose another --out", 2
    print("error:", " ".join(message.split()), file=sys.stderr)
    sys.exit(code)


def device_of(cfg: Stage) -> torch.device:
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: torch finds no GPU here; use --device cpu or auto")
    return torch.device("cuda" if cfg.device != "cpu" and torch.cuda.is_available() else "cpu")


def write_atomic(path: Path, write: Callable[[Path], object]):
    """Calls write with a temporary path beside `path`, of the same suffix, and renames the result to `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        write(temporary)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def save_json(path: Path, obj):
    """Writes JSON; arrays and tensors become lists, paths strings."""
    text = json.dumps(obj, indent=2, default=lambda x: x.tolist() if hasattr(x, "tolist") else str(x))
    write_atomic(path, lambda temporary: temporary.write_text(text + "\n"))


def save_tensors(path: Path, tensors: dict[str, torch.Tensor], **meta):
    """Writes a safetensors file; meta is anything that JSON holds."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    data = safetensors.torch.save(tensors, {"meta": json.dumps(meta)})  # one key: safetensors shuffles several
    write_atomic(path, lambda temporary: temporary.write_bytes(data))


def load_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict]:
    """The tensors, on the CPU, and the meta of save_tensors."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("meta", "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, meta
    except (safetensors.SafetensorError, OSError, ValueError):
        raise UserError(f"{path} is missing or damaged: rerun its stage with --force") from None


def digest(path: Path) -> dict:
    with open(path, "rb") as file:
        return {"sha256": hashlib.file_digest(file, "sha256").hexdigest(), "bytes": path.stat().st_size}


def remedy(cfg: Stage, folder: Path, more: str = "") -> str:
    """What to do about a run folder: run python 0N_name.py preset [--method m] [--seed k] [--out root]."""
    if not folder.is_relative_to(cfg.own):
        return f"--weights {cfg.source} is not, or no longer, the folder of a finished study"
    stage, *method, seed = folder.relative_to(cfg.own).parts
    method = f" --method {method[0]}" if method else ""
    seed = f" --seed {seed[4:]}" if seed != "seed0" else ""
    return f"run python {stage}.py {cfg.preset}{method}{seed}" + (f" --out {cfg.out}" if cfg.out != Stage.out else "") + more


def record_of(cfg: Stage, folder: Path) -> dict | None:
    """config.json of a run folder, None if there is none."""
    path = folder / "config.json"
    try:
        return json.loads(path.read_text()) if path.exists() else None
    except ValueError:
        raise UserError(f"{path} is damaged: {remedy(cfg, folder, ' --force')}") from None


def find(cfg: Stage, stage: str, name: str, method: str | None = None, seed: int = 0) -> Path:
    """Path of an earlier stage's artifact: finished, whole (above 64 MiB: of the right size), and not stale."""
    folder = run_folder(cfg.source, stage, method, seed)
    path, record = folder / name, record_of(cfg, folder)
    if not record or not record["finished"]:
        raise UserError(f"{path} is {'unfinished' if record else 'missing'}: {remedy(cfg, folder, ' first')}")
    check_fresh(cfg, folder, record)
    made = record["outputs"].get(name)
    whole = made and path.exists() and path.stat().st_size == made["bytes"]
    if not whole or (made["bytes"] <= 64 * 2**20 and digest(path) != made):
        raise UserError(f"{path} is missing or damaged: {remedy(cfg, folder, ' --force')}")
    return path


def recorded(cfg: Stage, key: str) -> tuple[Path, dict | None, str | None]:
    """Run folder, record and sha256 of an artifact given by its path relative to the study's folder."""
    place, name = re.fullmatch(r"(.+?/seed\d+)/(.+)", key).groups()
    record = record_of(cfg, cfg.source / place)
    return cfg.source / place, record, record and record["outputs"].get(name, {}).get("sha256")


def check_fresh(cfg: Stage, folder: Path, record: dict):
    """UserError if an input of this run, or of a run before it, has changed; one that was deleted is no matter."""
    for key, sha in record["inputs"].items():
        earlier, before, now = recorded(cfg, key)
        if before:
            check_fresh(cfg, earlier, before)
            if now != sha:
                raise UserError(f"{folder} is stale, its input {key} changed: {remedy(cfg, folder, ' --force')}")


class Run:
    """One run folder: begun, gone on with, or found finished. Other settings or inputs than its own are an error."""

    def __init__(self, cfg: Stage, stage: str, inputs: dict[str, Path] = {}, method: str | None = None):
        self.cfg, self.dir = cfg, run_folder(cfg.own, stage, method, cfg.seed)
        self.began, self.minutes_before, self.logged, self.columns = time.monotonic(), 0.0, 0, []
        words = [re.sub(r"(^|=)[/~].*/(?=.)", r"\1", word) for word in sys.argv]  # absolute paths lose their folder
        settings = {name: value for name, value in asdict(cfg).items()
                    if name == "seed" or not hasattr(Stage, name) and name not in cfg.free}
        keys = (path.relative_to(cfg.source).as_posix() for path in inputs.values())
        self.record = {
            "command": " ".join(["python", Path(words[0]).name, *words[1:]]),
            "versions": {"python": sys.version.split()[0]}
            | {name: version(name) for name in ("torch", "numpy", "pymunk", "gymnasium", "opencv-python-headless", "clarabel")},
            "settings": json.loads(json.dumps(settings, default=str)),
            "inputs": {key: recorded(cfg, key)[2] for key in keys},
        }
        if cfg.force and self.dir.exists():
            shutil.rmtree(self.dir)
        self.dir.mkdir(parents=True, exist_ok=True)
        before = record_of(cfg, self.dir) or {**self.record, "outputs": {}, "finished": False}
        self.compare(before)
        self.record, self.finished = before, before["finished"]
        save_json(self.dir / "config.json", self.record)

    def compare(self, before: dict):
        for part in ("settings", "inputs"):
            old, new = before[part], self.record[part]
            if other := [key for key in {**old, **new} if old.get(key) != new.get(key)]:
                words = [f"{key} {old.get(key)} -> {new.get(key)}" if part == "settings" else key for key in other]
                raise UserError(f"{self.dir}: {part} changed since it was begun ({', '.join(words)}): "
                                "use --force, or another --out")

    def skip(self) -> bool:
        """True, said aloud, if there is nothing to do."""
        if self.finished:
            print(f"{self.dir}: finished already (--force redoes it)")
        return self.finished

    def log(self, **row):
        """Appends a row to metrics.csv. The first row names the columns; a later one may leave some empty."""
        self.columns = self.columns or list(row)
        with open(self.dir / "metrics.csv", "a" if self.logged else "w") as file:
            writer = csv.DictWriter(file, self.columns, lineterminator="\n")
            if not self.logged:
                writer.writeheader()
            writer.writerow({key: x if isinstance(x, (int, str)) else f"{float(x):.6g}" for key, x in row.items()})
        self.logged += 1

    def rows(self) -> list[dict]:
        """metrics.csv read back: floats, nan where empty, and strings."""
        path = self.dir / "metrics.csv"
        rows = list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []
        for row in rows:
            for key, text in row.items():
                with contextlib.suppress(ValueError):
                    row[key] = float(text or "nan")
        return rows

    def save_resume(self, state: dict):
        """Writes a resume point: tensors, plain numbers and strings in lists and dicts (no numpy)."""
        file = io.BytesIO()
        torch.save({"state": state, "rows": self.logged, "minutes": self.minutes()}, file)
        write_atomic(self.dir / "resume.pt", lambda temporary: temporary.write_bytes(file.getbuffer()))

    def load_resume(self) -> dict | None:
        """The last resume point, None to begin. Rows logged after it are dropped: they will be logged again."""
        path, metrics = self.dir / "resume.pt", self.dir / "metrics.csv"
        if not path.exists():
            return metrics.unlink(missing_ok=True)
        try:
            saved = torch.load(path, map_location="cpu", weights_only=True)
            self.logged, self.minutes_before = saved["rows"], saved["minutes"]
            lines = metrics.read_text().splitlines(keepends=True)[: 1 + self.logged] if self.logged else []
        except Exception:  # whatever torch meets in a damaged file
            raise UserError(f"{path} is damaged: delete it, or use --force, to begin again") from None
        self.columns = next(csv.reader(lines), [])
        if lines:
            write_atomic(metrics, lambda temporary: temporary.write_text("".join(lines)))
        return saved["state"]

    def minutes(self) -> float:
        """Minutes spent on this run, those before the last resume point included."""
        return self.minutes_before + (time.monotonic() - self.began) / 60

    def out_of_time(self) -> bool:
        return (time.monotonic() - _STARTED) / 60 >= self.cfg.max_minutes  # of the command, whatever it runs in turn

    def stop(self):
        print(f"{self.dir}: stopped after {self.minutes():.1f} minutes; the same command, without --force, goes on")

    def finish(self, outputs: list[str], **extra):
        """Records the artifacts, named relative to the folder, and marks the run finished."""
        self.record["outputs"] = {name: digest(self.dir / name) for name in outputs}
        self.record |= {"minutes": round(self.minutes(), 2), **extra, "finished": True}
        save_json(self.dir / "config.json", self.record)
        (self.dir / "resume.pt").unlink(missing_ok=True)
        self.finished = True


class Lines:
    """Passes tqdm's redrawn line on to stderr as a plain line, at most every 30 s."""

    last = time.monotonic()

    def write(self, text: str):
        if text.strip() and time.monotonic() - self.last >= 30:
            self.last = time.monotonic()
            print(text.strip(), file=sys.stderr, flush=True)


def bar(over, desc: str, **kw) -> tqdm:
    """A progress bar over an iterable, or over a number of steps told by update()."""
    log = {"file": Lines(), "ncols": 0, "mininterval": 5, "miniters": 1}
    kw |= {"dynamic_ncols": True} if sys.stderr.isatty() else log
    return tqdm(over if hasattr(over, "__iter__") else range(over), desc, **kw)
