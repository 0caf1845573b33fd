"""Files and folders are written whole or not at all."""

import json
from pathlib import Path

import pytest

from cohdc_train import files
from cohdc_train.errors import DataError
from cohdc_train.files import (
    MANIFEST,
    OwnFiles,
    check_folder,
    claim_folder,
    files_below,
    new_folder,
    publish,
)


def test_written_file_has_content_and_leaves_no_temporary(tmp_path):
    files.write_json(tmp_path / "a.json", {"ü": [1, 2.5]})
    assert json.loads((tmp_path / "a.json").read_text("utf-8")) == {"ü": [1, 2.5]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_old_file_survives_content_that_cannot_be_written(tmp_path):
    files.write_text(tmp_path / "a.json", "old")
    with pytest.raises(TypeError):
        files.write_json(tmp_path / "a.json", {"x": object()})
    assert (tmp_path / "a.json").read_text() == "old"


def test_folders_are_whole_or_absent(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with pytest.raises(FileNotFoundError), new_folder(out) as draft:
        (draft / "absent" / "half").write_text("x")
    assert not list((tmp_path / "deep").iterdir())
    out.mkdir()
    with new_folder(out) as draft:
        (draft / "whole").write_text("x")
    assert (out / "whole").read_text() == "x"
    with pytest.raises(DataError, match="holds 1 entries already"), new_folder(out):
        pass
    with pytest.raises(DataError, match="is not a folder"), new_folder(out / "whole"):
        pass
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["out"]


def fill(folder: Path, **contents: str) -> Path:
    """Make a folder with files; `sub__name` is one in a folder below it."""
    for name, content in contents.items():
        file = folder / name.replace("__", "/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    return folder


def contents(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text() for name in files_below(folder) if name != MANIFEST}


@pytest.mark.parametrize("names", [["a"], ["sub"], ["sub/b"]])
def test_foreign_files_are_refused_in_one_line(tmp_path: Path, names: list[str]) -> None:
    folder = fill(tmp_path / "out", a="1", sub__b="2")
    said = rf"^{folder}: holds {names[0]}, .*give another --here, or move them$"
    with pytest.raises(DataError, match=said):
        claim_folder(folder, "verb", names, "--here")
    assert files_below(folder) == ["a", "sub/b"]


def test_absent_empty_and_unrelated_folders_are_accepted(tmp_path: Path) -> None:
    check_folder(tmp_path / "absent", "verb", ["a"])
    assert not (tmp_path / "absent").exists()
    (tmp_path / "a").mkdir()
    claim_folder(fill(tmp_path, mine="1"), "verb", ["a"])
    assert contents(tmp_path) == {"mine": "1"}


def test_files_of_another_verb_are_foreign(tmp_path: Path) -> None:
    claim_folder(tmp_path, "one", ["a"])
    fill(tmp_path, a="1")
    claim_folder(tmp_path, "one", ["a", "b"])
    with pytest.raises(DataError, match="holds a, not written by a former cohdc two"):
        check_folder(tmp_path, "two", ["a"])


def test_many_foreign_files_are_counted(tmp_path: Path) -> None:
    fill(tmp_path, **dict.fromkeys("abcdefgh", "mine"))
    with pytest.raises(DataError, match="holds a, b, c, d, e and 3 more,"):
        check_folder(tmp_path, "verb", "abcdefgh")


def test_published_files_replace_those_of_a_former_run_alone(tmp_path: Path) -> None:
    out = fill(tmp_path / "out", mine="m")
    former = fill(tmp_path / "one", a="1", old="1", sub__b="1", gone__c="1")
    assert publish(former, out, "verb") == []
    fill(out, sub__mine="m")
    assert publish(fill(tmp_path / "two", a="2", sub__new="2"), out, "verb") == []
    assert contents(out) == {"mine": "m", "sub/mine": "m", "a": "2", "sub/new": "2"}
    assert not (out / "gone").exists()


def test_file_that_appears_during_a_run_is_kept(tmp_path: Path) -> None:
    out = fill(tmp_path / "out", a="mine", b__c="mine")
    assert publish(fill(tmp_path / "draft", a="1", b="1", d="1"), out, "verb") == ["a", "b"]
    assert contents(out) == {"a": "mine", "b/c": "mine", "d": "1"}
    assert publish(fill(tmp_path / "next", e="1"), out, "verb") == []
    assert contents(out) == {"a": "mine", "b/c": "mine", "e": "1"}


@pytest.mark.parametrize(
    "content",
    ["{", "[]", '{"verb": 1}', '{"verb": [1]}', '{"verb": ["../mine"]}', '{"verb": ["/mine"]}'],
)
def test_invalid_manifest_is_refused(tmp_path: Path, content: str) -> None:
    out = fill(tmp_path / "out")
    out.mkdir()
    (out / MANIFEST).write_text(content)
    said = rf"^{out / MANIFEST}: is no list of files \(.*give another folder$"
    with pytest.raises(DataError, match=said):
        publish(fill(tmp_path / "draft", a="1"), out, "verb")
    assert (out / MANIFEST).read_text() == content


def test_files_written_one_by_one_are_listed_even_after_an_error(tmp_path: Path) -> None:
    fill(tmp_path, mine="m")

    def write() -> None:
        with OwnFiles(tmp_path, "verb") as own:
            own.path("a").write_text("1")
            own.path("mine").write_text("1")

    with pytest.raises(DataError, match="mine: is there already"):
        write()
    check_folder(tmp_path, "verb", ["a"])
    with OwnFiles(tmp_path, "verb") as own:
        own.path("a").write_text("2")
    assert contents(tmp_path) == {"a": "2", "mine": "m"}
