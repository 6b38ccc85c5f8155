"""Read files of limited size, and write files atomically: a failure leaves the older file unchanged.

An input must be an ordinary file of limited size, because reading a pipe or device may never end. An output is written
under a hidden name in the target folder and renamed by os.replace, which is atomic. Every error names its path.
"""

from __future__ import annotations

import difflib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from planner.base.arguments import short_repr
from planner.base.environment import variables_set
from planner.base.errors import FileError, PlannerError

PathLike = str | os.PathLike[str]

TEXT_LIMIT = 64 * 2**20  # bytes of an XML or TOML file
ASSET_LIMIT = 512 * 2**20  # bytes of a mesh, a texture or a height field

_HIDDEN = ".planner-"  # prefix of the names of unfinished files and folders
_LOCK = f"{_HIDDEN}lock"
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}  # errors of file systems without locks
_FULL = 64 * 1024  # bytes; a disk with less counts as full, since some libraries report failed writes without a cause

_MAX_LISTED = 1000  # files of a folder that are compared with a misspelled name
_SIMILARITY = 0.7  # smallest similarity ratio (difflib) of a suggested name
_MAX_SHOWN = 5  # files of a folder that a message names

# Errors of the device, which come without a file name.
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


CONFINE = "PLANNER_CONFINE"
"""Variable of the environment, also of child processes: the folder beside the package outside of which nothing is read
as an input; see `confined`."""
_WRITTEN = "PLANNER_CONFINE_WRITTEN"  # the same: files that this process writes, a JSON list
_OWN = (Path(__file__).parents[1], Path(__file__).parents[2] / "mjcf")  # models of cases are inputs too


@contextmanager
def confined(folder: PathLike | None) -> Iterator[None]:
    """A context in which inputs outside of a folder are refused, links followed; None changes nothing.

    Raises:
        FileError: It is no folder.
    """
    if folder is not None and not os.path.isdir(folder):
        raise FileError(f"--confine is {printable(folder)}, expected an existing folder.")
    with variables_set({} if folder is None else {CONFINE: os.path.realpath(folder)}):
        yield


def also_reading(files: Iterable[PathLike]) -> AbstractContextManager[None]:
    """A context in which these files, which this process writes, may be read, too, where inputs are confined."""
    return variables_set({_WRITTEN: json.dumps([os.path.realpath(file) for file in files])})


def check_confined(path: PathLike, what: str, raises: type[PlannerError] = FileError) -> None:
    """Raise unless a file lies in the folder to which inputs are confined, or in the package."""
    folder = os.environ.get(CONFINE)
    if not folder or "\0" in os.fsdecode(path):  # no file can have that name
        return
    place = Path(os.path.realpath(path))
    written = str(place) in json.loads(os.environ.get(_WRITTEN, "[]"))
    if not written and not any(place.is_relative_to(root) for root in (folder, *_OWN)):
        raise raises(f"{what} {printable(path)} is outside of {printable(folder)}, expected a file in it (--confine).")


def read_input(path: PathLike, what: str, *, most: int = ASSET_LIMIT, raises: type[PlannerError] = FileError) -> bytes:
    """The content of an ordinary file of at most `most` bytes; messages call it `what`, e.g. "the model"."""
    check_confined(path, what, raises)
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
        reason += _instead(Path(os.fsdecode(path))) if error.errno == errno.ENOENT else ""
    except ValueError:  # a null character
        reason = "no file can have this name"
    raise raises(f"cannot read {what} {printable(path)}: {reason}.") from None


def _instead(path: Path) -> str:
    """Message part for a missing file: the most similar file name, or the existing part of the path."""
    folder = path.parent
    try:
        if folder.is_dir():
            named = "this folder" if folder == Path() else printable(folder)
            names = sorted(one.name for one in folder.iterdir() if one.suffix == path.suffix)[:_MAX_LISTED]
            similar = difflib.get_close_matches(path.name, names, n=1, cutoff=_SIMILARITY)
            if similar:
                return f", expected the name of a file that is there: write {printable(folder / similar[0])}"
            few = ", ".join(printable(name) for name in names[:_MAX_SHOWN]) + ", ..." * (len(names) > _MAX_SHOWN)
            there = f"has {few}" if names else f"has none that ends in {path.suffix or 'that'}"
            return f", expected a file that is there: {named} {there}"
        there = next(one for one in folder.parents if one.is_dir())
    except (OSError, StopIteration):
        return ""
    missing = there / folder.relative_to(there).parts[0]
    from_where = "this folder" if there == Path() else printable(there)
    return f", expected an existing folder: there is no {printable(missing)}, write a path from {from_where}"


def read_text(path: PathLike, what: str, *, raises: type[PlannerError] = FileError) -> str:
    """The UTF-8 text of an ordinary file of at most TEXT_LIMIT bytes; see read_input."""
    try:
        return read_input(path, what, most=TEXT_LIMIT, raises=raises).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise raises(f"cannot read {what} {printable(path)}: it is not text.") from None


def as_path(path: PathLike) -> Path:
    """The path of a file to write.

    Raises:
        FileError: The value is not a path.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise FileError(f"cannot write to {short_repr(path)}: expected the path of a file.")
    return Path(path)


def printable(path: PathLike) -> str:
    """A path for a message: unchanged, or quoted with escapes if it has unprintable characters."""
    return str(path) if str(path).isprintable() else repr(str(path))


PLANS = "a folder of plans or a plan.npz"


def check_exists(path: PathLike, expected: str) -> None:
    """FileError where there is no file or folder of this name; `expected` says what would have been right."""
    if not os.path.exists(path):  # Path.exists() raises OSError for long names
        raise FileError(f"{printable(path)} does not exist, expected {expected}.")


@contextmanager
def write_atomically(path: PathLike) -> Iterator[Path]:
    """Yield a hidden path in the folder of `path`; on success it replaces `path`, on any exception it is removed.

    The hidden file is created first, so that an unwritable folder fails before any work. It has the suffix of
    `path`, by which many writers choose the format. The folder of `path` must exist.

    Raises:
        FileError: `path` cannot be written.
    """
    target = as_path(path)
    try:
        place = Path(os.path.realpath(target))  # replace the target of a symbolic link, not the link
        _refuse_other_than_file(target)
        hidden = place.parent / f"{_HIDDEN}{os.urandom(6).hex()}{place.suffix}"
        os.close(os.open(hidden, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # default permissions
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
        with suppress(OSError):  # after success it does not exist
            hidden.unlink()


def open_folder(folder: Path, outputs: Iterable[str]) -> tuple[Path, list[Path]]:
    """Create a folder for files named `outputs`, and a hidden folder in it, so that an unwritable one fails first.

    Returns:
        The hidden folder, and the folders that were created, innermost first.

    Raises:
        FileError: The folder cannot be written: what was wrong and what was expected.
    """
    created: list[Path] = []
    try:
        created = _missing_folders(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name in outputs:
            _refuse_other_than_file(folder / name)
        return Path(tempfile.mkdtemp(prefix=_HIDDEN, dir=folder)), created
    except BaseException as error:
        remove_empty(created)
        if isinstance(error, FileError) or not isinstance(error, (OSError, ValueError)):
            raise
        raise file_error(error, folder, expected="folder") from error


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Lock a folder, so that the files of two processes do not mix; the system unlocks it when a process is killed.

    Raises:
        FileError: Another process has locked it, or it cannot be written.
    """
    lock = folder / _LOCK
    try:
        handle = _locked(lock)
    except BlockingIOError:
        reason = "another planner is writing into it; wait for its end or choose another folder"
        raise FileError(f"cannot write {_quoted(folder)}: {reason}.") from None
    except OSError as error:
        raise file_error(error, folder, expected="folder") from error
    try:
        yield
    finally:
        with suppress(OSError):
            lock.unlink()
        os.close(handle)


def _locked(path: Path) -> int:
    """File descriptor of a file that this process has locked exclusively."""
    while True:
        handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return handle
            os.close(handle)
            raise
        if os.fstat(handle).st_nlink:
            return handle
        os.close(handle)  # the previous owner has removed it after os.open


@contextmanager
def staged_folder(path: PathLike, outputs: Iterable[str] = ()) -> Iterator[Path]:
    """Yield a hidden folder inside `path`; on success its files move to `path`, one after the other.

    On any exception the created files and folders are removed and older results are unchanged. On success older files
    named in `outputs` are removed, so that the video of an older plan does not remain with a new plan.

    Raises:
        FileError: The folder cannot be written: what was wrong and what was expected.
    """
    folder, outputs = Path(path), tuple(outputs)
    staging, created = open_folder(folder, outputs)
    try:
        with folder_lock(folder):  # another writer fails before any work
            pass
        yield staging
        with folder_lock(folder):
            _publish(staging, folder, outputs)
    except BaseException as error:
        complaint = None
        if isinstance(error, OSError) and _concerns(error, staging, folder):
            complaint = file_error(error, folder, expected="folder")  # before rmtree frees space
        shutil.rmtree(staging, ignore_errors=True)
        remove_empty(created)
        if complaint is None:
            raise
        raise complaint from error
    shutil.rmtree(staging, ignore_errors=True)


def file_error(error: BaseException, path: PathLike, verb: str = "write", expected: str = "file") -> FileError:
    """The FileError with the cause why the file or folder `path` cannot be written or read (`verb`)."""
    return FileError(f"cannot {verb} {_quoted(path)}: {_reason(error, Path(path), verb, expected)}.")


def _without_waiting(path: str, flags: int) -> int:
    """Open a file without waiting for the other end of a pipe."""
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
                return f"{_quoted(parent)} is a file, expected a folder"
    if number == errno.EISDIR:
        return "it is a folder, expected the name of a file"
    if number == errno.ENOENT:
        missing = _missing_folders(path.parent)
        if missing:
            return f"the folder {_quoted(missing[-1])} does not exist; create it or choose another"
        if verb == "read":
            return f"there is no such {expected}"
        return "this file system does not let anything be created there; choose another place"
    if number in _SENTENCES:
        return _SENTENCES[number].format(verb=verb)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror[0].lower()}{error.strerror[1:]}"
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")


def _concerns(error: OSError, hidden: Path, folder: Path) -> bool:
    """Whether an OSError of the caller's code concerns the file it wrote and not, e.g., a closed pipe."""
    if error.filename is not None:
        names = (error.filename, error.filename2)
        return any(name is not None and str(hidden) in os.fsdecode(name) for name in names)
    return error.errno in _DEVICE or (error.errno is None and _full(folder))


def _publish(staging: Path, folder: Path, outputs: Iterable[str]) -> None:
    """Move the files of `staging` into `folder`."""
    files = sorted(file for file in staging.rglob("*") if file.is_file())
    names = [file.relative_to(staging) for file in files]
    for file, name in zip(files, names, strict=True):
        _refuse_other_than_file(folder / name)
        _flush_to_device(file)
    # Remove old files first: an interruption may leave an old plan without its video, never a new plan with it.
    for name in {Path(output) for output in outputs} - set(names):
        (folder / name).unlink(missing_ok=True)
    for file, name in zip(files, names, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, folder / name)


def _refuse_other_than_file(path: Path) -> None:
    """Raise FileError if `path` is a folder, a device or a pipe, which os.replace must not replace."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISREG(mode):
        found = "folder, expected the name of a" if stat.S_ISDIR(mode) else "device or pipe, expected an ordinary"
        raise FileError(f"cannot write {_quoted(path)}: it is a {found} file.")


def _flush_to_device(path: Path) -> None:
    """Flush the content to the device before the rename: some disks report errors only here."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def _missing_folders(folder: Path) -> list[Path]:
    """`folder` and its parents that do not exist, innermost first."""
    return [path for path in (folder, *folder.parents) if not os.path.lexists(path)]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove empty folders, innermost first."""
    with suppress(OSError, ValueError):  # another process may have put a file there
        for folder in folders:
            folder.rmdir()


def _full(path: Path) -> bool:
    """Whether the file system of `path` is full."""
    for place in (path, *path.parents):
        with suppress(OSError, ValueError):
            return shutil.disk_usage(place).free < _FULL
    return False


def _quoted(path: PathLike) -> str:
    """A path for a message: quoted, with escapes, without hidden folders."""
    parts = [part for part in Path(path).parts if not part.startswith(_HIDDEN)]
    return repr(str(Path(*parts)))


def digest_of(content: bytes) -> str:
    """32 hexadecimal digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:32]
