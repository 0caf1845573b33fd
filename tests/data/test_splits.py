"""Own split of a source: kept by the names of folders and lists, without test images."""

import json
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import foreign_toys as toys
import pytest
from conversion import assert_refused, converted, file_names
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.data.convert import convert

Captured = pytest.CaptureFixture[str]
NAMED = {
    **{"train": "train", "training": "train"},
    **{"val": "val", "valid": "val", "validation": "val"},
    **{"test": "test", "testing": "test"},
}
MORE = ["TRAIN", "Valid", "Test", "extra", "a/test", "b/train/c", "."]
FOLDERS = st.sampled_from([*NAMED, *MORE])


def build(format: str, root: Path, folders: dict[str, int]) -> Path:
    """Write images into folders, numbered through, with labelme's JSON files or VIA's."""
    seed = 0
    for folder, count in folders.items():
        entries = {}
        for _ in range(count):
            seed += 1
            name = f"{seed}.png"
            toys.draw_image(root / folder / name, seed)
            if format == "labelme":
                shape = toys.shape("person", "polygon", toys.PERSON)
                toys.labelme_file(root / folder / f"{seed}.json", [shape])
            entries[name] = {"filename": name, "size": 9, "regions": toys.person_and_car()}
        if format == "via":
            toys.write(root / folder / "via_region_data.json", entries)
    return root


def stems(splits: dict[str, Any]) -> dict[str, list[int]]:
    return {name: sorted(int(Path(n).stem) for n in file_names(s)) for name, s in splits.items()}


@pytest.mark.parametrize("format", ["labelme", "via"])
@pytest.mark.parametrize("names", [("train", "val", "test"), ("Train", "Validation", "TEST")])
@pytest.mark.parametrize("above", [".", "set", "set/labels"])
def test_own_split_is_kept_and_test_images_are_skipped(
    tmp_path: Path, format: str, names: tuple[str, ...], above: str, capsys: Captured
) -> None:
    counts = dict(zip([f"{above}/{name}" for name in names], (6, 2, 4), strict=True))
    splits = converted(format, build(format, tmp_path / "source", counts))
    assert stems(splits) == {"train": [1, 2, 3, 4, 5, 6], "val": [7, 8]}
    printed = capsys.readouterr().out
    assert "split: the source's own\n" in printed
    assert "       4  image of the test split: " in printed
    written = {path.name for path in (tmp_path / "source_coco" / "images").rglob("*.png")}
    assert written == {f"{i}.png" for i in range(1, 9)}


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(["labelme", "via"]), st.dictionaries(FOLDERS, st.integers(1, 2), min_size=1))
def test_every_test_image_is_skipped_and_counted(format: Any, folders: dict[str, int]) -> None:
    """It holds for any mixture of folders."""
    owners: dict[int, str] = {}
    for folder, count in folders.items():
        parts = [NAMED.get(part.lower(), "") for part in folder.split("/")]
        split = next(filter(None, parts), "")
        owners |= {len(owners) + i: split for i in range(1, count + 1)}
    kinds = Counter(owners.values())
    usable = sum(kinds.values()) - kinds["test"]
    with tempfile.TemporaryDirectory() as place:
        root = build(format, Path(place) / "source", folders)
        if usable < 2:
            assert_refused(
                Path(place), format, root, "images are of the test split|1 image; two or more"
            )
            return
        found = stems(converted(format, root))
    own = kinds["train"] > 0 and kinds["val"] > 0
    for name, rows in found.items():
        owned = {owners[number] for number in rows}
        assert owned == {name} if own else "test" not in owned
    expected = kinds["train"] + kinds["val"] if own else usable
    assert len(found["train"]) + len(found["val"]) == expected


@pytest.mark.parametrize("format", ["labelme", "via"])
@pytest.mark.parametrize(
    ("folders", "line", "left"),
    [
        (("train", "test"), "drawn from train, --val 0.2 --seed 0", 1),
        (("extra", "test"), "drawn from folders of other names, --val 0.2 --seed 0", 1),
        (("train", "extra"), "drawn from train and folders of other names, --val 0.2 --seed 0", 0),
        (("one", "two"), "drawn, --val 0.2 --seed 0", 0),
        (("train", "val", "extra", "test"), "the source's own", 2),
    ],
)
def test_split_of_mixed_folders_is_printed_in_one_line(
    tmp_path: Path, format: str, folders: tuple[str, ...], line: str, left: int, capsys: Captured
) -> None:
    splits = converted(format, build(format, tmp_path / "source", dict.fromkeys(folders, 2)))
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == f"split: {line}"
    assert sum("       2  image of " in row for row in printed) == left
    assert sum(len(split.images) for split in splits.values()) == 2 * (len(folders) - left)


@pytest.mark.parametrize("format", ["labelme", "via"])
def test_test_images_alone_are_converted_only_on_request(tmp_path: Path, format: str) -> None:
    root = build(format, tmp_path / "source", {"test": 3})
    assert_refused(
        tmp_path, format, root, "source: all 3 images are of the test split; to use them, "
    )
    convert(format, root / "test", tmp_path / "out")


def test_labelme_files_in_another_folder_follow_split_of_images(tmp_path: Path) -> None:
    root = tmp_path / "source"
    for i, split in enumerate(("train", "train", "val", "test")):
        toys.draw_image(root / split / f"{i}.png", i)
        shape = toys.shape("person", "polygon", toys.PERSON)
        toys.labelme_file(root / "labels" / f"{i}.json", [shape], f"../{split}/{i}.png")
    assert stems(converted("labelme", root)) == {"train": [0, 1], "val": [2]}


@pytest.mark.parametrize("single", [False, True])
def test_via_files_named_after_splits_or_one_over_folders(tmp_path: Path, single: bool) -> None:
    root = build("via", tmp_path / "source", {"train": 2, "val": 1, "test": 1})
    entries: dict[str, Any] = {}
    for split in ("train", "val", "test"):
        below = root / split / "via_region_data.json"
        listed = json.loads(below.read_text())
        below.unlink()
        if single:
            rows = {f"{split}/{name}": row for name, row in listed.items()}
            listed = {name: row | {"filename": name} for name, row in rows.items()}
        else:
            for name in listed:
                (root / split / name).rename(root / name)
            toys.write(root / f"{split}.json", listed)
        entries |= listed
    if single:
        toys.write(root / "via.json", entries)
    for source in (root, root / "via.json") if single else (root,):
        out = tmp_path / f"{source.stem}_out"
        convert("via", source, out)
        names = {path.stem for path in (out / "images").rglob("*.png")}
        assert names == {"1", "2", "3"}
        val = json.loads((out / "instances_val.json").read_text())["images"]
        assert [Path(row["file_name"]).stem for row in val] == ["3"]


def test_voc_counts_the_images_of_its_test_list(tmp_path: Path, capsys: Captured) -> None:
    root = toys.voc(tmp_path / "source")
    lists = root / "ImageSets" / "Segmentation"
    toys.write(lists / "train.txt", "a\nb\n")
    toys.write(lists / "test.txt", "b\nc\nd\n")
    splits = converted("voc", root)
    assert [file_names(splits[name]) for name in ("train", "val")] == [["a.jpg"], ["d.jpg"]]
    line = f"       2  image of the test split: {lists / 'test.txt'}:1: b ..."
    assert line in capsys.readouterr().out.splitlines()


def test_voc_split_is_never_drawn_from_test_list(tmp_path: Path, capsys: Captured) -> None:
    """CVAT writes its lists with a capital letter."""
    root = toys.voc(tmp_path / "source")
    lists = root / "ImageSets" / "Segmentation"
    for name in ("train", "val"):
        (lists / f"{name}.txt").unlink()
    toys.write(lists / "trainval.txt", "a\nb\nc\nd\n")
    toys.write(lists / "Test.txt", "c\n")
    splits = converted("voc", root)
    names = [name for split in splits.values() for name in file_names(split)]
    assert sorted(names) == ["a.jpg", "b.jpg", "d.jpg"]
    printed = capsys.readouterr().out
    assert printed.startswith("split: drawn from trainval.txt, --val 0.2 --seed 0\n")
    assert "       1  image of the test split: " in printed
