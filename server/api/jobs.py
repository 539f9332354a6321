"""What is done to queued work by hand; reading and retrying it stands with the rounds."""

from __future__ import annotations

from fastapi import APIRouter

from server import work
from server.api.access import Admin, UseServices, WriteSession
from server.api.params import PathId
from server.schemas.rounds import JobOut

router = APIRouter(tags=["rounds"])


@router.post("/jobs/{job_id}/cancel")
def cancel_job(job_id: PathId, me: Admin, session: WriteSession, services: UseServices) -> JobOut:
    """Stop a collection or a replay; its worker notices at its next step, and what is stored
    stays."""
    return JobOut.model_validate(work.cancel_job(session, services.clock(), job_id, by=me.id))
