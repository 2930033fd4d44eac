"""Run folders: what a stage did and from what, where it stands, and what the earlier stages made.

<out>/<preset>/<stage>/[method/]seed<k>/ holds config.json (settings, versions, sha256 of inputs and outputs, finished or
not), metrics.csv, resume.pt while unfinished, and the artifacts.
"""
import contextlib
import csv
import io
import json
import re
import shutil
import sys
import time
from dataclasses import asdict, fields
from importlib.metadata import version
from pathlib import Path

import torch

from common import ranks
from common.command import Reader, Stage, flat
from common.files import UserError, claim, digest, load_json, release, save_json, write_atomic
from common.task import World

VERSIONS = ("torch", "numpy", "pymunk", "gymnasium", "opencv-python-headless", "clarabel")
_STARTED = time.monotonic()


class Missing(UserError):
    """What an earlier stage has not made, or not finished."""


class Mixed(UserError):
    """Artifacts that do not belong together."""


def run_folder(study: Path, stage: str, method: str | None = None, seed: int = 0) -> Path:
    """<study>/<stage>/[method/]seed<k>."""
    return study / stage / (method or "") / f"seed{seed}"


def seeds(roots: list[Path], stage: str, method: str | None = None) -> dict[int, Path]:
    """{k: run folder} of a stage and method in ascending order, each from the first root that has it."""
    found = {}
    for root in reversed(roots):
        found |= {int(path.name[4:]): path for path in run_folder(root, stage, method).parent.glob("seed*")
                  if re.fullmatch(r"seed(0|[1-9]\d*)", path.name)}
    return dict(sorted(found.items()))


def remedy(cfg: Stage, folder: Path, extra: str = "") -> str:
    """What to do about a run folder: run python 0N_name.py preset [--method m] [--seed k] [--out root]."""
    if not folder.is_relative_to(cfg.own):
        return f"--weights {cfg.weights} is not, or no longer, the folder of a finished study"
    stage, *method, seed = folder.relative_to(cfg.own).parts
    options = {"method": method[0] if method else "", "seed": int(seed[4:]), "out": cfg.out if cfg.out != Stage.out else "",
               "weights": cfg.weights if stage[:2] in ("03", "04") else ""}
    words = "".join(f" --{name} {value}" for name, value in options.items() if value)
    return f"run python {stage}.py {cfg.preset}{words}{extra}"


def record_of(cfg: Stage, folder: Path) -> dict | None:
    """config.json of a run folder, None if there is none."""
    return load_json(folder / "config.json", remedy(cfg, folder, " --force"))


def find(cfg: Stage, stage: str, name: str, method: str | None = None, seed: int = 0) -> Path:
    """Path of an earlier stage's artifact, in the first of cfg.roots that has it: finished, whole, and not stale.

    Above 64 MiB only its size is looked at. Raises Missing: it was not made, or its run is not finished; UserError: it is
    damaged or stale.
    """
    places = [run_folder(root, stage, method, seed) for root in cfg.roots]
    records = {folder: record_of(cfg, folder) for folder in places}
    finished = [folder for folder in places if records[folder] and records[folder]["finished"]]
    there, own = [folder for folder in finished if (folder / name).exists()], places[-1]
    if not there and own not in finished:
        if cfg.preset == "pretrained" and cfg.weights:  # a preset without stages that could be run
            raise Missing(f"{places[0] / name} is missing: {remedy(cfg, places[0])}")
        state = ("unfinished" if records[own] else "missing") + f" (and not in --weights {cfg.weights})" * bool(cfg.weights)
        hint = ", or give the --weights of a finished study" * (isinstance(cfg, Reader) and not cfg.weights)
        raise Missing(f"{own / name} is {state}: {remedy(cfg, own, ' first')}{hint}")
    path = (there or [own])[0] / name
    record = records[path.parent]
    check_lineage(cfg, path.parent, record["inputs"])
    made = record["outputs"].get(name, {"bytes": -1})
    whole = path.exists() and path.stat().st_size == made["bytes"]
    if not whole or (made["bytes"] <= 64 * 2**20 and digest(path) != made):
        raise UserError(f"{path} is missing or damaged: {remedy(cfg, path.parent, ' --force')}")
    return path


def hashes_of(cfg: Stage, paths) -> dict[str, str]:
    """{path below its root: recorded sha256} of artifacts."""
    roots = {path: next(root for root in cfg.roots if path.is_relative_to(root)) for path in paths}
    return {path.relative_to(root).as_posix(): record_of(cfg, path.parent)["outputs"][path.name]["sha256"]
            for path, root in roots.items()}


def check_lineage(cfg: Stage, folder: Path, inputs: dict[str, str]):
    """Follows the inputs {key: sha256} of a run back through the records of cfg.roots; what was deleted is no matter.

    Raises Mixed: they were made from different runs of one folder, such as two pi_priv; UserError: one of them, or of what
    it was made from, is another now.
    """
    known, todo = {}, [(folder, key, sha) for key, sha in inputs.items()]
    while todo:
        for user, key, sha in todo:
            place, _, name = key.rpartition("/")
            known.setdefault(place, {}).setdefault(name, set()).add(sha)
        users, todo = {key.rpartition("/")[0]: (user, key) for user, key, _ in reversed(todo)}, []
        for place, (user, key) in users.items():
            records = {root / place: record for root in cfg.roots if (record := record_of(cfg, root / place))}
            # of each record: which of the artifacts that are known of this place it has as they were
            fits = {path: [{record["outputs"].get(name, {}).get("sha256")} >= shas for name, shas in known[place].items()]
                    for path, record in records.items()}
            if found := next((path for path, matches in fits.items() if all(matches)), None):
                todo += [(found, key, sha) for key, sha in records[found]["inputs"].items()]
            elif records and all(map(any, zip(*fits.values()))) or max(map(len, known[place].values())) > 1:
                raise Mixed(f"{folder} would be made from two different {place}: call without --weights, or with another --out")
            elif records:
                raise UserError(f"{user} is stale, its input {key} changed: {remedy(cfg, user, ' --force')}")


def world_of(cfg: Stage, paths) -> World:
    """The world that artifacts were made in; of none, that of the config. UserError: of two."""
    worlds = {}
    for path in paths:
        record = record_of(cfg, path.parent)
        worlds.setdefault(World.of(record["settings"] | record.get("world", {})), path)
    if len(worlds) > 1:
        (one, here), (other, there) = [*worlds.items()][:2]
        words = [f"{name} {x} and {asdict(other)[name]}" for name, x in asdict(one).items() if x != asdict(other)[name]]
        raise UserError(f"{here} and {there} are of two worlds: {', '.join(words)}")
    return next(iter(worlds), getattr(cfg, "world", World()))


def as_json(value):
    """A setting as config.json holds it."""
    return json.loads(json.dumps(value, default=str))


class Run:
    """One run folder: begun, gone on with, or found finished. Other settings or inputs than its own are an error.

    Args:
        inputs: paths of what the run reads, by any name.
        reads: names of the settings that it reads; none: all of the script's own. No other is recorded or compared.
        grows: inputs may come and change: then a finished run is open again.
    Attribute world: task.World, that of the inputs.
    """

    def __init__(self, cfg: Stage, stage: str, inputs: dict[str, Path] = {}, method=None, reads=None, grows=False):
        self.cfg, self.dir = cfg, run_folder(cfg.own, stage, method, cfg.seed)
        self.began, self.minutes_before, self.logged, self.columns = time.monotonic(), 0.0, 0, []
        words = [re.sub(r"(^|=)[/~].*/(?=.)", r"\1", word) for word in sys.argv]  # absolute paths lose their folder
        shared = {field.name for field in fields(Stage)} - {"seed"} | {*cfg.free}
        self.settings = [(field, as_json(value)) for field, value in flat(cfg) if field.name not in shared and (
            reads is None or field.name in {"seed", *reads})]
        self.record = {
            "command": " ".join(["torchrun" if ranks.COUNT > 1 else "python", Path(words[0]).name, *words[1:]]),
            "processes": ranks.COUNT,
            "versions": {"python": sys.version.split()[0]} | {name: version(name) for name in VERSIONS},
            "settings": {field.name: value for field, value in self.settings},
            "inputs": hashes_of(cfg, inputs.values()),
        }
        if any(others != self.record["inputs"] for others in ranks.gather(self.record["inputs"])):
            raise UserError(f"{self.dir}: the processes find different inputs: give all of them the same folders")
        check_lineage(cfg, self.dir, self.record["inputs"])
        self.world = world_of(cfg, inputs.values())
        if inputs:  # the settings of a stage that reads nothing have its world
            self.record["world"] = as_json(asdict(self.world))
        self.record = self.begin(grows)
        self.finished = self.record["finished"]
        for root in cfg.roots if cfg.weights and not self.finished else ():
            folders = {path.parent.relative_to(root).as_posix() for path in inputs.values() if path.is_relative_to(root)}
            if folders:
                print(f"from {root}: {', '.join(sorted(folders))}")

    @ranks.lead
    def begin(self, grows: bool) -> dict:
        """Claims the folder; the record of before, or a new one. UserError: another run has it, or it was begun otherwise."""
        claim(self.dir)
        if self.cfg.force:
            for path in self.dir.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        before = record_of(self.cfg, self.dir) or {**self.record, "outputs": {}, "finished": False}
        self.compare(before, grows)
        if before["finished"] and before["inputs"] == self.record["inputs"]:
            return before
        now = self.record | {"settings": before["settings"]} if grows else {}
        save_json(self.dir / "config.json", record := before | now | {"finished": False})
        return record

    def compare(self, before: dict, grows: bool):
        """UserError where the run was begun otherwise; a setting that it does not know has the value it had then."""
        old, new, changed = before["settings"], self.record["settings"], {"settings": [], "inputs": []}
        for field, _ in self.settings:
            past = old.get(field.metadata.get("was"), as_json(field.metadata.get("before", field.default)))
            if (past := old.get(field.name, past)) != new[field.name]:
                changed["settings"].append(f"{field.name} {past} -> {new[field.name]}")
        known = {name for field, _ in flat(self.cfg) for name in (field.name, field.metadata.get("was"))}
        changed["settings"] += [f"{name} is not known here" for name in old if name not in known]
        if not grows:
            old, new = before["inputs"], self.record["inputs"]
            changed["inputs"] = [key for key in {**old, **new} if old.get(key) != new.get(key)]
        for part, words in changed.items():
            if words:
                advice = "use --force, or another --out" + ", or the --weights of before" * (part == "inputs")
                raise UserError(f"{self.dir}: {part} changed since it was begun ({', '.join(words)}): {advice}")

    def skip(self) -> bool:
        """True, said aloud, if there is nothing to do."""
        if self.finished:
            print(f"{self.dir}: finished already (--force redoes it)")
            release(self.dir)
        return self.finished

    def log(self, **row):
        """Appends a row to metrics.csv. The first row names the columns; a later one may leave some empty, and adds none."""
        if ranks.RANK:
            return
        self.columns = self.columns or list(row)
        with open(self.dir / "metrics.csv", "a" if self.logged else "w") as file:
            writer = csv.DictWriter(file, self.columns, extrasaction="ignore", lineterminator="\n")
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

    @ranks.lead
    def save_resume(self, state: dict):
        """Writes a resume point: tensors, plain numbers and strings in lists and dicts (no numpy)."""
        file = io.BytesIO()
        torch.save({"state": state, "rows": self.logged, "minutes": self.minutes(), "processes": ranks.COUNT}, file)
        write_atomic(self.dir / "resume.pt", lambda temporary: temporary.write_bytes(file.getbuffer()))

    @ranks.lead
    def load_resume(self) -> dict | None:
        """The last resume point, None to begin. Rows logged after it are dropped: they will be logged again.

        Raises UserError: it is damaged, or was made with another number of processes.
        """
        path, metrics = self.dir / "resume.pt", self.dir / "metrics.csv"
        if not path.exists():
            return metrics.unlink(missing_ok=True)
        try:
            saved = torch.load(path, map_location="cpu", weights_only=True)
            self.logged, self.minutes_before = saved["rows"], saved["minutes"]
            lines = metrics.read_text().splitlines(keepends=True)[: 1 + self.logged] if self.logged else []
        except Exception:  # whatever torch meets in a damaged file
            raise UserError(f"{path} is damaged: delete it, or use --force, to begin again") from None
        if (count := saved.get("processes", 1)) != ranks.COUNT:
            raise UserError(f"{self.dir} was begun with {count} processes, not {ranks.COUNT}: start as many, or use --force")
        self.columns = next(csv.reader(lines), [])
        if lines:
            write_atomic(metrics, lambda temporary: temporary.write_text("".join(lines)))
        return saved["state"]

    def minutes(self) -> float:
        """Minutes spent on this run, those before the last resume point included."""
        return self.minutes_before + (time.monotonic() - self.began) / 60

    @ranks.lead
    def out_of_time(self) -> bool:
        return (time.monotonic() - _STARTED) / 60 >= self.cfg.max_minutes  # of the command, whatever it runs in turn

    def stop(self):
        print(f"{self.dir}: stopped after {self.minutes():.1f} minutes in all; the same command, without --force, goes on")

    def finish(self, outputs: list[str], **extra):
        """Records the artifacts, named relative to the folder, and marks the run finished. On rank 0 alone."""
        self.record["outputs"] = {name: digest(self.dir / name) for name in outputs}
        self.record |= {"minutes": round(self.minutes(), 2), "processes": ranks.COUNT, **extra, "finished": True}
        save_json(self.dir / "config.json", self.record)
        (self.dir / "resume.pt").unlink(missing_ok=True)
        self.finished = True
        release(self.dir)
