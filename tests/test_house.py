"""What the pages say of the code and of its results, held against both."""
import ast
import json
import re
from pathlib import Path

import pytest

from common import tables

ROOT = Path(__file__).parent.parent
README, ROOMS, RESULTS = ((ROOT / name).read_text() for name in ("README.md", "common/README.md", "results/README.md"))
FILES = sorted([*ROOT.glob("0*.py"), *ROOT.glob("common/*.py"), *ROOT.glob("common/robot/*.py")])
FLOORS = {name.rstrip("/").removesuffix(".py"): int(floor) for floor, name in re.findall(r"^\| (\d) \| `([\w./]+)`", ROOMS, re.M)}


def names(path):
    """Every function, class, method and constant of a file, as the map writes them."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
        if isinstance(node, ast.Assign):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return found


def test_every_name_of_the_map_exists():
    entries = re.findall(r"`((?:common/)?(?:robot/)?[\w]+\.py):([\w.]+)`", README)
    assert len(entries) > 50
    for file, name in entries:
        assert name in names(ROOT / file), f"{file}:{name}"


@pytest.mark.parametrize("page", ["README.md", "common/README.md", "common/robot/README.md", "results/README.md"])
def test_every_link_and_file_that_a_page_names_is_there(page):
    text = (ROOT / page).read_text()
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert target.startswith("http") or (ROOT / page).parent.joinpath(target).exists(), target
    for target, anchor in re.findall(r"\]\(([^)#]*)#([\w-]+)\)", text):
        other = (ROOT / page).parent / target if target else ROOT / page
        headings = [re.sub(r"[^\w -]", "", line.lstrip("# ")).lower().replace(" ", "-")
                    for line in other.read_text().splitlines() if line.startswith("#")]
        assert anchor in headings, (target, anchor)
    for file in re.findall(r"`((?:common|tests)/[\w/]+\.py)", text):
        assert (ROOT / file).exists(), file


def test_a_room_imports_from_lower_floors_only():
    assert FLOORS.keys() == {path.stem for path in ROOT.glob("common/*.py")} - {"__init__"} | {"robot"}
    for path in FILES:
        if path.parent.name == "common" and path.stem != "__init__":
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom) and node.module.startswith("common"):
                    rooms = [alias.name for alias in node.names] if node.module == "common" else [node.module.split(".")[1]]
                    assert all(FLOORS[room] < FLOORS[path.stem] for room in rooms), (path.name, rooms)


def test_the_house_stays_small():
    lengths = {path: len(path.read_text().splitlines()) for path in FILES}
    assert max(lengths.values()) <= 300
    assert all(length <= 250 for path, length in lengths.items() if path.parent == ROOT)
    assert len(README.splitlines()) <= 180
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 60, (path.name, node.name)


def test_the_pages_have_the_numbers_of_the_published_results():
    results = json.loads((ROOT / "results/results.json").read_text())
    for table in tables.SECTIONS:
        assert table(results) in RESULTS, f"results/README.md: put the text of tables.{table.__name__} there"
    for method, rate in results["success_rate"].items():
        row = next(line for line in README.splitlines() if line.startswith(f"| `{method}` |"))
        assert f"| {rate['mean']:.1%} [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}] |".replace("%", " %") in row
