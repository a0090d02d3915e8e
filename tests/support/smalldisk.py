"""A small disk that can be filled, made larger and made read-only; for root."""

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class Disk:
    """A file system in memory."""

    def __init__(self, path: Path, megabytes: int) -> None:
        self.path = path
        path.mkdir()
        made = _mount("-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(path))
        if made.returncode != 0:
            pytest.skip("a small disk cannot be mounted here")

    @property
    def full(self) -> bool:
        """Whether hardly anything fits on it any more."""
        found = os.statvfs(self.path)
        return found.f_bavail * found.f_frsize < 64 * 1024

    def remount(self, *options: str) -> None:
        """It is busy until what was killed is gone altogether."""
        for _ in range(200):
            made = _mount("-o", ",".join(("remount", *options)), str(self.path))
            if made.returncode == 0:
                return
            time.sleep(0.05)
        raise AssertionError(made.stderr.decode())

    def fill(self) -> None:
        """With something else, to the last byte."""
        with (self.path / "ballast").open("wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                return

    def clear(self) -> None:
        (self.path / "ballast").unlink()


def _mount(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(["mount", *arguments], check=False, capture_output=True)


@contextmanager
def small_disk(path: Path, megabytes: int) -> Iterator[Disk]:
    """Mounted there; without the right to mount the test is skipped."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root may mount a small disk")
    disk = Disk(path, megabytes)
    try:
        yield disk
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)
