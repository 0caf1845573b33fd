"""Write files and folders whole or not at all, and never over a user's own."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, Self

from cohdc_train.errors import DataError

MANIFEST = ".cohdc-run.json"  # in a folder of results: verb -> names of what it wrote there
_SHOWN = 5  # names in a refusal


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file whole or not at all.

    The content goes to another name in the same folder first, which is then renamed. A reader sees
    the old file or the new one, never a part.

    Raises:
        DataError: the file cannot be written.
    """
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise DataError(f"{path}: cannot be written: {error.strerror}") from error


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text whole or not at all, as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON whole or not at all, as `write_bytes` does."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def link_or_copy(path: Path, target: Path) -> None:
    """Make `target` a hard link to a file, or a copy where links are not possible."""
    try:
        os.link(path.resolve(), target)
    except OSError:
        shutil.copyfile(path, target)


def sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 digest of a file.

    Raises:
        DataError: there is no such file.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `out` when the block succeeds, and else is removed.

    Raises:
        DataError: `out` is a file, or a folder with something in it.
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


def check_folder(folder: Path, verb: str, names: Iterable[str], option: str = "--out") -> None:
    """Raise DataError when a verb would write over files in a folder that are not its own.

    Own files are those that the folder's manifest lists for the verb. An empty folder under one of
    the names holds nothing that could be lost.

    Args:
        folder: where the verb writes; it need not exist.
        verb: as the user calls it.
        names: files and folders that will be written, relative to the folder.
        option: command-line option that names the folder.
    """
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder}: is a file; {option} names a folder")
    listed = listed_files(folder, verb)
    foreign = [name for name in names if _is_foreign(folder, name, listed)]
    if foreign:
        shown = ", ".join(foreign[:_SHOWN])
        shown += f" and {len(foreign) - _SHOWN} more" if len(foreign) > _SHOWN else ""
        raise DataError(
            f"{folder}: holds {shown}, not written by a former cohdc {verb} "
            f"(which lists its files in {MANIFEST}); give another {option}, or move them"
        )


def claim_folder(folder: Path, verb: str, names: Collection[str], option: str = "--out") -> None:
    """Make a folder and list names in its manifest as written by a verb, after `check_folder`."""
    check_folder(folder, verb, names, option)
    list_files(folder, verb, names)


class OwnFiles:
    """Files that a run writes into a folder one by one; the block's end lists them in the manifest.

    It serves names that are not known before the run. Known names go through `claim_folder` first.
    """

    def __init__(self, folder: Path, verb: str) -> None:
        """Read the names that the folder's manifest lists for a verb."""
        self._folder, self._verb = folder, verb
        self._names = listed_files(folder, verb)

    def __enter__(self) -> Self:
        """Begin to write files."""
        return self

    def __exit__(self, *_: object) -> None:
        """List all files that were written in the manifest."""
        list_files(self._folder, self._verb, self._names)

    def path(self, name: str) -> Path:
        """Return where to write a file. Raises DataError when a foreign file has this name."""
        path = self._folder / name
        if _is_foreign(self._folder, name, self._names):
            raise DataError(f"{path}: is there already, by somebody else; give another folder")
        self._names.add(name)
        return path


def listed_files(folder: Path, verb: str) -> set[str]:
    """Return the names that a folder's manifest lists for a verb; none without a manifest.

    Raises:
        DataError: the manifest was not written by this project.
    """
    return set(_read_manifest(folder).get(verb, ()))


def list_files(folder: Path, verb: str, names: Iterable[str]) -> None:
    """Add names to those that a folder's manifest lists for a verb, and make the folder."""
    _write_listed(folder, verb, listed_files(folder, verb) | set(names))


def files_below(folder: Path) -> list[str]:
    """Return the names of all files below a folder, relative to it, in order."""
    files = [path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()]
    return sorted(path.relative_to(folder).as_posix() for path in files)


def publish(draft: Path, folder: Path, verb: str) -> list[str]:
    """Move the files of `draft` into a folder, in place of those that a former run left there.

    Files of others stay.

    Args:
        draft: the new files.
        folder: where they go.
        verb: whose files are replaced.

    Returns:
        Names that were left in `draft` because a file of somebody else has them, for example one
        that appeared after `check_folder`.
    """
    former = listed_files(folder, verb)
    made = files_below(draft)
    blocked = {name for name in made if _is_foreign(folder, name, former)}
    blocked |= {name for name in made if (folder / name).is_dir()}
    own = sorted(set(made) - blocked)
    list_files(folder, verb, own)  # before the move: whoever is killed in it leaves listed files
    for name in own:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(draft / name, folder / name)
    _remove(folder, former - set(own))
    _write_listed(folder, verb, own)
    return sorted(blocked)


def remove_listed(folder: Path, verb: str) -> None:
    """Remove the files that a folder's manifest lists for a verb, and folders that become empty."""
    _remove(folder, listed_files(folder, verb))
    if folder.is_dir():
        _write_listed(folder, verb, ())


def _is_foreign(folder: Path, name: str, listed: Collection[str]) -> bool:
    """Return whether something of this name is there that was not listed."""
    path = folder / name
    if path.is_dir() and not path.is_symlink():
        known = name in listed or any(entry.startswith(f"{name}/") for entry in listed)
        return not known and any(path.iterdir())
    return os.path.lexists(path) and name not in listed


def _remove(folder: Path, names: Iterable[str]) -> None:
    """Remove files, and the folders between them and `folder` that become empty."""
    for name in names:
        path = folder / name
        if path.is_dir() and not path.is_symlink():
            continue  # a user's folder in the place of the file that was listed
        path.unlink(missing_ok=True)
        for parent in list(path.relative_to(folder).parents)[:-1]:
            if (folder / parent).is_dir() and not any((folder / parent).iterdir()):
                (folder / parent).rmdir()


def _read_manifest(folder: Path) -> dict[str, list[str]]:
    """Return verb -> names.

    Raises:
        DataError: the file is no manifest, or a name leads out of the folder.
    """
    file = folder / MANIFEST
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        names = [PurePosixPath(name) for listed in content.values() for name in listed]
        if any(name.is_absolute() or ".." in name.parts for name in names):
            raise ValueError("a name leads out of the folder")
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        reason = str(error).partition("\n")[0]
        raise DataError(f"{file}: is no list of files ({reason}); give another folder") from error
    return dict(content)


def _write_listed(folder: Path, verb: str, names: Iterable[str]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made: {error.strerror}") from error
    write_json(folder / MANIFEST, {**_read_manifest(folder), verb: sorted(names)})
