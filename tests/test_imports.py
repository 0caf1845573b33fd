"""Import rules between rooms: the table, compared with the sources' imports."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "cohdc_train"
NAME = PACKAGE.name

# Room -> the rooms it may import. A room is a file or a folder of the package.
ALLOWED: dict[str, set[str]] = {
    "__init__": set(),
    "__main__": {"cli"},
    "errors": set(),
    "files": {"errors"},
    "images": set(),
    "signature": set(),
    "types": set(),
    "masks": set(),
    "drawing": set(),
    "presets": {"errors"},
    "env": {"errors"},
    "contour": set(),
    "trajectory": {"errors"},
    "data": {"drawing", "images", "presets", "errors"},
    "synth": {"contour", "data", "drawing", "slam", "trajectory", "errors"},
    "models": set(),
    "metrics": {"models", "masks"},
    "train": {"data", "models", "metrics", "drawing", "signature", "presets", "errors"},
    "validation": {"train", "metrics", "data", "segmenter", "presets", "errors"},
    "exporter": {
        *("validation", "train", "models", "segmenter"),
        *("signature", "masks", "images", "errors"),
    },
    "bench": {
        *("validation", "train", "metrics", "data", "models", "exporter", "segmenter"),
        *("contour", "slam", "presets", "errors"),
    },
    "segmenter": {"signature", "masks", "presets", "errors"},
    "prediction": {"segmenter", "contour", "drawing", "images", "errors"},
    "slam": {"segmenter", "trajectory", "drawing", "presets", "errors"},
    "report": {"trajectory", "errors"},
    "cli": {"errors"},  # and any verb's module, by name inside the call
}
ALLOWED["demo"] = set(ALLOWED) - {"cli", "__main__"}
# Any room may use the name and version, array types, and whole-file writing, which imports errors.
FREE = {"__init__", "files", "types"}
WITHOUT_TORCH = (
    "slam",
    "segmenter",
    "prediction",
    "trajectory",
    "contour",
    "report",
    "env",
    "types",
    "drawing",
    "images",
    "masks",
    "cli",
)
TORCH = {
    "torch",
    "torchvision",
    "lightning",
    "pytorch_lightning",
    "kornia",
    "onnxscript",
    "torchmetrics",
}


def sources(package: Path) -> Iterator[tuple[str, str, Path]]:
    """List (room, dotted module inside the package, file) of every source."""
    for file in sorted(package.rglob("*.py")):
        parts = file.relative_to(package).with_suffix("").parts
        yield parts[0], ".".join(parts), file


def imported(file: Path, package: Path) -> Iterator[tuple[int, str]]:
    """List (line, absolute dotted name) of every import in a file.

    Relative imports are resolved. `from a import b` gives a.b, since b may be a module.
    """
    here = (package.name, *file.relative_to(package).with_suffix("").parts)
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(here[: len(here) - node.level]) if node.level else ""
            base = ".".join(part for part in (base, node.module or "") if part)
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def edges(package: Path) -> dict[str, set[tuple[str, str]]]:
    """Map each room to {(room or foreign package that it imports, place)}.

    Foreign packages are written with a leading `/`.
    """
    rooms = {room for room, _, _ in sources(package)}
    graph: dict[str, set[tuple[str, str]]] = {room: set() for room in rooms}
    for room, _, file in sources(package):
        if (
            room == "__init__"
        ):  # its public names are loaded when used; test_public_api.py shows that nothing else is
            continue
        for line, name in imported(file, package):
            first, *rest = name.split(".")
            place = f"{file.relative_to(package)}:{line}"
            if first != package.name:
                graph[room].add((f"/{first}", place))
                continue
            target = rest[0] if rest and rest[0] in rooms else "__init__"
            if target != room:
                graph[room].add((target, place))
    return graph


def faults(package: Path) -> list[str]:
    """List the imports that the table forbids, and the ways of torch-free rooms to torch."""
    graph = edges(package)
    found = [f"{room} is not in the table of rooms" for room in graph if room not in ALLOWED]
    for room, targets in graph.items():
        for target, place in sorted(targets):
            ours = not target.startswith("/")
            if ours and room in ALLOWED and target not in ALLOWED[room] | FREE:
                found.append(f"{place}: {room} may not import {target}")
    for room in WITHOUT_TORCH:
        if room in graph:
            found += [f"{room} reaches {way}" for way in ways_to_torch(graph, room)]
    return found


def ways_to_torch(graph: dict[str, set[tuple[str, str]]], start: str) -> list[str]:
    """List the chains of rooms from `start` to an import of torch or of what needs it."""
    ways, seen, queue = [], {start}, [(start, start)]
    while queue:
        room, way = queue.pop(0)
        for target, place in sorted(graph.get(room, ())):
            if target.startswith("/") and target[1:] in TORCH:
                ways.append(f"{target[1:]} by {way} ({place})")
            elif not target.startswith("/") and target not in seen:
                seen.add(target)
                queue.append((target, f"{way} -> {target}"))
    return ways


def test_rooms_import_only_what_the_table_allows() -> None:
    assert faults(PACKAGE) == []


def test_table_holds_no_cycle() -> None:
    """Rooms can be put in an order in which each imports earlier ones only."""
    placed: set[str] = set()
    while free := {room for room in ALLOWED if room not in placed and ALLOWED[room] <= placed}:
        placed |= free
    assert placed == set(ALLOWED)


def plant(folder: Path, files: dict[str, str]) -> Path:
    package = folder / NAME
    for name, text in files.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    return package


HOUSE = {
    "__init__.py": "",
    "errors.py": "",
    "slam/__init__.py": "",
    "slam/run.py": "import numpy\nfrom cohdc_train.errors import CohdcError\n",
    "train/module.py": "import torch\nfrom cohdc_train import __version__\n",
    "segmenter.py": "import onnxruntime\n",
}


@pytest.mark.parametrize(
    ("file", "text", "fault"),
    [
        (
            "slam/run.py",
            "import numpy\nimport torch\n",
            "slam reaches torch by slam (slam/run.py:2)",
        ),
        (
            "slam/run.py",
            "def f():\n    from torch.nn import Module\n",
            "slam reaches torch by slam (slam/run.py:2)",
        ),
        (
            "slam/run.py",
            "import kornia.geometry as g\n",
            "slam reaches kornia by slam (slam/run.py:1)",
        ),
        (
            "slam/run.py",
            "from cohdc_train.train.module import x\n",
            "slam/run.py:1: slam may not import train",
        ),
        (
            "slam/run.py",
            "from cohdc_train import train\n",
            "slam/run.py:1: slam may not import train",
        ),
        ("slam/run.py", "from ..train import module\n", "slam/run.py:1: slam may not import train"),
        (
            "slam/run.py",
            "import cohdc_train.train.module\n",
            "slam reaches torch by slam -> train (train/module.py:1)",
        ),
        (
            "slam/run.py",
            "from .. import train\n",
            "slam reaches torch by slam -> train (train/module.py:1)",
        ),
        ("masks.py", "import torch\n", "masks reaches torch by masks (masks.py:1)"),
        ("utils.py", "", "utils is not in the table of rooms"),
    ],
)
def test_planted_import_is_found(tmp_path: Path, file: str, text: str, fault: str) -> None:
    assert fault in faults(plant(tmp_path, {**HOUSE, file: text}))


def test_torch_is_found_through_another_room(tmp_path: Path) -> None:
    planted = {
        "slam/run.py": "from cohdc_train import segmenter\n",
        "segmenter.py": "from cohdc_train.masks import m\n",
    }
    found = faults(plant(tmp_path, {**HOUSE, **planted, "masks.py": "import torchvision\n"}))
    assert "slam reaches torchvision by slam -> segmenter -> masks (masks.py:1)" in found


def test_clean_house_has_no_fault(tmp_path: Path) -> None:
    assert faults(plant(tmp_path, HOUSE)) == []


# Rooms of slam in the order in which they build on each other: each may import those before it.
SLAM_ROOMS = [
    "config",
    "geometry",
    "features",
    "optimization",
    "mapping",
    "loop_closing",
    "frame",
    "io",
    "dynamics",
    "tracking",
    "system",
    "visualization",
    "runtime",
    "runner",
    "run",
]
# Earlier rooms that a room does not import.
SLAM_APART = {
    "frame": {"optimization", "mapping", "loop_closing"},
    "io": {"features", "optimization", "mapping", "loop_closing"},
    "dynamics": {"loop_closing"},
    "tracking": {"io", "loop_closing"},
    "visualization": {"loop_closing", "tracking", "system"},
    "runtime": {"loop_closing", "tracking", "system", "visualization"},
}


def slam_faults(folder: Path) -> list[str]:
    """List the imports between rooms of slam that go against their order."""
    found = []
    for file in sorted(folder.rglob("*.py")):
        room = file.relative_to(folder).with_suffix("").parts[0]
        if room == "__init__":
            continue
        if room not in SLAM_ROOMS:
            found.append(f"{room} is no room of slam")
            continue
        allowed = set(SLAM_ROOMS[: SLAM_ROOMS.index(room)]) - SLAM_APART.get(room, set()) | {room}
        for line, name in imported(file, folder.parent):
            parts = name.split(".")
            if parts[:2] == [NAME, "slam"] and parts[2] not in allowed:
                found.append(f"{file.relative_to(folder)}:{line}: {room} imports {parts[2]}")
    return found


def test_rooms_of_slam_import_in_one_direction() -> None:
    assert slam_faults(PACKAGE / "slam") == []


def test_import_against_the_order_of_slam_is_found(tmp_path: Path) -> None:
    room = tmp_path / NAME / "slam" / "mapping"
    room.mkdir(parents=True)
    (room / "map.py").write_text(
        f"from {NAME}.slam.tracking.tracker import Tracker\n", encoding="utf-8"
    )
    (fault,) = slam_faults(tmp_path / NAME / "slam")
    assert fault == "mapping/map.py:1: mapping imports tracking"


def test_table_allows_only_what_is_used() -> None:
    graph = edges(PACKAGE)
    used = {room: {target for target, _ in targets} for room, targets in graph.items()}
    unused = {room: allowed - used[room] for room, allowed in ALLOWED.items() if room != "demo"}
    assert {room: names for room, names in unused.items() if names} == {}
