"""Nothing is half-written, and every complaint is one sentence that names the path.

Root ignores permissions, so the unwritable places used here are those that stop root too.
"""

import errno
import os
import shutil
import stat
import subprocess
import tempfile
from contextlib import suppress

import pytest

from planner.base.errors import FileError, ModelError
from planner.base.files import TEXT_LIMIT, file_error, printable, read_input, read_text, staged_folder, write_atomically

OUTPUTS = ("plan.npz", "report.html", "video.mp4")


def contents(folder):
    """Every path below the folder, hidden ones included, with the text of the files."""
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def write_one(path, data, raises=None):
    with write_atomically(path) as hidden:
        hidden.write_bytes(data)
        if raises is not None:
            raise raises


def write_set(folder, files, raises=None):
    with staged_folder(folder, OUTPUTS) as staging:
        for name, data in files.items():
            (staging / name).write_bytes(data)
        if raises is not None:
            raise raises


def sentence(error):
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(".")
    assert ".planner-" not in text  # the hidden names are our business
    return text


linux = pytest.mark.skipif(not os.path.isdir("/proc"), reason="these paths are Linux's")


def mounted(folder):
    """Whether a file system of 256 KiB could be put there, which takes root and its permission."""
    mount = shutil.which("mount")
    command = [mount, "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    return mount is not None and subprocess.run(command, capture_output=True, check=False).returncode == 0


def unmount(folder):
    subprocess.run(["umount", "-l", str(folder)], check=True)


def can_mount():
    with tempfile.TemporaryDirectory() as folder:
        possible = mounted(folder)
        if possible:
            unmount(folder)
    return possible


needs_mount = pytest.mark.skipif(not can_mount(), reason="a small file system cannot be mounted here")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 256 KiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    assert mounted(folder)
    yield folder
    unmount(folder)


# One file


def test_a_file_appears_whole_and_nothing_else(tmp_path):
    target = tmp_path / "plan.npz"
    target.write_text("old")
    with write_atomically(target) as hidden:
        assert hidden.parent == tmp_path
        assert hidden.suffix == ".npz"
        assert hidden.name.startswith(".")
        hidden.write_text("new, half")
        assert target.read_text() == "old"
        hidden.write_text("new")
    assert contents(tmp_path) == {"plan.npz": "new"}


@pytest.mark.parametrize("exception", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_the_older_file(tmp_path, exception):
    target = tmp_path / "plan.npz"
    target.write_text("old")
    with pytest.raises(exception):
        write_one(target, b"half", raises=exception)
    assert contents(tmp_path) == {"plan.npz": "old"}


def test_permissions_are_those_of_any_new_file(tmp_path):
    ordinary = tmp_path / "ordinary"
    ordinary.write_text("")
    with write_atomically(tmp_path / "ours") as hidden:
        hidden.write_text("")
    assert stat.S_IMODE((tmp_path / "ours").stat().st_mode) == stat.S_IMODE(ordinary.stat().st_mode)


def test_a_link_is_followed_not_replaced(tmp_path):
    real, link = tmp_path / "real.txt", tmp_path / "link.txt"
    real.write_text("old")
    link.symlink_to(real)
    with write_atomically(link) as hidden:
        hidden.write_text("new")
    assert link.is_symlink()
    assert real.read_text() == "new"


def test_an_error_of_the_callers_own_passes_unchanged(tmp_path):
    with pytest.raises(FileNotFoundError, match="elsewhere"), write_atomically(tmp_path / "a.txt"):
        (tmp_path / "elsewhere").read_text()
    with pytest.raises(BrokenPipeError), write_atomically(tmp_path / "a.txt"):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    with pytest.raises(OSError, match="libOSMesa"), write_atomically(tmp_path / "a.txt"):
        raise OSError("libOSMesa.so: cannot open shared object file")
    assert contents(tmp_path) == {}


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("file/plan.npz", r"file' is a file, expected a folder"),
        ("file/deeper/plan.npz", r"file' is a file, expected a folder"),
        ("missing/plan.npz", r"the folder '.*/missing' does not exist"),
        ("missing/deeper/plan.npz", r"the folder '.*/missing' does not exist"),
        ("folder", r"it is a folder, expected the name of a file"),
        ("n" * 300, r"the name is too long"),
        ("loop/plan.npz", r"symbolic links form a loop"),
        ("nul\0l", r"null character"),
        pytest.param("/dev/null", r"expected an ordinary file", marks=linux),
        pytest.param("/proc/plan.npz", r"does not let anything be created there", marks=linux),
    ],
)
def test_an_impossible_file_fails_before_any_work(tmp_path, path, says):
    (tmp_path / "file").write_text("untouched")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    reached = False
    with pytest.raises(FileError, match=says) as error, write_atomically(tmp_path / path):
        reached = True
    assert not reached
    assert sentence(error).startswith("cannot write '")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "loop"]
    assert (tmp_path / "file").read_text() == "untouched"


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (errno.ENOSPC, "no space left on device"),
        (errno.EDQUOT, "quota"),
        (errno.EROFS, "read-only"),
        (errno.EIO, "input/output"),
    ],
)
def test_a_failing_device_is_named(tmp_path, monkeypatch, number, says):
    def fsync(handle):
        raise OSError(number, os.strerror(number))

    target = tmp_path / "plan.npz"
    target.write_text("old")
    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(FileError, match=says) as error, write_atomically(target) as hidden:
        hidden.write_text("new")
    assert str(target) in sentence(error)
    assert contents(tmp_path) == {"plan.npz": "old"}


def test_no_permission_is_named(tmp_path, monkeypatch):
    def refuse(path, *_):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(FileError, match="no permission; choose a place you may write"):
        write_one(tmp_path / "plan.npz", b"")


def test_reading_says_what_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError) as missing:
        (tmp_path / "plan.npz").read_bytes()
    error = file_error(missing.value, tmp_path / "plan.npz", verb="read")
    assert str(error) == f"cannot read '{tmp_path}/plan.npz': there is no such file."


# A set of files


def test_inputs_are_ordinary_files_of_a_size_that_fits(tmp_path):
    (tmp_path / "a.txt").write_bytes("\ufeffgrüße\r\n".encode())
    assert read_text(tmp_path / "a.txt", "the text") == "grüße\r\n"
    assert read_input(tmp_path / "a.txt", "the text", most=12) == (tmp_path / "a.txt").read_bytes()
    (tmp_path / "empty").touch()
    assert read_input(tmp_path / "empty", "the text") == b""
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with open(tmp_path / "large", "wb") as file:
        file.truncate(TEXT_LIMIT + 1)  # a hole, no block is written
    os.mkfifo(tmp_path / "pipe")
    wrong = {
        "nowhere": "No such file", "binary": "it is not text", "large": "larger than 64 MB", "pipe": "a device or pipe",
        ".": "Is a directory", "null\0byte": "no file can have this name", "n" * 300: "too long",
    }  # fmt: skip
    for name, says in wrong.items():
        with pytest.raises(ModelError, match=says) as error:
            read_text(tmp_path / name, "the text", raises=ModelError)
        assert sentence(error).startswith(f"cannot read the text {printable(tmp_path / name)}: ")
    for device in ("/dev/zero", "/dev/null"):
        with pytest.raises(FileError, match="a device or pipe"):
            read_input(device, "the text")


def test_a_set_is_published_whole(tmp_path):
    out = tmp_path / "new" / "out"
    with staged_folder(out, OUTPUTS) as staging:
        assert staging.parent == out
        (staging / "plan.npz").write_text("plan")
        (staging / "report.html").write_text("report")
        assert [path for path in out.iterdir() if not path.name.startswith(".")] == []
    assert contents(out) == {"plan.npz": "plan", "report.html": "report"}


def test_a_stale_output_goes_and_a_strangers_file_stays(tmp_path):
    for name in ("plan.npz", "video.mp4", "notes.txt"):
        (tmp_path / name).write_text("old")
    with staged_folder(tmp_path, OUTPUTS) as staging:
        (staging / "plan.npz").write_text("new")
    assert contents(tmp_path) == {"notes.txt": "old", "plan.npz": "new"}


@pytest.mark.parametrize("exception", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_the_older_set(tmp_path, exception):
    before = {"plan.npz": "old", "video.mp4": "old"}
    for name, text in before.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(exception):
        write_set(tmp_path, {"plan.npz": b"new"}, raises=exception)
    assert contents(tmp_path) == before


def test_an_exception_removes_the_folders_it_created(tmp_path):
    (tmp_path / "kept").mkdir()
    with pytest.raises(RuntimeError):
        write_set(tmp_path / "kept" / "a" / "b", {"plan.npz": b"new"}, raises=RuntimeError)
    assert contents(tmp_path) == {"kept": None}


def test_a_folder_someone_else_used_meanwhile_stays(tmp_path):
    def work():
        with staged_folder(tmp_path / "out"):
            (tmp_path / "out" / "notes.txt").write_text("theirs")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        work()
    assert contents(tmp_path) == {"out": None, "out/notes.txt": "theirs"}


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("file", r"file' is a file, expected a folder"),
        ("file/out", r"file' is a file, expected a folder"),
        ("n" * 300, r"the name is too long"),
        ("nul\0l", r"null character"),
        ("taken", r"plan.npz': it is a folder, expected the name of a file"),
        pytest.param("/dev/null", r"is a file, expected a folder", marks=linux),
        pytest.param("/proc/out", r"does not let anything be created there", marks=linux),
    ],
)
def test_an_impossible_folder_fails_before_any_work(tmp_path, path, says):
    (tmp_path / "file").write_text("untouched")
    (tmp_path / "taken" / "plan.npz").mkdir(parents=True)
    reached = False
    with pytest.raises(FileError, match=says) as error, staged_folder(tmp_path / path, OUTPUTS):
        reached = True
    assert not reached
    assert sentence(error).startswith("cannot write '")
    assert contents(tmp_path) == {"file": "untouched", "taken": None, "taken/plan.npz": None}


def test_a_device_that_fails_while_publishing_leaves_the_older_set(tmp_path, monkeypatch):
    def fsync(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "video.mp4").write_text("old")
    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(FileError, match="no space left on device") as error:
        write_set(tmp_path, {"plan.npz": b"new"})
    assert str(tmp_path) in sentence(error)
    assert contents(tmp_path) == {"video.mp4": "old"}


def test_a_file_inside_a_set_is_named_without_the_hidden_folder(tmp_path):
    with pytest.raises(FileError) as error, staged_folder(tmp_path / "out") as staging:
        write_one(staging / "missing" / "plan.npz", b"")
    assert f"'{tmp_path}/out/missing'" in sentence(error)


# A full disk


@needs_mount
def test_a_full_disk_leaves_the_older_file(small_disk):
    target = small_disk / "plan.npz"
    target.write_text("old")
    with pytest.raises(FileError, match="no space left on device"):
        write_one(target, bytes(10**6))
    assert contents(small_disk) == {"plan.npz": "old"}


@needs_mount
def test_a_full_disk_leaves_the_older_set(small_disk):
    (small_disk / "plan.npz").write_text("old")
    with pytest.raises(FileError, match="no space left on device"):
        write_set(small_disk, {"plan.npz": b"new", "video.mp4": bytes(10**6)})
    assert contents(small_disk) == {"plan.npz": "old"}


@needs_mount
def test_a_writer_that_hides_the_cause_of_a_full_disk(small_disk):
    def work():
        with staged_folder(small_disk / "out", OUTPUTS) as staging:
            with (staging / "video.mp4").open("wb", buffering=0) as file, suppress(OSError):
                while file.write(bytes(4096)) == 4096:
                    pass
            raise OSError("4096 bytes requested and 512 written")

    with pytest.raises(FileError, match="no space left on device"):
        work()
    assert contents(small_disk) == {}


def test_a_file_that_is_not_there_is_answered_with_the_nearest_one(tmp_path):
    (tmp_path / "robot.xml").write_text("<mujoco/>")
    with pytest.raises(FileError, match=r"No such file or directory, expected .* write .*/robot\.xml\.$"):
        read_text(tmp_path / "robt.xml", "the model")
    with pytest.raises(FileError, match=r"expected a file that is there: .* has robot\.xml\.$"):  # no slip of the pen
        read_text(tmp_path / "reach.xml", "the model")
    with pytest.raises(FileError, match=r"there is no .*/arms, write a path from "):
        read_text(tmp_path / "arms" / "robot.xml", "the model")
