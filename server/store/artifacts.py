"""Content-addressed files: `sha256/ab/cd/<hash>` below one folder, written once, never changed."""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from pathlib import Path

from server.errors import ArtifactError

_HASH = re.compile(r"[0-9a-f]{64}")


class ArtifactStore:
    """Bytes by their SHA-256 in a local folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, sha256: str) -> Path:
        """Where the file lies or would lie; raises ArtifactError when `sha256` is no hash."""
        if not _HASH.fullmatch(sha256):
            raise ArtifactError(f"{sha256!r} is not a SHA-256 (64 lower-case hexadecimal digits)")
        return self.root / "sha256" / sha256[:2] / sha256[2:4] / sha256

    def put(self, data: bytes) -> str:
        """Store `data` and return its hash. The name appears only when all bytes are on disk."""
        sha256 = hashlib.sha256(data).hexdigest()
        target = self.path(sha256)
        if target.exists():
            return sha256
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=".incoming-")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
        _sync_folder(target.parent)
        return sha256

    def get(self, sha256: str) -> bytes:
        """Read the bytes; raises ArtifactError when they are missing or have another hash."""
        try:
            data = self.path(sha256).read_bytes()
        except FileNotFoundError:
            raise ArtifactError(f"artifact {sha256} is missing below {self.root}") from None
        found = hashlib.sha256(data).hexdigest()
        if found != sha256:
            raise ArtifactError(
                f"artifact {sha256} is damaged: its {len(data)} bytes have SHA-256 {found}"
            )
        return data

    def exists(self, sha256: str) -> bool:
        """Whether the file is there (its content is checked by `get`)."""
        return self.path(sha256).is_file()


def _sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
