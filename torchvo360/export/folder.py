"""Folders that are either complete or absent."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_folder(final: Path) -> Iterator[Path]:
    """Yield a new folder to write to, which gets the final name on success and is removed on failure.

    It lies beside the final one, so that the renaming is one step. What bears the final name is replaced only then, and
    put back should that fail.

    Raises:
        OSError: It cannot be made or renamed.
    """
    final = final.absolute()
    made = [path for path in final.parents if not path.exists()]
    token = secrets.token_hex(4)
    temporary, before = (final.with_name(f".{final.name}.{token}.{kind}") for kind in ("part", "old"))
    try:
        temporary.mkdir(parents=True)
        yield temporary
        try:
            if final.exists():
                os.replace(final, before)
            os.replace(temporary, final)
        except BaseException:
            if before.exists() and not final.exists():
                os.replace(before, final)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        for path in made:
            with suppress(OSError):  # not empty: it was a success
                path.rmdir()
    _remove(before)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
