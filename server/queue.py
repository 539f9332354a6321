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
JOB_QUEUES = ("rollout", "replay", "finetune")
QUEUES = (*JOB_QUEUES, TICK_QUEUE)

# Sends "job <id> of <kind> is ready"; may raise OSError-like broker errors, which callers log:
# the row is the truth, and the beat's tick sends it again.
SendJob = Callable[[int, JobKind], None]

# Measured with Valkey: the defaults restore messages of a killed worker only after about 100 s.
BROKER_TRANSPORT_OPTIONS: dict[str, float] = {
    "visibility_timeout": 900,  # seconds; longer than any job step between two lease renewals
    "unacked_restore_interval": 5,  # seconds between sweeps for messages of dead workers
    "unacked_restore_throttle": 1,
    "socket_connect_timeout": 2.0,  # seconds
    "socket_timeout": 30.0,  # seconds
}


def make_sender(broker_url: str) -> SendJob:
    """A function that tells the queue "job <id> is ready".

    It raises ConnectionError (an OSError) within a few seconds when the broker is away.
    """
    from celery import Celery
    from kombu.exceptions import OperationalError

    app = Celery("rodif", broker=broker_url, set_as_current=False)
    app.conf.update(
        task_ignore_result=True,
        # Without max_retries kombu would wait for a broker for ever, and the request with it.
        broker_transport_options=BROKER_TRANSPORT_OPTIONS
        | {"max_retries": 1, "interval_start": 0.0, "interval_step": 0.1, "interval_max": 0.1},
    )

    def send(job_id: int, kind: JobKind) -> None:
        try:
            app.send_task(RUN_JOB, args=(job_id,), queue=QUEUE_OF_KIND[kind], retry=False)
        except OperationalError as error:
            raise ConnectionError(f"broker {broker_url}: {error}") from error

    return send


def ping_broker(broker_url: str) -> None:
    """Reach the broker once; raises ConnectionError (an OSError) when it does not answer."""
    from kombu import Connection
    from kombu.exceptions import OperationalError

    options = BROKER_TRANSPORT_OPTIONS | {"socket_timeout": 2.0}
    try:
        with Connection(broker_url, transport_options=options) as connection:
            connection.ensure_connection(max_retries=1, interval_start=0.0, timeout=2.0)
    except OperationalError as error:
        raise ConnectionError(f"broker {broker_url}: {error}") from error
