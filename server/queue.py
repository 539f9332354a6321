"""Names of queued work, shared by the side that sends and the side that runs it.

Only ids travel. The server sends after its commit; the worker registers functions under these
names. `make_sender` needs no worker code and no result backend.
"""

from __future__ import annotations

from collections.abc import Callable

from server.states import JobKind

RUN_JOB = "rodif.run_job"  # args: (job_id,)
TICK_RESEND = "rodif.tick_resend"  # re-send jobs that are queued or whose lease ran out
TICK_ROUNDS = "rodif.tick_rounds"  # start rounds that are due

QUEUE_OF_KIND: dict[JobKind, str] = {
    JobKind.COLLECT: "rollout",
    JobKind.EVALUATE: "rollout",
    JobKind.REPLAY: "replay",
    JobKind.FINETUNE: "finetune",
    JobKind.PUBLISH: "finetune",
}
TICK_QUEUE = "tick"
QUEUES = ("rollout", "replay", "finetune", TICK_QUEUE)

# Sends "job <id> of <kind> is ready"; may raise OSError-like broker errors, which callers log:
# the row is the truth, and the beat's tick sends it again.
SendJob = Callable[[int, JobKind], None]
