"""Conversion of other formats: exact masks, counted losses, and all or nothing."""

import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import foreign_toys as toys
import numpy as np
import pytest
from conversion import (
    BUILD,
    FORMATS,
    assert_refused,
    converted,
    drawn,
    file_names,
    image_of,
    masks_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.cli import main
from cohdc_train.data import convert as module
from cohdc_train.data.annotations import read_image
from cohdc_train.data.coco import find_split, read_split
from cohdc_train.data.convert import convert
from cohdc_train.errors import DataError


@pytest.mark.parametrize("format", FORMATS)
def test_converted_masks_are_exact_and_pass_doctor(
    tmp_path: Path, format: str, capsys: pytest.CaptureFixture[str]
) -> None:
    splits = converted(format, BUILD[format](tmp_path / "source"))
    assert [len(splits[name].images) for name in ("train", "val")] == [3, 1]
    person = drawn(toys.PERSON) if format != "voc" else toys.box_mask(5, 4, 25, 30)
    for name in toys.NAMES:
        image = image_of(splits, name)
        objects = dict(masks_of(splits, name))
        assert np.array_equal(objects["person"], person)
        assert np.array_equal(objects["car"], toys.box_mask(*toys.CAR))
        box = {splits["train"].class_names[o.label - 1]: o.box for o in image.objects}
        assert box["car"] == (30, 20, 24, 14)
        assert (
            image.objects[0].area
            == objects[splits["train"].class_names[image.objects[0].label - 1]].sum()
        )
        original = next(
            p
            for p in (tmp_path / "source").rglob(f"{name}.?*g")
            if not p.parent.name.startswith("Seg")
        )
        assert image.path.samefile(original)
        assert read_image(image).shape == (toys.HEIGHT, toys.WIDTH, 3)
    assert sorted(path.name for path in (tmp_path / "source_coco").iterdir()) == [
        "images",
        "instances_train.json",
        "instances_val.json",
    ]
    capsys.readouterr()
    assert main(["data", "doctor", str(tmp_path / "source_coco")]) == 0
    printed = capsys.readouterr().out
    found = set(re.findall(r"\[([a-z-]+)\]: ", printed))
    assert found == ({"category-unused"} if format == "voc" else set())


def test_convert_prints_counts_and_next_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = toys.labelme(tmp_path / "source")
    line = toys.shape("person", "linestrip", [1, 1, 9, 9, 20, 4])
    toys.labelme_file(root / "a.json", [toys.shape("person", "polygon", toys.PERSON), line])
    toys.draw_image(root / "new.jpg", 9)
    out = tmp_path / "out"
    assert (
        main(["data", "convert", "labelme", str(root), str(out), "--val", "0.5", "--seed", "3"])
        == 0
    )
    assert capsys.readouterr().out.splitlines() == [
        "split: drawn, --val 0.5 --seed 3",
        "train: images 2; objects 3; class car 1; class person 2",
        "val: images 2; objects 4; class car 2; class person 2",
        "skipped:",
        f"       1  image without a JSON file: {root / 'new.jpg'}",
        f"       1  shape of type 'linestrip': {root / 'a.json'}: shape 2",
        f"next: cohdc data doctor {out}",
    ]


# the split


def test_drawn_split_repeats_for_same_seed(tmp_path: Path) -> None:
    root = tmp_path / "source"
    for seed in range(10):
        toys.draw_image(root / f"{seed}.png", seed)
        toys.labelme_file(root / f"{seed}.json", [toys.shape("person", "polygon", toys.PERSON)])
    runs = []
    for i, (val, seed) in enumerate([(0.2, 0), (0.2, 0), (0.2, 1), (0.001, 0), (0.999, 0)]):
        out = tmp_path / str(i)
        convert("labelme", root, out, val=val, seed=seed)
        both = [file_names(read_split(name, find_split(out, name))) for name in ("train", "val")]
        assert sorted(both[0] + both[1]) == [f"{k}.png" for k in range(10)]
        runs.append(both)
    assert runs[0] == runs[1]
    assert runs[0][1] != runs[2][1]
    assert [len(val) for _, val in runs] == [2, 2, 2, 1, 9]


@pytest.mark.parametrize("format", ["labelme", "via"])
@pytest.mark.parametrize("folder", ["val", "valid"])
def test_folders_named_train_and_val_are_a_split(tmp_path: Path, format: str, folder: str) -> None:
    BUILD[format](tmp_path / "source" / "train")
    BUILD[format](tmp_path / "source" / folder)
    splits = converted(format, tmp_path / "source")
    for name, below in (("train", "train"), ("val", folder)):
        assert file_names(splits[name]) == [f"{below}/{stem}.png" for stem in toys.NAMES]
        assert all(image.path.is_file() for image in splits[name].images)


def test_images_of_same_name_keep_their_folders(tmp_path: Path) -> None:
    root = tmp_path / "source"
    toys.labelme(root / "one")
    toys.labelme(root / "two" / "deep")
    toys.labelme_file(root / ".hidden" / "a.json", "no shapes")  # type: ignore[arg-type]
    splits = converted("labelme", root)
    names = {name for split in splits.values() for name in file_names(split)}
    assert names == {
        f"{folder}/{stem}.png" for folder in ("one", "two/deep") for stem in toys.NAMES
    }
    for split in splits.values():
        for name, image in zip(file_names(split), split.images, strict=True):
            assert image.path.samefile(root / name)


def test_image_folders_that_would_be_misread_are_refused(tmp_path: Path) -> None:
    root = toys.yolo(
        tmp_path / "source", "train: images\nval: images/train/train\nnames: [person, car]\n"
    )
    for split in ("train/train", "train"):
        toys.draw_image(root / "images" / split / "a.png", 1)
        toys.write(root / "labels" / split / "a.txt", toys.yolo_row(0, toys.PERSON))
    toys.draw_image(root / "images" / "train" / "train" / "train" / "a.png", 1)
    with pytest.raises(DataError, match="images/train would be taken for others of the same name"):
        convert("yolo", root, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


# all or nothing


@pytest.mark.parametrize("format", FORMATS)
def test_nothing_is_left_when_writing_fails(
    tmp_path: Path, format: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = BUILD[format](tmp_path / "source")
    before = sorted(source.rglob("*"))

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(module, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        convert(format, source, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]
    assert sorted(source.rglob("*")) == before


def test_output_folder_must_be_empty(tmp_path: Path) -> None:
    source = toys.yolo(tmp_path / "source")
    out = tmp_path / "out"
    toys.write(out / "mine.txt", "keep")
    with pytest.raises(
        DataError, match=r"out: holds 1 entries already; give a new or an empty folder$"
    ):
        convert("yolo", source, out)
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    convert("yolo", source, out)
    assert (out / "instances_val.json").is_file()


def test_images_are_copied_where_links_are_impossible(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other_disk(*_: object) -> None:
        raise OSError("Invalid cross-device link")

    monkeypatch.setattr(os, "link", other_disk)
    splits = converted("yolo", toys.yolo(tmp_path / "source"))
    image = image_of(splits, "a")
    original = tmp_path / "source" / "images" / "train" / "a.png"
    assert not image.path.samefile(original)
    assert image.path.read_bytes() == original.read_bytes()


# labelme


# VIA


# Pascal VOC


JUNK = st.sampled_from(
    [None, -1, 1e9, 10**400, float("nan"), "", "x" * 300, True, [], [[1, 2]], {}, {"a": 1}]
)


def places(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Yield the path to every value inside a JSON value."""
    pairs = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [found for key, part in pairs for found in [(*way, key), *places(part, (*way, key))]]


@settings(max_examples=60, deadline=None)
@given(format=st.sampled_from(["labelme", "via"]), data=st.data())
def test_damaged_json_is_converted_or_named_in_error(format: Any, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = BUILD[format](Path(folder) / "source")
        path = root / ("via.json" if format == "via" else "a.json")
        content = json.loads(path.read_text())
        way = data.draw(st.sampled_from(places(content)))
        target = content
        for key in way[:-1]:
            target = target[key]
        target[way[-1]] = data.draw(JUNK)
        toys.write(path, content)
        said = ""
        try:
            convert(format, root, Path(folder) / "out")
        except DataError as error:
            said = str(error)
        left = sorted(p.name for p in Path(folder).iterdir())
        assert left == ["source"] if said else ["out", "source"]
        assert not said or (str(root) in said and "\n" not in said)


def test_conversion_error_names_file_for_every_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = toys.labelme(tmp_path / "source")
    assert_refused(tmp_path, "labelme", tmp_path / "gone", r"gone: no such file or folder$")
    assert_refused(
        tmp_path, "labelme", tmp_path, r"--attribute is for via, not for labelme$", attribute="x"
    )
    assert_refused(
        tmp_path, "yolo", tmp_path, r"--names is for voc and via, not for yolo$", names=root
    )
    assert_refused(
        tmp_path, "labelme", root / "a.json", r"a\.json: 1 image; two or more are needed"
    )
    assert_refused(tmp_path, "labelme", root, r"--val 1\.0: must be between 0 and 1$", val=1.0)
    assert_refused(tmp_path, "voc", root, r"none\.txt: no such file$", names=tmp_path / "none.txt")
    (tmp_path / "empty").mkdir()
    assert_refused(tmp_path, "via", tmp_path / "empty", r"empty: no JSON file below it$")
    for name in toys.NAMES[:3]:
        toys.labelme_file(root / f"{name}.json", [toys.shape("x", "point", [1, 2])])
    assert_refused(
        tmp_path,
        "labelme",
        root,
        r"source: no object in train of 3 images; 3 skipped: shape of type 'point'$",
        seed=seed_drawing_d(root),
    )
    assert main(["data", "convert", "labelme", str(tmp_path / "gone"), str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == f"cohdc data: {tmp_path / 'gone'}: no such file or folder\n"
    with pytest.raises(SystemExit) as ended:
        main(["data", "convert", "pdf", str(root), str(tmp_path / "out")])
    assert ended.value.code == 2


def seed_drawing_d(root: Path) -> int:
    """Return a seed for which d.png, the fourth of four, is the validation image."""
    return next(seed for seed in range(99) if np.random.default_rng(seed).permutation(4)[0] == 3)
