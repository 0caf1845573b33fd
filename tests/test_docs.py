"""The pages of docs/: their commands parse, their blocks run on small data, their links lead on."""

import json
import re
import shutil
from pathlib import Path

import coco_toys
import cv2
import foreign_toys
import numpy as np
import option_reference
import pytest
from doc_blocks import (
    DOCS,
    ROOT,
    Block,
    blocks,
    check,
    check_fit,
    commands,
    split_command,
)
from plane_world import write_sequence
from test_segmenter_foreign import candidate, columns, yolo

from cohdc_train import signature
from cohdc_train.cli import COMMANDS, main
from cohdc_train.presets import model_path

GENERATED = ("reference/options", "reference/python", "reference/person", "_build")
HISTORY = ("results", "log")  # what was run once, under the names of its day
PAGES = sorted(
    page.relative_to(DOCS)
    for page in DOCS.rglob("*.md")
    if not page.relative_to(DOCS).as_posix().startswith(GENERATED)
)
GUIDES = [page for page in PAGES if page.parts[0] not in HISTORY]
SLOW_VERBS = ("fit", "validate", "export")
# What makes a user's command small enough for a test; the command itself is the page's.
SMALL = {
    "fit": [
        *("--trainer.accelerator=cpu", "--trainer.precision=32-true"),
        *("--data.canvas=[96,128]", "--data.batch_size=2", "--data.workers=0"),
    ],
    "validate": ["--workers", "0"],
}


# ---- Commands


def command_lines(pages: list[Path]) -> list[tuple[str, ...]]:
    found = (commands((DOCS / page).read_text(encoding="utf-8")) for page in pages)
    return sorted({tuple(words) for page in found for words in page if "FILE" not in words})


# The recipes add what their commands need; test_recipes.py runs those.
GUIDE_COMMANDS = command_lines([page for page in GUIDES if page.parts[0] != "recipes"])


@pytest.mark.parametrize("words", [w for w in GUIDE_COMMANDS if w[0] != "fit"], ids=" ".join)
def test_command_of_a_guide_parses(words: tuple[str, ...]) -> None:
    assert check(list(words)) == 0


@pytest.mark.parametrize("words", [w for w in GUIDE_COMMANDS if w[0] == "fit"], ids=" ".join)
def test_fit_command_of_a_guide_parses(words: tuple[str, ...]) -> None:
    assert check_fit(list(words[1:])) == 0


def known_options() -> set[str]:
    """Return every option of every verb."""
    known = {"--help", "--version", "--no"}
    parsers = [option_reference.parser_of(verb) for verb in COMMANDS]
    for parser in [*parsers]:
        parsers += option_reference.subcommands(parser).values()
    for parser in parsers:
        # A group's own option takes a file, and is no option of a user.
        single = [a for a in parser._actions if type(a).__name__ != "_ActionConfigLoad"]
        known |= {name for action in single for name in action.option_strings}
    return known


# Options of other programs that pages speak of.
OTHER_PROGRAMS = {
    *("--master_addr", "--master_port", "--nnodes", "--node_rank", "--nproc_per_node"),
    *("--ntasks-per-node", "--nodes", "--signal", "--shm-size", "--user", "--platform"),
}


def test_every_option_that_a_guide_names_exists() -> None:
    known = known_options()
    unknown = []
    for page in GUIDES:
        prose = re.sub(r"```.*?```", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
        for code in re.findall(r"`([^`]+)`", prose):
            for option in re.findall(r"(?<![\w-])--[a-zA-Z][\w.-]*", code):
                name = option.rstrip(".").replace("-", "_").replace("__", "--", 1)
                is_group = any(
                    other.startswith(f"{name}.") or name.startswith(f"{other}.") for other in known
                )
                if not is_group and name not in known and option not in OTHER_PROGRAMS:
                    unknown.append(f"{page}: {option}")
    assert unknown == []


# ---- Blocks that run


def is_run(block: Block) -> bool:
    return block.marker.split(":")[0] == "run"


def is_slow(page: Path) -> bool:
    return any(block.marker == "run: slow" for block in blocks(DOCS / page))


RUN_PAGES = [page for page in GUIDES if any(is_run(block) for block in blocks(DOCS / page))]
SLOW = pytest.mark.slow


def people(folder: Path) -> None:
    """Write a COCO-format folder whose one class keeps the heads of the shipped network."""
    coco_toys.folder(folder)
    for file in folder.glob("*.json"):
        content = json.loads(file.read_text())
        content["categories"] = [c for c in content["categories"] if c["name"] == "person"]
        kept = {category["id"] for category in content["categories"]}
        content["annotations"] = [a for a in content["annotations"] if a["category_id"] in kept]
        file.write_text(json.dumps(content))


def photographs(folder: Path) -> None:
    """Write the same images and people as labelme files."""
    people(folder)
    for file in list(folder.glob("instances_*.json")):
        content = json.loads(file.read_text())
        for image, row in zip(content["images"], content["annotations"], strict=True):
            (polygon,) = row["segmentation"]
            path = folder / image["file_name"]
            shutil.copy(folder / "images" / image["file_name"], path)
            shapes = [foreign_toys.shape("person", "polygon", polygon)]
            foreign_toys.labelme_file(path.with_suffix(".json"), shapes)
        file.unlink()
    shutil.rmtree(folder / "images")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with everything that the guides take for granted, small."""
    folder = tmp_path_factory.mktemp("world")
    people(folder / "DATA")
    photographs(folder / "photos")
    (folder / "new_photos").mkdir()
    for image in (folder / "photos").glob("*.png"):
        shutil.copy(image, folder / "new_photos")
    cv2.imwrite(str(folder / "photo.jpg"), np.full((48, 64, 3), 90, np.uint8))
    write_sequence(folder / "walk", 8, with_passer_by=True)
    shutil.copy(folder / "walk" / "groundtruth.txt", folder / "estimate.txt")
    yolo(folder / "yolo-seg.onnx", columns(candidate([30, 20, 40, 24], 0, 0.9, 0)))
    (folder / "model.onnx").symlink_to(model_path("person"))
    return folder


@pytest.fixture
def copy_of_world(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "here"
    shutil.copytree(world, folder, symlinks=True)
    monkeypatch.chdir(folder)
    return folder


def run_shell(text: str) -> None:
    """Run the `cohdc` commands of a block as they stand, with options that make them small."""
    for line in text.replace("\\\n", " ").splitlines():
        words = split_command(line)
        assert words, f"not a command of cohdc: {line}"
        if words[1:] == ["--help"]:
            assert check(words) == 0
            continue
        if words[:2] == ["data", "doctor"] and "--fix" not in words:
            assert main(words) in (0, 1)  # noise has faults
            continue
        more = ["--trainer.max_steps=2"] if words[0] == "fit" and "--minutes" in words else []
        assert main([*words, *SMALL.get(words[0], []), *more]) == 0, line


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=SLOW if is_slow(p) else (), id=str(p)) for p in RUN_PAGES],
)
def test_blocks_of_a_page_run_in_their_order(page: Path, copy_of_world: Path) -> None:
    run = [block for block in blocks(DOCS / page) if is_run(block)]
    if any("photos DATA" in block.text for block in run):  # the page makes the folder itself
        shutil.rmtree("DATA")
    for block in run:
        if block.language == "python":
            exec(compile(block.text, str(page), "exec"), {"__name__": "__main__"})
        else:
            run_shell(block.text)


def test_pages_with_trainings_are_marked_slow() -> None:
    unmarked = []
    for page in RUN_PAGES:
        for block in blocks(DOCS / page):
            verbs = {words[0] for words in commands(f"```sh\n{block.text}```")}
            if is_run(block) and block.marker != "run: slow" and verbs & set(SLOW_VERBS):
                unmarked.append(str(page))
    assert unmarked == []


# ---- Pages


def test_links_of_pages_lead_to_files() -> None:
    broken = []
    for page in PAGES:
        text = re.sub(r"```.*?```", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
        for link in re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", text):
            target = (DOCS / page).parent / link
            generated = target.resolve().is_relative_to(DOCS / "reference")
            if not generated and not target.exists():
                broken.append(f"{page}: {link}")
    assert broken == []


def test_contract_page_names_every_tensor_and_key() -> None:
    text = (DOCS / "reference" / "onnx.md").read_text(encoding="utf-8")
    names = (signature.INPUT, *signature.OUTPUTS, *signature.METADATA_KEYS)
    assert [name for name in names if f"`{name}`" not in text] == []
    assert f"version of the contract, `{signature.CONTRACT_VERSION}`" in text


def test_option_pages_hold_every_option_of_every_verb() -> None:
    for verb in COMMANDS:
        text = option_reference.verb_page(verb)
        parser = option_reference.parser_of(verb)
        for member in option_reference.subcommands(parser).values() or [parser]:
            shown = [a for g in member._action_groups for a in option_reference.options(g)]
            names = [(a.option_strings or [a.dest.upper()])[0] for a in shown]
            assert [name for name in names if f"`{name}`" not in text] == []


def test_every_results_page_is_in_their_index() -> None:
    folder = DOCS / "results"
    index = (folder / "index.md").read_text(encoding="utf-8")
    pages = [page.name for page in folder.glob("*.md") if page.name != "index.md"]
    assert [name for name in pages if f"]({name})" not in index] == []


def test_changelog_is_in_the_site_by_its_history() -> None:
    assert (ROOT / "CHANGELOG.md").is_file()
    assert "changelog.md" in (DOCS / "log" / "index.md").read_text(encoding="utf-8")
