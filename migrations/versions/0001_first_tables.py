"""first tables."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


# Tables that point at each other in a circle. SQLite takes a reference to a table that does not
# exist yet, but cannot add one later; PostgreSQL the other way round.
CIRCULAR = {
    "fk_checkpoint_round_id_round": ("checkpoint", "round_id", "round", "id"),
    "fk_checkpoint_snapshot_digest_label_snapshot": (
        "checkpoint",
        "snapshot_digest",
        "label_snapshot",
        "digest",
    ),
    "fk_round_parent_checkpoint_id_checkpoint": (
        "round",
        "parent_checkpoint_id",
        "checkpoint",
        "id",
    ),
    "fk_job_pair_id_pair": ("job", "pair_id", "pair", "id"),
}
APPEND_ONLY = ("label", "simulated_truth", "publication", "audit_entry", "event")
UTC = sa.DateTime(timezone=True)


def _on_sqlite() -> bool:
    return op.get_context().dialect.name == "sqlite"


def _late_foreign_key(name: str) -> list[sa.ForeignKeyConstraint]:
    if not _on_sqlite():
        return []
    _table, column, other, other_column = CIRCULAR[name]
    return [sa.ForeignKeyConstraint([column], [f"{other}.{other_column}"], name=name)]


def _add_circular_foreign_keys() -> None:
    if not _on_sqlite():
        for name, (table, column, other, other_column) in CIRCULAR.items():
            op.create_foreign_key(name, table, other, [column], [other_column])


def _protect_append_only() -> None:
    """Let the database itself refuse to change or delete what must stay for ever."""
    if _on_sqlite():
        for table in APPEND_ONLY:
            for action in ("UPDATE", "DELETE"):
                op.execute(
                    f"CREATE TRIGGER {table}_no_{action.lower()} BEFORE {action} ON {table}"
                    f" BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
                )
        return
    op.execute(
        "CREATE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS"
        " $$ BEGIN RAISE EXCEPTION '% is append-only', TG_TABLE_NAME; END $$"
    )
    for table in APPEND_ONLY:
        op.execute(
            f"CREATE TRIGGER {table}_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON {table}"
            " FOR EACH STATEMENT EXECUTE FUNCTION refuse_change()"
        )


def upgrade() -> None:
    """Create all tables, then what the databases themselves must guard."""
    op.create_table(
        "annotator",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("role", sa.String(length=16), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("password_hash", sa.Text(), nullable=True),
        sa.Column("active", sa.Boolean(), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_annotator"),
        sa.UniqueConstraint("name", name="uq_annotator_name"),
    )
    op.create_table(
        "checkpoint",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("task", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=128), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("artifact_sha256", sa.String(length=64), nullable=False),
        sa.Column("parent_id", sa.Integer(), nullable=True),
        sa.Column("round_id", sa.Integer(), nullable=True),
        sa.Column("snapshot_digest", sa.String(length=64), nullable=True),
        sa.Column("config", sa.JSON(), nullable=False),
        sa.Column("metrics", sa.JSON(), nullable=False),
        sa.Column("code_version", sa.String(length=64), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.ForeignKeyConstraint(
            ["parent_id"], ["checkpoint.id"], name="fk_checkpoint_parent_id_checkpoint"
        ),
        *_late_foreign_key("fk_checkpoint_round_id_round"),
        *_late_foreign_key("fk_checkpoint_snapshot_digest_label_snapshot"),
        sa.PrimaryKeyConstraint("id", name="pk_checkpoint"),
        sa.UniqueConstraint("name", name="uq_checkpoint_name"),
        sa.UniqueConstraint("round_id", name="uq_checkpoint_round_id"),
    )
    op.create_table(
        "service_beat",
        sa.Column("name", sa.String(length=128), nullable=False),
        sa.Column("at", UTC, nullable=False),
        sa.Column("details", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_service_beat"),
    )
    op.create_table(
        "sign_in_attempt",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("address", sa.String(length=64), nullable=False),
        sa.Column("at", UTC, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_sign_in_attempt"),
    )
    op.create_index("ix_sign_in_attempt_address", "sign_in_attempt", ["address"])
    op.create_index("ix_sign_in_attempt_name", "sign_in_attempt", ["name"])

    op.create_table(
        "api_token",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("annotator_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("token_sha256", sa.String(length=64), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.Column("expires_at", UTC, nullable=False),
        sa.Column("last_used_at", UTC, nullable=True),
        sa.Column("revoked_at", UTC, nullable=True),
        sa.ForeignKeyConstraint(
            ["annotator_id"], ["annotator.id"], name="fk_api_token_annotator_id_annotator"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_api_token"),
        sa.UniqueConstraint("token_sha256", name="uq_api_token_token_sha256"),
    )
    op.create_table(
        "audit_entry",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("actor_id", sa.Integer(), nullable=True),
        sa.Column("action", sa.String(length=64), nullable=False),
        sa.Column("subject", sa.String(length=128), nullable=False),
        sa.Column("details", sa.JSON(), nullable=False),
        sa.Column("at", UTC, nullable=False),
        sa.ForeignKeyConstraint(
            ["actor_id"], ["annotator.id"], name="fk_audit_entry_actor_id_annotator"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_audit_entry"),
    )
    op.create_table(
        "browser_session",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("annotator_id", sa.Integer(), nullable=False),
        sa.Column("token_sha256", sa.String(length=64), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.Column("expires_at", UTC, nullable=False),
        sa.Column("revoked_at", UTC, nullable=True),
        sa.ForeignKeyConstraint(
            ["annotator_id"], ["annotator.id"], name="fk_browser_session_annotator_id_annotator"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_browser_session"),
        sa.UniqueConstraint("token_sha256", name="uq_browser_session_token_sha256"),
    )
    op.create_table(
        "campaign",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=128), nullable=False),
        sa.Column("task", sa.String(length=32), nullable=False),
        sa.Column("criterion", sa.Text(), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("start_checkpoint_id", sa.Integer(), nullable=False),
        sa.Column("published_checkpoint_id", sa.Integer(), nullable=False),
        sa.Column("archived", sa.Boolean(), nullable=False),
        sa.Column("created_by", sa.Integer(), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.ForeignKeyConstraint(
            ["created_by"], ["annotator.id"], name="fk_campaign_created_by_annotator"
        ),
        sa.ForeignKeyConstraint(
            ["published_checkpoint_id"],
            ["checkpoint.id"],
            name="fk_campaign_published_checkpoint_id_checkpoint",
        ),
        sa.ForeignKeyConstraint(
            ["start_checkpoint_id"],
            ["checkpoint.id"],
            name="fk_campaign_start_checkpoint_id_checkpoint",
        ),
        sa.PrimaryKeyConstraint("id", name="pk_campaign"),
        sa.UniqueConstraint("name", name="uq_campaign_name"),
    )
    op.create_table(
        "label_snapshot",
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("label_ids", sa.JSON(), nullable=False),
        sa.Column("size", sa.Integer(), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_label_snapshot_campaign_id_campaign"
        ),
        sa.PrimaryKeyConstraint("digest", name="pk_label_snapshot"),
    )
    op.create_index("ix_label_snapshot_campaign_id", "label_snapshot", ["campaign_id"])

    op.create_table(
        "publication",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("checkpoint_id", sa.Integer(), nullable=False),
        sa.Column("previous_checkpoint_id", sa.Integer(), nullable=True),
        sa.Column("action", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("by_annotator_id", sa.Integer(), nullable=True),
        sa.Column("at", UTC, nullable=False),
        sa.ForeignKeyConstraint(
            ["by_annotator_id"], ["annotator.id"], name="fk_publication_by_annotator_id_annotator"
        ),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_publication_campaign_id_campaign"
        ),
        sa.ForeignKeyConstraint(
            ["checkpoint_id"], ["checkpoint.id"], name="fk_publication_checkpoint_id_checkpoint"
        ),
        sa.ForeignKeyConstraint(
            ["previous_checkpoint_id"],
            ["checkpoint.id"],
            name="fk_publication_previous_checkpoint_id_checkpoint",
        ),
        sa.PrimaryKeyConstraint("id", name="pk_publication"),
    )
    op.create_index("ix_publication_campaign_id", "publication", ["campaign_id"])

    op.create_table(
        "round",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("parent_checkpoint_id", sa.Integer(), nullable=False),
        sa.Column("snapshot_digest", sa.String(length=64), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("trigger", sa.String(length=16), nullable=False),
        sa.Column("publish_rule", sa.String(length=16), nullable=False),
        sa.Column("config", sa.JSON(), nullable=False),
        sa.Column("evaluation", sa.JSON(), nullable=False),
        sa.Column("noise", sa.JSON(), nullable=True),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("started_by", sa.Integer(), nullable=True),
        sa.Column("created_at", UTC, nullable=False),
        sa.Column("finished_at", UTC, nullable=True),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_round_campaign_id_campaign"
        ),
        *_late_foreign_key("fk_round_parent_checkpoint_id_checkpoint"),
        sa.ForeignKeyConstraint(
            ["snapshot_digest"],
            ["label_snapshot.digest"],
            name="fk_round_snapshot_digest_label_snapshot",
        ),
        sa.ForeignKeyConstraint(
            ["started_by"], ["annotator.id"], name="fk_round_started_by_annotator"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_round"),
    )
    op.create_index("ix_round_campaign_id", "round", ["campaign_id"])

    op.create_table(
        "job",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("round_id", sa.Integer(), nullable=True),
        sa.Column("pair_id", sa.Integer(), nullable=True),
        sa.Column("payload", sa.JSON(), nullable=False),
        sa.Column("dedupe_key", sa.String(length=128), nullable=True),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("max_attempts", sa.Integer(), nullable=False),
        sa.Column("owner", sa.String(length=128), nullable=True),
        sa.Column("lease_expires_at", UTC, nullable=True),
        sa.Column("sent_at", UTC, nullable=True),
        sa.Column("progress", sa.Float(), nullable=False),
        sa.Column("stage", sa.String(length=64), nullable=False),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("created_by", sa.Integer(), nullable=True),
        sa.Column("created_at", UTC, nullable=False),
        sa.Column("started_at", UTC, nullable=True),
        sa.Column("finished_at", UTC, nullable=True),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_job_campaign_id_campaign"
        ),
        sa.ForeignKeyConstraint(
            ["created_by"], ["annotator.id"], name="fk_job_created_by_annotator"
        ),
        *_late_foreign_key("fk_job_pair_id_pair"),
        sa.ForeignKeyConstraint(["round_id"], ["round.id"], name="fk_job_round_id_round"),
        sa.PrimaryKeyConstraint("id", name="pk_job"),
        sa.UniqueConstraint("dedupe_key", name="uq_job_dedupe_key"),
    )
    op.create_index("ix_job_campaign_id", "job", ["campaign_id"])
    op.create_index("ix_job_round_id", "job", ["round_id"])
    op.create_index("ix_job_state_lease", "job", ["state", "lease_expires_at"])

    op.create_table(
        "episode",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("checkpoint_id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.Integer(), nullable=False),
        sa.Column("seed", sa.BigInteger(), nullable=False),
        sa.Column("artifact_sha256", sa.String(length=64), nullable=False),
        sa.Column("steps", sa.Integer(), nullable=False),
        sa.Column("success", sa.Boolean(), nullable=False),
        sa.Column("mode", sa.String(length=64), nullable=True),
        sa.Column("behaviour_group", sa.String(length=64), nullable=True),
        sa.Column("outcome", sa.JSON(), nullable=False),
        sa.Column("path", sa.JSON(), nullable=False),
        sa.Column("mujoco_version", sa.String(length=16), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_episode_campaign_id_campaign"
        ),
        sa.ForeignKeyConstraint(
            ["checkpoint_id"], ["checkpoint.id"], name="fk_episode_checkpoint_id_checkpoint"
        ),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_episode_job_id_job"),
        sa.PrimaryKeyConstraint("id", name="pk_episode"),
        sa.UniqueConstraint(
            "campaign_id", "checkpoint_id", "seed", name="uq_episode_campaign_id_checkpoint_id_seed"
        ),
    )
    op.create_index("ix_episode_campaign_id", "episode", ["campaign_id"])
    op.create_index("ix_episode_checkpoint_id", "episode", ["checkpoint_id"])

    op.create_table(
        "event",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("round_id", sa.Integer(), nullable=True),
        sa.Column("job_id", sa.Integer(), nullable=True),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.Column("at", UTC, nullable=False),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_event_campaign_id_campaign"
        ),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_event_job_id_job"),
        sa.ForeignKeyConstraint(["round_id"], ["round.id"], name="fk_event_round_id_round"),
        sa.PrimaryKeyConstraint("id", name="pk_event"),
    )
    op.create_index("ix_event_campaign_id", "event", ["campaign_id"])
    op.create_index("ix_event_round_id", "event", ["round_id"])

    op.create_table(
        "pair",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("first_episode_id", sa.Integer(), nullable=False),
        sa.Column("second_episode_id", sa.Integer(), nullable=False),
        sa.Column("first_is_left", sa.Boolean(), nullable=False),
        sa.Column("reason", sa.String(length=64), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("replay_sha256", sa.String(length=64), nullable=True),
        sa.Column("thumbnail_sha256", sa.String(length=64), nullable=True),
        sa.Column("created_at", UTC, nullable=False),
        sa.CheckConstraint("first_episode_id <> second_episode_id", name="ck_pair_two_episodes"),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_pair_campaign_id_campaign"
        ),
        sa.ForeignKeyConstraint(
            ["first_episode_id"], ["episode.id"], name="fk_pair_first_episode_id_episode"
        ),
        sa.ForeignKeyConstraint(
            ["second_episode_id"], ["episode.id"], name="fk_pair_second_episode_id_episode"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_pair"),
        sa.UniqueConstraint(
            "campaign_id",
            "first_episode_id",
            "second_episode_id",
            name="uq_pair_campaign_id_first_episode_id_second_episode_id",
        ),
    )
    op.create_index("ix_pair_campaign_id", "pair", ["campaign_id"])

    op.create_table(
        "lease",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("pair_id", sa.Integer(), nullable=False),
        sa.Column("annotator_id", sa.Integer(), nullable=False),
        sa.Column("issued_at", UTC, nullable=False),
        sa.Column("expires_at", UTC, nullable=False),
        sa.Column("closed_at", UTC, nullable=True),
        sa.ForeignKeyConstraint(
            ["annotator_id"], ["annotator.id"], name="fk_lease_annotator_id_annotator"
        ),
        sa.ForeignKeyConstraint(["pair_id"], ["pair.id"], name="fk_lease_pair_id_pair"),
        sa.PrimaryKeyConstraint("id", name="pk_lease"),
    )
    op.create_index("ix_lease_annotator_id", "lease", ["annotator_id"])
    op.create_index("ix_lease_pair_id_expires_at", "lease", ["pair_id", "expires_at"])

    op.create_table(
        "label",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("pair_id", sa.Integer(), nullable=False),
        sa.Column("annotator_id", sa.Integer(), nullable=False),
        sa.Column("choice", sa.String(length=16), nullable=False),
        sa.Column("retracted", sa.Boolean(), nullable=False),
        sa.Column("supersedes_id", sa.Integer(), nullable=True),
        sa.Column("left_episode_id", sa.Integer(), nullable=False),
        sa.Column("right_episode_id", sa.Integer(), nullable=False),
        sa.Column("first_checkpoint_id", sa.Integer(), nullable=False),
        sa.Column("second_checkpoint_id", sa.Integer(), nullable=False),
        sa.Column("pair_reason", sa.String(length=64), nullable=False),
        sa.Column("lease_id", sa.Integer(), nullable=True),
        sa.Column("late", sa.Boolean(), nullable=False),
        sa.Column("source", sa.String(length=16), nullable=False),
        sa.Column("idempotency_key", sa.String(length=64), nullable=False),
        sa.Column("request_sha256", sa.String(length=64), nullable=False),
        sa.Column("created_at", UTC, nullable=False),
        sa.Column("client_time", UTC, nullable=True),
        sa.Column("duration_ms", sa.Integer(), nullable=True),
        sa.Column("active_ms", sa.Integer(), nullable=True),
        sa.Column("replay_events", sa.JSON(), nullable=False),
        sa.Column("ui_version", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(
            ["annotator_id"], ["annotator.id"], name="fk_label_annotator_id_annotator"
        ),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name="fk_label_campaign_id_campaign"
        ),
        sa.ForeignKeyConstraint(
            ["first_checkpoint_id"],
            ["checkpoint.id"],
            name="fk_label_first_checkpoint_id_checkpoint",
        ),
        sa.ForeignKeyConstraint(["lease_id"], ["lease.id"], name="fk_label_lease_id_lease"),
        sa.ForeignKeyConstraint(
            ["left_episode_id"], ["episode.id"], name="fk_label_left_episode_id_episode"
        ),
        sa.ForeignKeyConstraint(["pair_id"], ["pair.id"], name="fk_label_pair_id_pair"),
        sa.ForeignKeyConstraint(
            ["right_episode_id"], ["episode.id"], name="fk_label_right_episode_id_episode"
        ),
        sa.ForeignKeyConstraint(
            ["second_checkpoint_id"],
            ["checkpoint.id"],
            name="fk_label_second_checkpoint_id_checkpoint",
        ),
        sa.ForeignKeyConstraint(
            ["supersedes_id"], ["label.id"], name="fk_label_supersedes_id_label"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_label"),
        sa.UniqueConstraint(
            "annotator_id", "idempotency_key", name="uq_label_annotator_id_idempotency_key"
        ),
        sa.UniqueConstraint("supersedes_id", name="uq_label_supersedes_id"),
    )
    op.create_index("ix_label_annotator_id", "label", ["annotator_id"])
    op.create_index("ix_label_campaign_id", "label", ["campaign_id"])
    op.create_index("ix_label_pair_id", "label", ["pair_id"])

    op.create_table(
        "simulated_truth",
        sa.Column("label_id", sa.Integer(), nullable=False),
        sa.Column("true_choice", sa.String(length=16), nullable=False),
        sa.Column("corrupted", sa.Boolean(), nullable=False),
        sa.Column("corruption", sa.String(length=32), nullable=False),
        sa.Column("criterion", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["label_id"], ["label.id"], name="fk_simulated_truth_label_id_label"
        ),
        sa.PrimaryKeyConstraint("label_id", name="pk_simulated_truth"),
    )
    _add_circular_foreign_keys()
    _protect_append_only()


def downgrade() -> None:
    """Remove everything."""
    if not _on_sqlite():
        for name, (table, *_rest) in CIRCULAR.items():
            op.drop_constraint(name, table, type_="foreignkey")
    op.drop_table("simulated_truth")

    op.drop_table("label")

    op.drop_table("lease")

    op.drop_table("pair")

    op.drop_table("event")

    op.drop_table("episode")

    op.drop_table("job")

    op.drop_table("round")

    op.drop_table("publication")

    op.drop_table("label_snapshot")
    op.drop_table("campaign")
    op.drop_table("browser_session")
    op.drop_table("audit_entry")
    op.drop_table("api_token")

    op.drop_table("sign_in_attempt")
    op.drop_table("service_beat")
    op.drop_table("checkpoint")
    op.drop_table("annotator")
    if not _on_sqlite():
        op.execute("DROP FUNCTION refuse_change()")
