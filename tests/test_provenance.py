"""What a run records and reads: settings that age, weights from elsewhere, one process a folder."""
import importlib
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from conftest import Worldly

from common import command, runs
from common.command import setting
from common.files import UserError, save_json
from common.task import C_060, World
from common.weights import save_tensors

ROOT = Path(__file__).parent.parent
PUBLISHED = [path.parent.relative_to(ROOT / "pretrained") for path in sorted((ROOT / "pretrained").rglob("config.json"))]


@dataclass
class Config(command.Reader):
    rate: float = setting(1e-3, was="speed")
    starts: str = setting("box", before="inner")
    width: int = 8
    depth: int = 2


@pytest.fixture
def config(tmp_path):
    return lambda **kw: Config(preset="quick", out=tmp_path / "runs", **kw)


def make(cfg, stage, value, inputs={}, **kw):
    """A finished stage's artifact."""
    run = runs.Run(cfg, stage, inputs, **kw)
    save_tensors(run.dir / "net.st", {}, value=value)
    run.finish(["net.st"])
    return run.dir / "net.st"


def record(path, **changes):
    """Rewrites the settings in a run's config.json; None takes one away."""
    written = json.loads((path.parent / "config.json").read_text())
    written["settings"] = {k: v for k, v in (written["settings"] | changes).items() if v is not None}
    save_json(path.parent / "config.json", written)


# Settings


def test_a_run_records_and_compares_what_it_reads_and_nothing_else(config):
    path = make(config(), "01_a", 1, reads={"width"})
    assert json.loads((path.parent / "config.json").read_text())["settings"] == {"seed": 0, "width": 8}
    assert runs.Run(config(rate=1.0, depth=9), "01_a", reads={"width"}).finished
    with pytest.raises(UserError, match="width 8 -> 9"):
        runs.Run(config(width=9), "01_a", reads={"width"})


def test_a_field_that_a_run_does_not_know_is_what_the_code_did_then(config):
    record(make(config(starts="inner"), "01_a", 1), starts=None, depth=None)
    assert runs.Run(config(starts="inner"), "01_a").finished
    with pytest.raises(UserError, match="starts inner -> box"):
        runs.Run(config(), "01_a")
    with pytest.raises(UserError, match="depth 2 -> 3"):
        runs.Run(config(starts="inner", depth=3), "01_a")


def test_a_renamed_field_is_read_under_its_old_name(config):
    record(make(config(rate=0.5), "01_a", 1), rate=None, speed=0.5)
    assert runs.Run(config(rate=0.5), "01_a").finished
    with pytest.raises(UserError, match="rate 0.5 -> 0.001"):
        runs.Run(config(), "01_a")


def test_a_setting_that_the_code_does_not_know_is_told(config):
    record(make(config(), "01_a", 1), world="mars")
    with pytest.raises(UserError, match="world is not known here"):
        runs.Run(config(), "01_a")


@pytest.mark.parametrize("folder", PUBLISHED, ids=str)
def test_every_published_run_has_the_settings_of_its_preset(folder, tmp_path):
    """Those that it does not know, or by other names, included."""
    shutil.copytree(ROOT / "pretrained", tmp_path / "laptop")
    stage, *method, seed = folder.parts
    module = importlib.import_module(stage)
    options = ["--method", *method] * bool(method) + ["--seed", seed[4:], "--out", str(tmp_path)]
    cfg, reads = command.parse(module.Config, module.PRESETS, "", ["laptop", *options]), None
    if stage.startswith("04"):
        cfg = module.with_sizes(cfg)
    written = runs.record_of(cfg, tmp_path / "laptop" / folder)
    if method:
        reads = module.settings_of(cfg) | written["settings"].keys()  # what was read once is compared too
    run = runs.Run(cfg, stage, {}, method[0] if method else None, reads, grows=True)  # whatever its inputs
    assert run.record["settings"] == written["settings"]


# Worlds


def test_a_run_has_the_world_of_its_inputs(config, tmp_path):
    world = World(starts="centre", support=(0.2, 0.4), box=(0.14, 0.10, 0.07), mass=(1.0, 2.0))
    first = make(Worldly(preset="quick", out=tmp_path / "runs", world=world), "01_a", 1)
    settings = json.loads((first.parent / "config.json").read_text())["settings"]
    assert settings.keys() == {"seed", *vars(world)} and (settings["starts"], settings["support"]) == ("centre", [0.2, 0.4])
    second = make(config(), "02_b", 2, {"a": first})
    assert runs.Run(config(), "03_c", {"b": second}).world == world
    assert runs.Run(Worldly(preset="quick", out=tmp_path), "01_a").world == World()


def test_inputs_of_two_worlds_are_one_line(config, tmp_path):
    cfg = Worldly(preset="quick", out=tmp_path / "runs")
    one, other = make(cfg, "01_a", 1), make(replace(cfg, world=World(starts="inner")), "01_b", 1)
    with pytest.raises(UserError, match=r"01_a/.* and .*01_b/.* are of two worlds: starts box and inner$"):
        runs.Run(config(), "02_c", {"a": one, "b": other})


def test_a_run_of_before_the_world_is_known_by_its_world(config, tmp_path):
    cfg = Worldly(preset="quick", out=tmp_path / "runs")
    path = make(cfg, "01_a", 1)
    record(path, starts=None, support=None, support_offset=None, time_limit=None)
    old = runs.Run(config(), "02_b", {"a": path}).world
    assert old == World("inner", support=C_060, support_offset=(0.0, 0.0)) and old.dynamics["limit_surface_c"] == (0.060, 0.060)
    with pytest.raises(UserError, match="starts inner -> box, support "):
        runs.Run(cfg, "01_a")


@pytest.mark.parametrize("folder", PUBLISHED, ids=str)
def test_published_nets_are_of_the_world_of_today(folder):
    record = json.loads((ROOT / "pretrained" / folder / "config.json").read_text())
    today = importlib.import_module("01_train_privileged").PRESETS["laptop"]["world"]
    assert World.of(record["settings"] | record.get("world", {})) == today


# Weights from elsewhere


def test_an_artifact_comes_from_the_weights_else_from_the_own_study(config, tmp_path, capsys):
    there = Config(preset="there", out=tmp_path)
    published, both = make(there, "01_a", 1), config(weights=tmp_path / "there")
    own = make(config(), "02_b", 2, {"a": make(config(), "01_a", 3)})
    assert runs.find(both, "01_a", "net.st") == published
    assert runs.find(both, "02_b", "net.st") == runs.find(config(), "02_b", "net.st") == own
    assert runs.Run(both, "03_c", {"b": own}).record["inputs"].keys() == {"02_b/seed0/net.st"}
    with pytest.raises(runs.Mixed, match="04_d/seed0 would be made from two different 01_a/seed0: call without --weights"):
        runs.Run(both, "04_d", {"a": published, "b": own})  # which was made from the own 01_a
    shutil.rmtree(own.parent)
    own = make(both, "02_b", 2, {"a": published})
    assert f"from {tmp_path / 'there'}: 01_a/seed0" in capsys.readouterr().out
    run = runs.Run(both, "04_d", {"a": published, "b": own})
    assert run.record["inputs"].keys() == {"01_a/seed0/net.st", "02_b/seed0/net.st"}
    assert runs.seeds(both.roots, "02_b") == {0: own.parent}
    with pytest.raises(UserError, match="02_b/seed0 is stale, its input 01_a/seed0/net.st"):
        runs.find(config(), "02_b", "net.st")
    with pytest.raises(UserError, match="inputs changed .*or the --weights of before"):
        runs.Run(config(), "04_d")


def test_a_folder_without_runs_is_no_weights(tmp_path):
    (tmp_path / "0_empty").mkdir()
    with pytest.raises(UserError, match="--weights .*: no run is in there"):
        command.parse(Config, {"quick": {}}, "", ["--weights", str(tmp_path)])


def test_what_is_not_published_is_one_line(config, tmp_path):
    there = make(Config(preset="there", out=tmp_path), "01_a", 1)
    there.unlink()
    both = config(weights=tmp_path / "there")
    words = r"runs/quick/01_a/seed0/net.st is missing \(and not in --weights .*there\): run python 01_a.py quick --out .* first"
    with pytest.raises(runs.Missing, match=words):
        runs.find(both, "01_a", "net.st")


def test_a_training_set_that_is_not_published_is_named():
    script = [sys.executable, ROOT / "03_train_estimator.py", "laptop", "--out", "nowhere", "--weights", ROOT / "pretrained"]
    end = subprocess.run(script, capture_output=True, text=True, cwd=ROOT)
    assert end.returncode == 2 and end.stderr.count("\n") == 1 and not (ROOT / "nowhere").exists()
    assert "train_states.npy is missing (and not in --weights" in end.stderr
    assert "run python 02_collect.py laptop --out nowhere first" in end.stderr


# Folders


def test_a_second_process_touches_nothing(config):
    run = runs.Run(config(), "01_a")
    before = (run.dir / "config.json").stat().st_mtime_ns
    code = f"""if True:
        import sys
        sys.path[:0] = [{str(ROOT)!r}, {str(Path(__file__).parent)!r}]
        from pathlib import Path
        from common import runs
        from test_provenance import Config
        try:
            runs.Run(Config(preset="quick", out=Path({str(run.cfg.out)!r}), force=True), "01_a")
        except runs.UserError as mistake:
            print(mistake)
    """
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "01_a/seed0: another process is at work here" in told.stdout and not told.stderr
    assert (run.dir / "config.json").stat().st_mtime_ns == before
    run.finish([])
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not told.stdout and not told.stderr  # a finished run is free again


def test_a_copy_of_a_run_folder_is_no_seed(config):
    paths = [make(config(seed=k), "01_a", k) for k in (0, 10, 2)]
    shutil.copytree(paths[0].parent, paths[0].parent.with_name("seed0_old"))
    for name in ("seeds", "seed01"):
        paths[0].parent.with_name(name).mkdir()
    assert list(runs.seeds([config().own], "01_a")) == [0, 2, 10]


@pytest.mark.parametrize("out", ["/proc/nothing", "/dev/null/x"])
def test_an_out_that_cannot_be_made_is_one_line(out):
    with pytest.raises(UserError, match=f"cannot make {out}.*another --out"):
        runs.Run(Config(preset="quick", out=Path(out)), "01_a")
