"""Files and folders that are written whole or not at all."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cohdc_train.errors import DataError


def write_bytes(path: Path, content: bytes) -> None:
    """Write to a name beside `path`, then rename: a reader sees the old file or the new one, never a part."""
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise DataError(f"{path}: cannot be written: {error.strerror}") from error


def write_text(path: Path, text: str) -> None:
    """`write_bytes` of UTF-8 text."""
    write_bytes(path, text.encode())


def write_json(path: Path, content: Any) -> None:
    """`write_text` of indented JSON."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def link_or_copy(path: Path, target: Path) -> None:
    """Make `target` the same file, or a copy of it on another disk or a file system without links."""
    try:
        os.link(path.resolve(), target)
    except OSError:
        shutil.copyfile(path, target)


def sha256(path: Path) -> str:
    """Hexadecimal digest of a file's content. Raises DataError when there is no such file."""
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder to write into, which becomes `out` when the block ends well and vanishes when it does not.

    Raises DataError when `out` is a file or a folder with something in it.
    """
    if out.is_dir():
        count = sum(1 for _ in out.iterdir())
        if count:
            raise DataError(f"{out}: holds {count} entries already; give a new or an empty folder")
    elif out.exists():
        raise DataError(f"{out}: exists and is not a folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        yield draft
        draft.chmod(0o755)
        if out.is_dir():
            out.rmdir()
        os.replace(draft, out)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
