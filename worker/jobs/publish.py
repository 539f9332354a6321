"""The gate: publish the candidate, refuse it, or keep it for an admin."""

from __future__ import annotations

from sqlalchemy import select

from rodif_core.errors import LearningError
from rodif_core.gate import judge
from server import publications, rounds
from server.states import PublishRule, RoundState
from server.store.tables import Campaign, Checkpoint, Round
from worker.attempt import Attempt


def run(attempt: Attempt) -> None:
    """Judge, move the alias when the rule says so, and end the round, in one transaction."""
    round_id = attempt.facts.round_id
    assert round_id is not None
    with attempt.step() as session:
        this = session.get_one(Round, round_id)
        if this.result is None:
            raise LearningError(f"round {round_id} has no evaluation to judge")
        candidate = session.scalars(select(Checkpoint).where(Checkpoint.round_id == round_id)).one()
        parent = session.get_one(Checkpoint, this.parent_checkpoint_id)
        verdict = judge(this.result["before"], this.result["after"])
        campaign = session.get_one(Campaign, this.campaign_id, with_for_update=True)
        reasons = list(verdict.reasons)
        moved = campaign.published_checkpoint_id != this.parent_checkpoint_id
        if moved:
            reasons.append("the published policy has changed since the round began: not moved")
        unchanged = candidate.digest == parent.digest
        if unchanged:
            reasons.append(_why_unchanged(candidate))
        gate = {"passed": verdict.passed, "unchanged": unchanged, "reasons": reasons}
        this.result = this.result | {"gate": gate}
        state = _decide(
            PublishRule(this.publish_rule), passed=verdict.passed, held=moved or unchanged
        )
        now = attempt.bench.clock()
        if state == RoundState.PUBLISHED:
            publications.publish(
                session,
                now,
                campaign_id=this.campaign_id,
                checkpoint_id=candidate.id,
                reason=f"gate of round {round_id}: " + "; ".join(reasons),
                by=None,
            )
        rounds.move(session, now, round_id, state)
        attempt.finish(session, {"state": state.value, "gate": gate})


def _why_unchanged(candidate: Checkpoint) -> str:
    """Two evaluations of the same weights agree, so the gate passes them; nothing was learned."""
    why = candidate.metrics.get("finetune", {}).get("stopped")
    return "the candidate has its parent's weights: not moved" + (f" ({why})" if why else "")


def _decide(rule: PublishRule, *, passed: bool, held: bool) -> RoundState:
    """`held`: there is nothing new to publish, or somebody published or rolled back meanwhile,
    which the gate must not undo."""
    if rule is not PublishRule.AUTO:
        return RoundState.KEPT
    if not passed:
        return RoundState.REJECTED
    return RoundState.KEPT if held else RoundState.PUBLISHED
