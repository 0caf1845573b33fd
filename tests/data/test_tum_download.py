"""`cohdc data tum` against a local host: download, resumption, checks, unsafe archives."""

import hashlib
import io
import tarfile
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pytest

from cohdc_train.cli import main
from cohdc_train.data.tum_download import SEQUENCES, tum
from cohdc_train.errors import DataError

NAME = "rgbd_dataset_freiburg3_walking_xyz"
FILES = {
    "rgb.txt": b"# stamp file\n1.0 rgb/1.0.png\n2.0 rgb/2.0.png\n",
    "depth.txt": b"1.0 depth/1.0.png\n",
    "groundtruth.txt": b"1.0 0 0 0 0 0 0 1\n",
    "rgb/1.0.png": bytes(range(256)) * 64,
    "rgb/2.0.png": b"two",
    "depth/1.0.png": b"three",
}


def archive(files: dict[str, bytes], *extra: tarfile.TarInfo) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as tar:
        for name, content in files.items():
            member = tarfile.TarInfo(f"{NAME}/{name}")
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
        for member in extra:
            tar.addfile(member)
    return stream.getvalue()


class Host(BaseHTTPRequestHandler):
    """Serves one file, from a byte on when asked to, and stops after `breaks` bytes."""

    content = b""
    breaks: ClassVar[int | None] = None
    ranges = True
    asked: ClassVar[list[str | None]] = []

    def do_GET(self) -> None:
        wanted = self.headers.get("Range")
        type(self).asked.append(wanted)
        if self.path != f"/freiburg3/{NAME}.tgz":
            self.send_error(404)
            return
        first = int(wanted[6:-1]) if wanted and self.ranges else 0
        if first >= len(self.content):
            self.send_error(416)
            return
        self.send_response(206 if first else 200)
        rest = self.content[first:]
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        self.wfile.write(rest[: self.breaks])

    def log_message(self, format: str, *args: Any) -> None:
        return


@pytest.fixture
def host() -> Iterator[str]:
    Host.content, Host.breaks, Host.ranges, Host.asked = archive(FILES), None, True, []
    server = ThreadingHTTPServer(("127.0.0.1", 0), Host)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.parametrize("name", ["walking_xyz", "freiburg3_walking_xyz", NAME])
def test_sequence_is_fetched_checked_and_unpacked(tmp_path: Path, host: str, name: str) -> None:
    folder = tum(name, out=tmp_path / "tum", host=host)
    assert folder == tmp_path / "tum" / NAME
    assert {file: (folder / file).read_bytes() for file in FILES} == FILES
    assert tum(name, out=tmp_path / "tum", host=host) == folder
    assert len(Host.asked) == 1, "what is there is not fetched again"


def test_part_that_is_too_long_is_fetched_again(tmp_path: Path, host: str) -> None:
    (tmp_path / f"{NAME}.tgz.part").write_bytes(b"x" * (len(Host.content) + 1))
    tum("walking_xyz", out=tmp_path, host=host)
    assert (tmp_path / f"{NAME}.tgz").read_bytes() == Host.content


def test_answer_that_is_no_archive_is_deleted(tmp_path: Path, host: str) -> None:
    Host.content = b"<html>please log in</html>"
    with pytest.raises(
        DataError, match=r"not a whole \.tgz: not a gzip file; it was deleted"
    ) as caught:
        tum("walking_xyz", out=tmp_path, host=host)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_archive_of_user_is_kept_on_failure(tmp_path: Path, host: str) -> None:
    (tmp_path / f"{NAME}.tgz").write_bytes(b"fetched by hand, cut off")
    with pytest.raises(DataError, match=r"not a whole \.tgz: .*; delete it to fetch it again"):
        tum("walking_xyz", out=tmp_path, host=host)
    assert (tmp_path / f"{NAME}.tgz").read_bytes() == b"fetched by hand, cut off"
    assert Host.asked == []


@pytest.mark.parametrize("ranges", [True, False])
def test_interrupted_download_continues(tmp_path: Path, host: str, ranges: bool) -> None:
    Host.breaks = 100
    with pytest.raises(DataError, match=r"100 of \d+ bytes arrived|cannot be fetched"):
        tum("walking_xyz", out=tmp_path, host=host)
    assert [file.name for file in tmp_path.iterdir()] == [f"{NAME}.tgz.part"]
    Host.breaks, Host.ranges = None, ranges
    tum("walking_xyz", out=tmp_path, host=host)
    assert Host.asked == [None, "bytes=100-"]
    assert (
        hashlib.sha256((tmp_path / f"{NAME}.tgz").read_bytes()).digest()
        == hashlib.sha256(Host.content).digest()
    )


def test_offline_error_names_url_and_archive_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["walking_xyz", "--out", str(tmp_path), "--host", "http://127.0.0.1:1"]
    assert main(["data", "tum", *arguments]) == 1
    said = capsys.readouterr().err.strip()
    assert said.startswith(
        f"cohdc data: http://127.0.0.1:1/freiburg3/{NAME}.tgz: cannot be fetched"
    )
    assert said.count("\n") == 0
    assert "--archive FILE" in said
    assert list(tmp_path.iterdir()) == []


def assert_refused(tmp_path: Path, content: bytes, message: str, **options: Any) -> None:
    file = tmp_path / "given.tgz"
    file.write_bytes(content)
    with pytest.raises(DataError, match=message):
        tum("walking_xyz", out=tmp_path / "out", archive=file, **options)
    assert list((tmp_path / "out").iterdir()) == []


def test_damaged_and_incomplete_archives_leave_nothing(tmp_path: Path) -> None:
    whole = archive(FILES)
    assert_refused(tmp_path, whole[: len(whole) // 2], r"given\.tgz: not a whole \.tgz")
    assert_refused(tmp_path, b"no archive", r"given\.tgz: not a whole \.tgz")
    assert_refused(
        tmp_path,
        archive({k: v for k, v in FILES.items() if k != "rgb/2.0.png"}),
        r"rgb\.txt line 3: '2\.0 rgb/2",
    )
    assert_refused(
        tmp_path,
        archive({k: v for k, v in FILES.items() if k != "groundtruth.txt"}),
        r"no groundtruth\.txt",
    )
    assert_refused(
        tmp_path, archive(FILES | {"rgb.txt": b"\xff\xfe"}), r"given\.tgz: rgb\.txt is no text"
    )
    assert_refused(
        tmp_path, archive(FILES | {"rgb.txt": b"", "depth.txt": b""}), "its lists name no image"
    )
    assert_refused(tmp_path, whole, "SHA-256 [0-9a-f]{64}, expected 00", digest="00")


def test_archives_that_lead_outside_are_refused(tmp_path: Path) -> None:
    up, absolute, link = (
        tarfile.TarInfo(f"{NAME}/../../evil"),
        tarfile.TarInfo("/evil"),
        tarfile.TarInfo(f"{NAME}/l"),
    )
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    for member in (up, absolute, link):
        assert_refused(tmp_path, archive(FILES, member), "is a link or leads out of the folder")
    assert not (tmp_path / "evil").exists()


def test_given_archive_needs_no_host_and_its_digest_may_be_asked_for(tmp_path: Path) -> None:
    file = tmp_path / "given.tgz"
    file.write_bytes(archive(FILES))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    folder = tum(
        "walking_xyz",
        out=tmp_path / "out",
        archive=file,
        digest=digest.upper(),
        host="http://nowhere.invalid",
    )
    assert (folder / "rgb.txt").is_file()


def test_unknown_and_ambiguous_names_list_sequences() -> None:
    with pytest.raises(DataError, match="'running_xyz': there are freiburg1_xyz, "):
        tum("running_xyz")
    with pytest.raises(DataError, match="'xyz': is freiburg1_xyz, freiburg2_xyz"):
        tum("xyz")
    assert len(set(SEQUENCES)) == len(SEQUENCES)


def test_entry_without_content_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tarfile.TarFile, "extractfile", lambda *_: None)
    assert_refused(tmp_path, archive(FILES), r"given\.tgz: entry '.*' has no content")
