"""Checkpoints and episodes as files to take away, out of the artifact store."""

from __future__ import annotations

import re
from typing import Any

from fastapi import APIRouter, Request, Response, status
from fastapi.responses import FileResponse

from server.api.access import ReadSession, Staff, UseServices
from server.api.params import PathId
from server.api.services import Services
from server.checkpoints import get_checkpoint
from server.errors import ArtifactError, NotFoundError
from server.store.tables import Episode

FOR_EVER = "private, max-age=31536000, immutable"  # content-addressed files never change
MEDIA_TYPE = "application/octet-stream"
ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"content": {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}},
    206: {"description": "the part that `Range` asks for"},
    304: {"description": "the file with the ETag in `If-None-Match`"},
    416: {"description": "`Range` asks for what the file has not"},
}

router = APIRouter(tags=["files"])


@router.get("/checkpoints/{checkpoint_id}/file", response_class=FileResponse, responses=ANSWERS)
def checkpoint_file(
    checkpoint_id: PathId,
    _me: Staff,
    session: ReadSession,
    services: UseServices,
    request: Request,
) -> Response:
    """The checkpoint as the safetensors file that `rodif rollout --checkpoint` reads."""
    row = get_checkpoint(session, checkpoint_id)
    # A name is free text; in a file's name only what every system takes is left of it.
    plain = re.sub(r"[^\w.-]+", "-", row.name, flags=re.ASCII).strip("-.")
    name = f"{plain or f'checkpoint-{row.id}'}.safetensors"
    return _file(services, request, row.artifact_sha256, name, f"checkpoint {row.id}")


@router.get("/episodes/{episode_id}/file", response_class=FileResponse, responses=ANSWERS)
def episode_file(
    episode_id: PathId,
    _me: Staff,
    session: ReadSession,
    services: UseServices,
    request: Request,
) -> Response:
    """The episode as an npz file: what was seen and done, with all denoising chains."""
    row = session.get(Episode, episode_id)
    if row is None:
        raise NotFoundError("episode", episode_id)
    name = f"episode-{row.id}.npz"
    return _file(services, request, row.artifact_sha256, name, f"episode {row.id}")


def _file(services: Services, request: Request, sha256: str, name: str, what: str) -> Response:
    """Streamed, whole or in part; raises ArtifactError where the row's file is lost."""
    path = services.artifacts.path(sha256)
    if not path.is_file():
        raise ArtifactError(f"the file of {what} is lost: artifact {sha256} is missing")
    tag = f'"{sha256}"'
    headers = {"Cache-Control": FOR_EVER, "ETag": tag}
    if tag in re.split(r"\s*,\s*", request.headers.get("if-none-match", "")):
        return Response(status_code=status.HTTP_304_NOT_MODIFIED, headers=headers)
    return FileResponse(path, media_type=MEDIA_TYPE, filename=name, headers=headers)
