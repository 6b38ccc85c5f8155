"""Files: inputs are read within bounds, and a result is there whole or the older one is there untouched.

A pipe or device in place of an input would be read forever, so an input is an ordinary file of a size that fits. An
output is written beside its place under a hidden name and moved there by os.replace, which is atomic in a file system.
Files that belong together are written into a hidden folder and published at the end. Every error names its path.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from planner.base.errors import FileError, PlannerError

PathLike = str | os.PathLike[str]

TEXT_LIMIT = 64 * 2**20  # bytes of an XML or TOML file
ASSET_LIMIT = 512 * 2**20  # bytes of a mesh, a texture or a height field

_HIDDEN = ".planner-"  # how the names of unfinished files and folders begin

# A disk counts as full below this many free bytes: some libraries report a failed write without its cause.
_FULL = 64 * 1024

# Complaints about the device. They come without a file name, since they happen to an open file.
_DEVICE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO, errno.ESTALE}

_SENTENCES = {
    errno.EACCES: "no permission; choose a place you may {verb}",
    errno.EPERM: "the system does not permit it; choose another place",
    errno.ENOSPC: "no space left on device; free some or choose another place",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another place",
    errno.EROFS: "the file system is read-only; choose a place you may {verb}",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.ELOOP: "its symbolic links form a loop; choose another place",
    errno.EFBIG: "the file grew beyond what the file system or a limit allows; choose another place",
    errno.EIO: "the device reports an input/output error; choose another place",
    errno.EMFILE: "too many files are open; close some or raise the limit (ulimit -n)",
}


def read_input(path: PathLike, what: str, *, most: int = ASSET_LIMIT, raises: type[PlannerError] = FileError) -> bytes:
    """The content of an ordinary file.

    Args:
        path: The file.
        what: What it is, for the message: "the model".
        most: Its size in bytes.
        raises: The kind of error for what cannot be read, is no ordinary file or is too large.
    """
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            state = os.fstat(file.fileno())
            if not stat.S_ISREG(state.st_mode):
                reason = "it is a device or pipe, expected an ordinary file"
            elif state.st_size > most:
                reason = f"it is larger than {most / 2**20:g} MB, expected less"
            else:
                return file.read()
    except OSError as error:
        reason = error.strerror or str(error)
    except ValueError:  # a null character, or others that no name can hold
        reason = "no file can have this name"
    raise raises(f"cannot read {what} {printable(path)}: {reason}.") from None


def read_text(path: PathLike, what: str, *, raises: type[PlannerError] = FileError) -> str:
    """The text of an ordinary file in UTF-8, of at most TEXT_LIMIT bytes; see read_input."""
    try:
        return read_input(path, what, most=TEXT_LIMIT, raises=raises).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise raises(f"cannot read {what} {printable(path)}: it is not text.") from None


def printable(path: PathLike) -> str:
    """A path for a message of one line: as it is, or quoted with its unprintable characters escaped."""
    return str(path) if str(path).isprintable() else repr(str(path))


@contextmanager
def write_atomically(path: PathLike) -> Iterator[Path]:
    """Yields a hidden path beside `path` to write to; on success that file takes the place of `path`.

    On any exception, KeyboardInterrupt included, the hidden file is removed and `path` stays as it was. The
    hidden file exists from the start, so that an unwritable folder fails before any work, and has the suffix
    of `path`, since many writers choose the format by it.

    Args:
        path: The file to write. A symbolic link is followed. Its folder must exist.

    Raises:
        FileError: `path` cannot be written: what was wrong and what was expected.
    """
    target = Path(path)
    try:
        # Through a link, the file it points at is the one to replace, not the link.
        place = Path(os.path.realpath(target))
        refuse_other_than_file(target)
        hidden = _new_file(place.parent, place.suffix)
    except FileError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise file_error(error, target) from error
    try:
        yield hidden
        _flush_to_device(hidden)
        os.replace(hidden, place)
    except OSError as error:
        if not _concerns(error, hidden, hidden.parent):
            raise
        raise file_error(error, target) from error
    finally:
        with suppress(OSError):  # after success there is nothing left to remove
            hidden.unlink()


@dataclass(frozen=True)
class StagedFolder:
    """A set of results in the making.

    Attributes:
        path: The hidden folder to write into.
        folder: Where its files go on success.
    """

    path: Path
    folder: Path


@contextmanager
def staged_folder(path: PathLike, outputs: Iterable[str] = ()) -> Iterator[StagedFolder]:
    """Yields a hidden folder inside `path`; on success its files move to `path`, one after the other.

    `path` and its missing parents are created at once, so that an unwritable one fails before any work. On
    any exception, KeyboardInterrupt included, what was created is removed and older results stay untouched.

    Args:
        path: The folder of the results.
        outputs: Names of all files that such a set may have. Those not produced this time are removed on
            success: the video of an older plan must not lie beside a new plan.

    Raises:
        FileError: The folder cannot be written: what was wrong and what was expected.
    """
    folder = Path(path)
    outputs = tuple(outputs)
    created: list[Path] = []
    try:
        created = missing_folders(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name in outputs:
            refuse_other_than_file(folder / name)
        staging = Path(tempfile.mkdtemp(prefix=_HIDDEN, dir=folder))
    except BaseException as error:
        remove_empty(created)
        if isinstance(error, FileError) or not isinstance(error, (OSError, ValueError)):
            raise
        raise file_error(error, folder, expected="folder") from error
    try:
        yield StagedFolder(staging, folder)
        _publish(staging, folder, outputs)
    except BaseException as error:
        complaint = None
        if isinstance(error, OSError) and _concerns(error, staging, folder):
            complaint = file_error(error, folder, expected="folder")  # before space is freed
        shutil.rmtree(staging, ignore_errors=True)
        remove_empty(created)
        if complaint is None:
            raise
        raise complaint from error
    shutil.rmtree(staging, ignore_errors=True)


def file_error(error: BaseException, path: PathLike, verb: str = "write", expected: str = "file") -> FileError:
    """The FileError that says in one sentence why `path` could not be written or read.

    Args:
        error: What the operating system said.
        path: The file or folder that was asked for.
        verb: "write" or "read".
        expected: "file" or "folder".
    """
    return FileError(f"Cannot {verb} {_shown(path)}: {_reason(error, Path(path), verb, expected)}.")


def _without_waiting(path: str, flags: int) -> int:
    """An opener that does not wait until someone opens the other end of a pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _reason(error: BaseException, path: Path, verb: str, expected: str) -> str:
    if "\0" in str(path):
        return "its name holds a null character; choose another name"
    number = error.errno if isinstance(error, OSError) else None
    if isinstance(error, OSError) and number is None and _full(path):
        number = errno.ENOSPC
    if number in (errno.ENOTDIR, errno.EEXIST):
        for parent in (*reversed(path.parents), path):
            if parent.exists() and not parent.is_dir():
                return f"{_shown(parent)} is a file, expected a folder"
    if number == errno.EISDIR:
        return "it is a folder, expected the name of a file"
    if number == errno.ENOENT:
        missing = missing_folders(path.parent)
        if missing:
            return f"the folder {_shown(missing[-1])} does not exist; create it or choose another"
        if verb == "read":
            return f"there is no such {expected}"
        return "this file system does not let anything be created there; choose another place"
    if number in _SENTENCES:
        return _SENTENCES[number].format(verb=verb)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror[0].lower()}{error.strerror[1:]}"
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")


def _concerns(error: OSError, hidden: Path, folder: Path) -> bool:
    """Whether an OSError raised by the caller's own code is about what it was writing.

    Others (a library that does not load, a closed pipe) pass unchanged: blaming the folder would mislead.
    """
    if error.filename is not None:
        names = (error.filename, error.filename2)
        return any(name is not None and str(hidden) in os.fsdecode(name) for name in names)
    return error.errno in _DEVICE or (error.errno is None and _full(folder))


def _publish(staging: Path, folder: Path, outputs: Iterable[str]) -> None:
    """Move the files of `staging` into `folder`."""
    files = sorted(file for file in staging.rglob("*") if file.is_file())
    names = [file.relative_to(staging) for file in files]
    for file, name in zip(files, names, strict=True):
        refuse_other_than_file(folder / name)
        _flush_to_device(file)
    # Old files go first: an interruption here leaves an old plan without its video, never a new plan with it.
    for name in {Path(output) for output in outputs} - set(names):
        (folder / name).unlink(missing_ok=True)
    for file, name in zip(files, names, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, folder / name)


def refuse_other_than_file(path: Path) -> None:
    """Raise FileError when something lies at `path` that os.replace must not replace, e.g. /dev/null."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    if stat.S_ISDIR(mode):
        raise FileError(f"Cannot write {_shown(path)}: it is a folder, expected the name of a file.")
    if not stat.S_ISREG(mode):
        raise FileError(f"Cannot write {_shown(path)}: it is a device or pipe, expected an ordinary file.")


def _new_file(folder: Path, suffix: str) -> Path:
    """A new empty file with a hidden name, and with the permissions that open() would give it."""
    path = folder / f"{_HIDDEN}{os.urandom(6).hex()}{suffix}"
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    return path


def _flush_to_device(path: Path) -> None:
    """Make sure that the content is on the device before its name is: some disks fail only here."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def missing_folders(folder: Path) -> list[Path]:
    """`folder` and its parents as far as they do not exist, innermost first."""
    return [path for path in (folder, *folder.parents) if not os.path.lexists(path)]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders, innermost first, as far as nothing is in them."""
    with suppress(OSError, ValueError):  # someone else may have put a file there meanwhile
        for folder in folders:
            folder.rmdir()


def _full(path: Path) -> bool:
    """Whether the file system that holds `path` is full."""
    for place in (path, *path.parents):
        with suppress(OSError, ValueError):
            return shutil.disk_usage(place).free < _FULL
    return False


def _shown(path: PathLike) -> str:
    """A path for a message: quoted, unprintable characters escaped, without the hidden folder it passes."""
    parts = [part for part in Path(path).parts if not part.startswith(_HIDDEN)]
    return repr(str(Path(*parts)))
