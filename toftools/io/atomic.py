"""Files appear whole or not at all: temporary file beside the target, fsync, rename."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_path(target: Path | str) -> Iterator[Path]:
    """Path to write to; it becomes `target` only if the block ends without an error.

    Parameters
    ----------
    target : path
        Final file.

    Yields
    ------
    Path
        Temporary file in the same folder, with the same suffix.

    Raises
    ------
    ValueError
        If the folder does not exist or cannot be written, the target is a folder or a device, or
        the disk is full.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_path(folder / "a.txt") as path:
    ...     _ = path.write_text("whole")
    >>> sorted(p.name for p in folder.iterdir())
    ['a.txt']
    """
    target = Path(target).resolve()  # a link keeps pointing at what is replaced
    temporary = _temporary(target)
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        # mkstemp files are private; give the result the permissions any new file would get.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(target)
    except OSError as error:
        msg = f"cannot write {target}: {error.strerror or error}; nothing was left behind"
        raise ValueError(msg) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_target(target: Path | str) -> None:
    """Refuse a file that cannot be written, before the work that it is for.

    Parameters
    ----------
    target : path
        Final file.

    Raises
    ------
    ValueError
        As `atomic_path`, apart from the full disk.
    """
    _temporary(Path(target).resolve()).unlink()


def _temporary(target: Path) -> Path:
    """A new file beside the target."""
    if target.exists() and not target.is_file():
        msg = f"cannot write {target}: it is there and not a plain file; choose another name"
        raise ValueError(msg)
    try:
        handle, name = tempfile.mkstemp(
            dir=target.parent, prefix=f".{target.name}.", suffix=target.suffix
        )
        os.close(handle)
    except OSError as error:
        msg = f"cannot write {target}: {error.strerror or error}; choose a writable folder"
        raise ValueError(msg) from error
    return Path(name)
