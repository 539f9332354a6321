"""Names of states, kinds and roles that SQL rows, REST answers and jobs share."""

from __future__ import annotations

from enum import StrEnum


class Role(StrEnum):
    """What an account may do; the legal values of `annotator.role`."""

    ADMIN = "admin"  # everything
    ANNOTATOR = "annotator"  # label, see own progress
    SERVICE = "service"  # scripts: label as a simulated annotator, collect, launch rounds


class AnnotatorKind(StrEnum):
    """Whether a person or a program gives the labels."""

    PERSON = "person"
    SIMULATED = "simulated"


class Choice(StrEnum):
    """A preference between the two episodes of a pair, free of screen sides."""

    FIRST = "first"
    SECOND = "second"
    EQUAL = "equal"
    CANNOT_TELL = "cannot_tell"


DECISIVE = (Choice.FIRST, Choice.SECOND)  # choices that say which episode is better
TELLING = (*DECISIVE, Choice.EQUAL)  # choices that a round learns from


class PairState(StrEnum):
    """Life of a pair."""

    WAITING = "waiting"  # the replay is not made yet
    READY = "ready"  # can be labelled
    FAILED = "failed"  # the replay could not be made


class ReleaseReason(StrEnum):
    """Why an annotator gives a leased pair back without a label."""

    REPLAY_FAILED = "replay_failed"  # the replay does not load or does not start
    SKIPPED = "skipped"  # anything else


class JobKind(StrEnum):
    """Units of queued work."""

    COLLECT = "collect"  # roll out the published policy, store episodes, choose pairs
    REPLAY = "replay"  # make the .viser recording and the thumbnail of one pair
    FINETUNE = "finetune"  # label snapshot → candidate checkpoint
    EVALUATE = "evaluate"  # seeded rollouts of a candidate and of its parent
    PUBLISH = "publish"  # gate, then move the published alias


class JobState(StrEnum):
    """Life of a job: queued → running → done | failed; running → queued when its lease runs out."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class RoundState(StrEnum):
    """Life of a round.

    queued → finetuning → evaluating → gating → published | rejected | kept
    any state before the last three → failed | cancelled
    """

    QUEUED = "queued"
    FINETUNING = "finetuning"
    EVALUATING = "evaluating"
    GATING = "gating"
    PUBLISHED = "published"  # the gate passed and the alias moved
    REJECTED = "rejected"  # the gate refused; the candidate stays on record
    KEPT = "kept"  # publish = manual | never, nothing new, or the alias has moved: not published
    FAILED = "failed"
    CANCELLED = "cancelled"


class RoundTrigger(StrEnum):
    """Why a round was started."""

    MANUAL = "manual"  # REST
    LABELS = "labels"  # enough new labels
    PERIODIC = "periodic"  # every N minutes


class PublishRule(StrEnum):
    """What a round does with its candidate after the evaluation; the loosest rule first."""

    AUTO = "auto"  # publish when the gate passes
    MANUAL = "manual"  # evaluate the gate, wait for an admin
    NEVER = "never"  # comparison round: never offered for publishing

    def allows(self, other: PublishRule) -> bool:
        """Whether `other` publishes no more easily than this rule."""
        loosest_first = list(PublishRule)
        return loosest_first.index(other) >= loosest_first.index(self)


class PairStrategy(StrEnum):
    """How a collect job chooses pairs among its episodes."""

    CROSS_GROUP = "cross_group"  # different behaviour groups, plus a random share
    RANDOM = "random"
