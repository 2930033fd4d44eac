"""Files that are whole or not there, and a user's mistake told in one line."""
import fcntl
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

_locks = {}  # folder -> descriptor that holds its lock for this process


class UserError(Exception):
    """A user's mistake: one line, what is wrong and what to do."""


def make_folder(path: Path):
    """Makes a folder and those above it. Raises UserError where it cannot."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as failure:
        raise UserError(f"cannot make {path} ({failure.strerror}): choose another --out") from None


def claim(folder: Path):
    """Makes a run folder, and holds it for this process until it ends or the run is finished. UserError if another has it."""
    make_folder(folder)
    if folder.resolve() not in _locks:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"{folder}: another process is at work here; wait, or use another --seed or --out") from None
        _locks[folder.resolve()] = descriptor


def release(folder: Path):
    """Lets another process have the folder."""
    if folder.resolve() in _locks:
        os.close(_locks.pop(folder.resolve()))


def write_atomic(path: Path, write: Callable[[Path], object]):
    """Calls write with a temporary path beside `path`, of the same suffix, and renames the result to `path`."""
    make_folder(path.parent)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        write(temporary)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def save_json(path: Path, obj, indent: int | None = 2):
    """Writes JSON; arrays and tensors become lists, paths strings."""
    text = json.dumps(obj, indent=indent, default=lambda x: x.tolist() if hasattr(x, "tolist") else str(x))
    write_atomic(path, lambda temporary: temporary.write_text(text + "\n"))


def load_json(path: Path, advice: str):
    """JSON of a file, None where there is none.

    Raises UserError: it is damaged; the advice says what to do.
    """
    try:
        return json.loads(path.read_text()) if path.exists() else None
    except ValueError:
        raise UserError(f"{path} is damaged: {advice}") from None


def digest(path: Path) -> dict:
    """{"sha256", "bytes"} of a file."""
    with open(path, "rb") as file:
        return {"sha256": hashlib.file_digest(file, "sha256").hexdigest(), "bytes": path.stat().st_size}
