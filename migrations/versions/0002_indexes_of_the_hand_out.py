"""indexes of the hand-out."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

OPEN = sa.text("closed_at IS NULL")


def upgrade() -> None:
    """Let the questions that are asked at every click be answered from indexes alone."""
    op.create_index(
        "ix_label_of_campaign",
        "label",
        ["campaign_id", "pair_id", "annotator_id", "choice", "retracted", "duration_ms"],
    )
    op.drop_index("ix_label_campaign_id", "label")
    op.create_index(
        "ix_label_of_annotator", "label", ["annotator_id", "campaign_id", "pair_id", "retracted"]
    )
    op.drop_index("ix_label_annotator_id", "label")
    op.create_index("ix_pair_campaign_id_state", "pair", ["campaign_id", "state"])
    op.drop_index("ix_pair_campaign_id", "pair")
    op.create_index(
        "ix_lease_of_annotator", "lease", ["annotator_id", "closed_at", "expires_at", "pair_id"]
    )
    op.drop_index("ix_lease_annotator_id", "lease")
    op.create_index(
        "ix_lease_open",
        "lease",
        ["pair_id", "annotator_id", "expires_at"],
        sqlite_where=OPEN,
        postgresql_where=OPEN,
    )
    op.create_index("ix_event_campaign_id_kind", "event", ["campaign_id", "kind"])


def downgrade() -> None:
    """Back to an index a column."""
    op.drop_index("ix_event_campaign_id_kind", "event")
    op.drop_index("ix_lease_open", "lease")
    op.create_index("ix_lease_annotator_id", "lease", ["annotator_id"])
    op.drop_index("ix_lease_of_annotator", "lease")
    op.create_index("ix_pair_campaign_id", "pair", ["campaign_id"])
    op.drop_index("ix_pair_campaign_id_state", "pair")
    op.create_index("ix_label_annotator_id", "label", ["annotator_id"])
    op.drop_index("ix_label_of_annotator", "label")
    op.create_index("ix_label_campaign_id", "label", ["campaign_id"])
    op.drop_index("ix_label_of_campaign", "label")
