"""Fetch a sequence of the TUM RGB-D benchmark: `cohdc data tum`."""

import gzip
import os
import tarfile
import urllib.request
import zlib
from http.client import HTTPException
from pathlib import Path, PurePosixPath
from typing import Any

from cohdc_train.errors import DataError
from cohdc_train.files import new_folder, sha256

HOST = "https://cvg.cit.tum.de/rgbd/dataset"
_PREFIX = "rgbd_dataset_"
SEQUENCES = (
    *(
        "freiburg1_xyz",
        "freiburg1_rpy",
        "freiburg1_360",
        "freiburg1_floor",
        "freiburg1_desk",
        "freiburg1_desk2",
    ),
    *(
        "freiburg1_room",
        "freiburg2_xyz",
        "freiburg2_rpy",
        "freiburg2_desk",
        "freiburg2_desk_with_person",
    ),
    *("freiburg3_long_office_household", "freiburg3_sitting_static", "freiburg3_sitting_xyz"),
    *(
        "freiburg3_sitting_halfsphere",
        "freiburg3_sitting_rpy",
        "freiburg3_walking_static",
        "freiburg3_walking_xyz",
    ),
    *("freiburg3_walking_halfsphere", "freiburg3_walking_rpy"),
)
_LISTS = ("rgb.txt", "depth.txt")
_CHUNK = 1 << 20


def tum(
    name: str,
    *,
    out: Path = Path("tum"),
    archive: Path | None = None,
    digest: str | None = None,
    host: str = HOST,
) -> Path:
    """Fetch a sequence of the TUM RGB-D benchmark, check it, and unpack it.

    It goes into OUT/rgbd_dataset_NAME. A download that was interrupted continues where it stopped.
    Every image that rgb.txt and depth.txt list has to be there, or no folder is left. A folder that
    is there already is checked and kept.

    Args:
        name: such as walking_xyz, freiburg3_walking_xyz or rgbd_dataset_freiburg3_walking_xyz.
        out: folder for the archive and the sequence.
        archive: the .tgz, fetched by hand.
        digest: SHA-256 that the archive must have. The publisher gives none; the digest that was
            read is printed.
        host: address of the folders freiburg1 to freiburg3.

    Returns:
        The folder of the sequence.

    Raises:
        DataError: there is no such sequence, the publisher cannot be reached, or the archive is
            damaged or incomplete.
    """
    sequence = _sequence(name)
    folder = out / f"{_PREFIX}{sequence}"
    if folder.is_dir():
        print(f"{folder}: {_check_complete(folder)} images, already there")
        return folder
    if out.exists() and not out.is_dir():
        raise DataError(f"{out}: is not a folder")
    out.mkdir(parents=True, exist_ok=True)
    fetched = out / f"{folder.name}.tgz"
    is_new = archive is None and not fetched.is_file()
    if is_new:
        _download(f"{host}/{sequence.partition('_')[0]}/{fetched.name}", fetched)
    file = fetched if archive is None else archive
    try:
        found = sha256(file)
        if digest is not None and found != digest.lower():
            raise DataError(f"{file}: SHA-256 {found}, expected {digest.lower()}")
        with new_folder(folder) as draft:
            _unpack(file, folder.name, draft)
            count = _check_complete(draft, file)
    except DataError as error:
        if archive is not None:
            raise
        if not is_new:  # the user may have fetched it
            raise DataError(f"{error}; delete it to fetch it again") from error
        fetched.unlink(missing_ok=True)  # the next call fetches it again
        raise DataError(f"{error}; it was deleted") from error
    print(f"{folder}: {count} images, SHA-256 of the archive {found}")
    return folder


def _sequence(name: str) -> str:
    wanted = name.removeprefix(_PREFIX)
    matches = [known for known in SEQUENCES if known == wanted] or [
        known for known in SEQUENCES if known.partition("_")[2] == wanted
    ]
    if len(matches) == 1:
        return matches[0]
    others = ", ".join(matches or SEQUENCES)
    raise DataError(
        f"TUM sequence {name!r}: " + (f"is {others}" if matches else f"there are {others}")
    )


def _download(url: str, file: Path) -> None:
    """Download into FILE.part, continue a part that is there, and rename it when it is complete."""
    part = file.with_name(file.name + ".part")
    num_bytes = part.stat().st_size if part.is_file() else 0
    try:
        request = urllib.request.Request(
            url, headers={"Range": f"bytes={num_bytes}-"} if num_bytes else {}
        )
        with urllib.request.urlopen(request, timeout=60) as response:
            if num_bytes and response.status != 206:  # the host sends the whole file again
                num_bytes = 0
            length = response.headers.get("Content-Length")
            total = None if length is None else num_bytes + int(length)
            with part.open("ab" if num_bytes else "wb") as stream:
                _copy(response, stream, num_bytes, total)
    except (OSError, HTTPException, ValueError) as error:
        if getattr(error, "code", None) == 416:  # the part is larger than the file
            part.unlink()
            return _download(url, file)
        reason = getattr(error, "reason", None) or error
        fix = "fetch it by hand and give --archive FILE, or try again to continue"
        raise DataError(f"{url}: cannot be fetched: {reason}; {fix}") from error
    size = part.stat().st_size
    if total is not None and size != total:
        raise DataError(f"{part}: {size} of {total} bytes arrived; try again to continue")
    os.replace(part, file)
    return None


def _copy(response: Any, stream: Any, done: int, total: int | None) -> None:
    printed_tenths = 0
    while chunk := response.read(_CHUNK):
        stream.write(chunk)
        done += len(chunk)
        if total and 10 * done // total > printed_tenths:
            printed_tenths = 10 * done // total
            print(f"{10 * printed_tenths} % of {total / 1e6:.0f} MB", flush=True)


def _unpack(file: Path, inside: str, target: Path) -> None:
    """Unpack regular files below the folder `inside` of an archive.

    Raises:
        DataError: the archive is damaged, or an entry is a link or leads out of the target.
    """
    try:
        with tarfile.open(file, "r:gz") as tar:
            for member in tar:
                path = PurePosixPath(member.name)
                parts = [part for part in path.parts if part != "."]
                if path.is_absolute() or ".." in parts or not (member.isfile() or member.isdir()):
                    raise DataError(
                        f"{file}: entry {member.name!r} is a link or leads out of the folder"
                    )
                if not member.isfile() or parts[:1] != [inside]:
                    continue
                place = target.joinpath(*parts[1:])
                place.parent.mkdir(parents=True, exist_ok=True)
                source = tar.extractfile(member)
                if source is None:
                    raise DataError(f"{file}: entry {member.name!r} has no content")
                with source, place.open("wb") as stream:
                    while chunk := source.read(_CHUNK):
                        stream.write(chunk)
    except (tarfile.TarError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise DataError(f"{file}: not a whole .tgz: {str(error).partition(chr(10))[0]}") from error
    except OSError as error:
        raise DataError(
            f"{file}: cannot be unpacked into {target.parent}: {error.strerror}"
        ) from error


def _check_complete(folder: Path, named: Path | None = None) -> int:
    """Return the number of images that the lists name.

    Raises:
        DataError: a file is missing; the message names it.
    """
    count = 0
    for name in (*_LISTS, "groundtruth.txt"):
        if not (folder / name).is_file():
            raise DataError(f"{named or folder}: no {name}")
    for name in _LISTS:
        for number, line in enumerate(_lines(folder / name, named or folder), start=1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) != 2 or not (folder / words[1]).is_file():
                raise DataError(
                    f"{named or folder}: {name} line {number}: {' '.join(words)!r} is not there"
                )
            count += 1
    if not count:
        raise DataError(f"{named or folder}: its lists name no image")
    return count


def _lines(file: Path, named: Path) -> list[str]:
    try:
        return file.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{named}: {file.name} is no text") from error
