"""A file or a folder is written whole or not at all."""

import json
from pathlib import Path

import pytest

from cohdc_train import files
from cohdc_train.errors import DataError
from cohdc_train.files import new_folder


def test_content_arrives_and_nothing_else_is_left(tmp_path):
    files.write_json(tmp_path / "a.json", {"ü": [1, 2.5]})
    assert json.loads((tmp_path / "a.json").read_text("utf-8")) == {"ü": [1, 2.5]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_the_old_file_survives_content_that_cannot_be_written(tmp_path):
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
