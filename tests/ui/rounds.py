"""Rounds as the worker leaves them behind, for the campaign page's tests."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import select

from rodif_core.evaluate import thin_path
from rodif_core.intervals import wilson_interval
from server import publications, rounds
from server.handout import Handout, next_pair
from server.labeling import ScreenChoice, Submission, submit_label
from server.sign_in import me_of
from server.states import JobKind, PublishRule, RoundState
from server.store.events import add_event
from server.store.tables import Annotator, Checkpoint, Job, Round
from tests.ui.studio import Studio, episodes


def evaluation(left: int, right: int, failed: int) -> dict[str, Any]:
    """An evaluation in the form of `Evaluation.to_json`, with real paths."""
    n, successes = left + right + failed, left + right
    names = ["left"] * left + ["right"] * right + ["failed"] * failed
    which = {"left": 0, "right": 1, "failed": 2}
    paths = [[point[:2] for point in thin_path(episodes()[which[name]])] for name in names]
    return {
        "n": n,
        "success": successes / n,
        "alignment": left / n,
        "alignment_of_successes": left / successes,
        "off_support": 0.01,
        "intervals": {
            "success": list(wilson_interval(successes, n)),
            "alignment": list(wilson_interval(left, n)),
            "alignment_of_successes": list(wilson_interval(left, successes)),
        },
        "groups": {"left": left, "right": right},
        "modes": {},
        "reasons": {"finished": successes, "collision": failed},
        "paths": paths,
        "path_groups": names,
    }


def label_all(
    studio: Studio, campaign_id: int, name: str, side: ScreenChoice, at_most: int = 1000
) -> int:
    """Label everything that is ready, past the browser; returns how many."""
    done = 0
    while done < at_most:
        now = datetime.now(UTC)
        with studio.database.write() as session:
            me = me_of(session.scalars(select(Annotator).where(Annotator.name == name)).one())
            found = next_pair(session, now, campaign_id, me.id, lease_for=timedelta(minutes=10))
            if not isinstance(found, Handout):
                return done
            answer = Submission(found.pair.id, side, duration_ms=4200 + 100 * done)
            submit_label(session, now, me, answer, idempotency_key=f"k{found.pair.id}")
            done += 1
    return done


class WorkerStandIn:
    """Does to one round's rows what the worker's jobs do, step by step."""

    def __init__(self, studio: Studio, round_id: int) -> None:
        self.studio, self.round_id = studio, round_id

    def start(self) -> None:
        """Claim the fine-tuning."""
        now = datetime.now(UTC)
        with self.studio.database.write() as session:
            self.job_id = session.scalars(
                select(Job.id).where(Job.round_id == self.round_id, Job.kind == JobKind.FINETUNE)
            ).one()
            rounds.move(session, now, self.round_id, RoundState.FINETUNING)

    def progress(self, stage: str, fraction: float, **metrics: float) -> None:
        """One point of the curves, and how far it is."""
        now = datetime.now(UTC)
        with self.studio.database.write() as session:
            campaign_id = session.get_one(Round, self.round_id).campaign_id
            where = {"campaign_id": campaign_id, "round_id": self.round_id, "job_id": self.job_id}
            session.get_one(Job, self.job_id).stage = stage
            session.get_one(Job, self.job_id).progress = fraction
            if metrics:
                point = {"stage": stage, "fraction": fraction, **metrics}
                add_event(session, now, kind="curve", data=point, **where)
            told = {"job_id": self.job_id, "kind": "finetune", "progress": fraction, "stage": stage}
            add_event(session, now, kind="job", data=told, **where)

    def finish(
        self, before: dict[str, Any], after: dict[str, Any], *, unchanged: str | None = None
    ) -> int:
        """Candidate, evaluation, gate, and publication if the round's rule is "auto"; returns the
        candidate's id. `unchanged`: why the candidate has its parent's weights, so that it is kept.
        """
        now = datetime.now(UTC)
        with self.studio.database.write() as session:
            this = session.get_one(Round, self.round_id)
            parent = session.get_one(Checkpoint, this.parent_checkpoint_id)
            candidate = Checkpoint(
                task=parent.task,
                name=f"{parent.task}-round-{self.round_id}",
                digest=f"{self.round_id:064x}",
                artifact_sha256="0" * 64,
                parent_id=parent.id,
                round_id=self.round_id,
                snapshot_digest=this.snapshot_digest,
                config=dict(parent.config),
                metrics={"finetune": {"stopped": unchanged}} if unchanged else {},
                code_version="test",
                created_at=now,
            )
            session.add(candidate)
            session.flush()
            this.noise = {
                "conservativeness": 0.3,
                "source": "estimated",
                "estimates": {"overlap": 0.25},
            }
            gate = {"passed": True, "unchanged": bool(unchanged), "reasons": ["success kept"]}
            this.result = {"before": before, "after": after, "gate": gate}
            for state in (RoundState.EVALUATING, RoundState.GATING):
                rounds.move(session, now, self.round_id, state)
            session.get_one(Job, self.job_id).state = "done"
            if unchanged or this.publish_rule != PublishRule.AUTO:
                rounds.move(session, now, self.round_id, RoundState.KEPT)
                return candidate.id
            publications.publish(
                session,
                now,
                campaign_id=this.campaign_id,
                checkpoint_id=candidate.id,
                reason="gate",
                by=None,
            )
            rounds.move(session, now, self.round_id, RoundState.PUBLISHED)
            return candidate.id
